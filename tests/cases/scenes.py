"""Small random scenes for tests."""

from __future__ import annotations

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import SH_COEFFICIENTS, Scene


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


def in_order_of(scene: Scene, back: Scene) -> Scene:
    """The splats of a scene that was written and read, in the order of ``scene``: writers sort them."""
    distances = np.abs(back.means[None] - scene.means[:, None]).max(axis=-1)
    index = distances.argmin(axis=1)
    assert len(np.unique(index)) == len(scene) == len(back)
    return back.subset(index)
