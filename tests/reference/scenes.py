"""Small scenes and cameras made by rule, whose every value is known: what results are compared on."""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import SH_COEFFICIENTS, Scene
from tests.reference.raster import rotation_matrices


def random_scene(splats: int, degree: int = 3, seed: int = 0, extent: float = 1.0) -> Scene:
    """Splats around the origin, values spread as in trained scenes."""
    rng = np.random.default_rng(seed)
    coefficients = SH_COEFFICIENTS[degree]
    sh = rng.laplace(scale=0.05, size=(splats, coefficients, 3))
    sh[:, 0] = rng.normal(size=(splats, 3))
    return Scene(
        (extent * rng.normal(size=(splats, 3))).astype(np.float32),
        rng.normal(-5, 1.5, size=(splats, 3)).astype(np.float32),
        rng.normal(size=(splats, 4)).astype(np.float32),
        rng.normal(0, 3, size=splats).astype(np.float32),
        sh.astype(np.float32),
    )


def ring_of_cameras(count: int, distance: float = 4.0, size: int = 64) -> list[Camera]:
    """Cameras on a circle that look at the origin; every fourth is a test view."""
    cameras = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        camera_centre = distance * np.array([np.cos(angle), np.sin(angle), 0.3])
        forward = -camera_centre / np.linalg.norm(camera_centre)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        split = "test" if k % 4 == 0 else "train"
        cameras.append(
            Camera(
                f"view_{k}",
                size,
                size,
                1.2 * size,
                1.2 * size,
                size / 2,
                size / 2,
                rotation,
                -rotation @ camera_centre,
                split,
            )
        )
    return cameras


def visible_scene(splats: int, degree: int = 3, seed: int = 0) -> Scene:
    """Splats of several pixels; one colour in fifteen is cut at 0."""
    scene = random_scene(splats, degree, seed)
    rng = np.random.default_rng(seed + 100)
    return dataclasses.replace(
        scene,
        log_scales=rng.normal(-2, 0.5, size=(splats, 3)).astype(np.float32),
        opacity_logits=rng.normal(-1, 1.5, size=splats).astype(np.float32),
    )


def straight_camera(width: int = 64, height: int = 48, focal: float = 60.0, **other: float) -> Camera:
    """At the origin, looking along +z."""
    return Camera(
        "view",
        width,
        height,
        focal,
        other.get("fy", focal * 1.1),
        other.get("cx", width / 2),
        other.get("cy", height / 2),
        np.eye(3),
        np.zeros(3),
    )


def tilted_camera(seed: int, width: int, height: int, offset: float = 0.0) -> Camera:
    """Somewhere around the origin (or ``offset`` from it along x), looking at it, principal point off the centre."""
    rng = np.random.default_rng(seed)
    camera_centre = rng.normal(size=3)
    camera_centre *= 4 / np.linalg.norm(camera_centre)
    forward = -camera_centre / 4
    right = np.cross(forward, rng.normal(size=3))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_centre = camera_centre + np.array([offset, 0, 0])
    return Camera("tilted", width, height, 70, 75, width / 2 + 3, height / 2 - 2, rotation, -rotation @ camera_centre)


def random_splats(n: int, degree: int = 3, seed: int = 0) -> Scene:
    """Splats around the origin, from less than a pixel to a third of the picture."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(scale=0.2, size=(n, SH_COEFFICIENTS[degree], 3))
    return Scene(
        rng.normal(scale=0.8, size=(n, 3)).astype(np.float32),
        rng.normal(-2.5, 1, size=(n, 3)).astype(np.float32),
        (rng.normal(size=(n, 4)) * rng.uniform(0.1, 10, size=(n, 1))).astype(np.float32),
        rng.normal(0, 3, size=n).astype(np.float32),
        sh.astype(np.float32),
    )


def plain_splats(means: object, sigma: object = 0.1, logit: object = 0.0, colour: object = (1.0, 0.5, 0.25)) -> Scene:
    """Splats of degree 0 from what is given, the rest alike."""
    centres = np.atleast_2d(np.asarray(means, np.float32))
    n = len(centres)
    quaternions = np.zeros((n, 4), np.float32)
    quaternions[:, 0] = 1
    with np.errstate(divide="ignore"):
        log_scales = np.log(np.broadcast_to(np.asarray(sigma, np.float64), (n, 3)))
    dc = (np.broadcast_to(np.asarray(colour, np.float64), (n, 3)) - 0.5) / 0.28209479177387814
    return Scene(
        centres,
        np.maximum(log_scales, -200).astype(np.float32),
        quaternions,
        np.broadcast_to(np.asarray(logit, np.float32), (n,)).copy(),
        dc[:, None].astype(np.float32),
    )


def covariances(scene: Scene) -> np.ndarray:
    """(N, 3, 3) float64, of the splats."""
    unit = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    axes = rotation_matrices(unit.astype(np.float64)) * np.exp(scene.log_scales.astype(np.float64))[:, None]
    return axes @ axes.transpose(0, 2, 1)
