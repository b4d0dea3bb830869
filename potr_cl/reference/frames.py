"""Cameras that are in a scene's frame and such that are not: what :mod:`potr_cl.model.agreement` is judged by.

:func:`moved` turns, mirrors, scales and shifts a scene as programs that edit scenes do, colours included.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.placement.colour_memory import ac_basis
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import place_cameras
from potr_cl.reference.captures import looking

F64 = NDArray[np.float64]

#: What programs and people do to scenes: axes, scale, shift in world units. Cameras all around a thing see it from all
#: sides after a turn about the vertical, too: no such turn is here.
MOTIONS: dict[str, tuple[F64, float, tuple[float, float, float]]] = {
    "turned by 180 degrees about x": (np.diag([1.0, -1.0, -1.0]), 1.0, (0, 0, 0)),
    "turned by 180 degrees about y": (np.diag([-1.0, 1.0, -1.0]), 1.0, (0, 0, 0)),
    "turned by 90 degrees about x": (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), 1.0, (0, 0, 0)),
    "mirrored along z": (np.diag([1.0, 1.0, -1.0]), 1.0, (0, 0, 0)),
    "shifted by 8 along x": (np.eye(3), 1.0, (8, 0, 0)),
    "shifted by 8 along y": (np.eye(3), 1.0, (0, 8, 0)),
    "scaled by 10": (np.eye(3), 10.0, (0, 0, 0)),
    "scaled by 0.1": (np.eye(3), 0.1, (0, 0, 0)),
}


def wrong(
    scene: Scene, cameras: Sequence[Camera], others: Sequence[Camera]
) -> Iterator[tuple[str, Scene, list[Camera]]]:
    """A scene and cameras that are not in its frame, each with what was done; ``others`` are of another scene."""
    for name, motion in MOTIONS.items():
        yield name, moved(scene, *motion), list(cameras)
    yield "another scene's cameras", scene, list(others)


def right(scene: Scene, cameras: Sequence[Camera], others: bool = True) -> Iterator[tuple[str, list[Camera]]]:
    """Cameras that are in the scene's frame, each with what they are: some of its own and, if wanted, others."""
    count = len(cameras)
    yield "all cameras", list(cameras)
    yield "every other one", list(cameras[::2])
    beside = np.argsort(camera_centres(cameras)[:, 0], kind="stable")
    yield "those of one side", [cameras[view] for view in beside[: max(count // 2, 1)]]
    yield "four of them", [cameras[view] for view in np.linspace(0, count - 1, 4).astype(int)]
    yield "four others", [cameras[view] for view in np.random.default_rng(1).choice(count, 4, replace=False)]
    for view in np.linspace(0, count - 1, 3).astype(int):
        yield f"number {view} alone", [cameras[view]]
    if not others:
        return
    yield "views from inside", from_inside(scene)
    yield "virtual cameras", place_cameras(scene, 40)


def from_inside(scene: Scene, count: int = 12) -> list[Camera]:
    """Cameras near the middle of a scene that look all around."""
    middle = np.median(scene.means.astype(np.float64), axis=0)
    unit = float(np.median(np.linalg.norm(scene.means - middle, axis=1)))
    rays = np.random.default_rng(2).normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return [looking(middle + 0.3 * unit * ray, middle + unit * ray, name=f"{view}") for view, ray in enumerate(rays)]


def without_directions(scene: Scene) -> Scene:
    """The same scene of SH degree 0: it remembers no directions."""
    return dataclasses.replace(scene, sh=scene.sh[:, :1].copy())


def moved(scene: Scene, axes: F64, scale: float = 1.0, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Scene:
    """The scene after x became ``scale · axes x + shift``, its splats' shapes and colours moved along.

    Args:
        axes: (3, 3) orthogonal; with a determinant of -1 it mirrors.
    """
    axes = np.asarray(axes, np.float64)
    own = _matrices(scene.quaternions.astype(np.float64))
    turned = axes @ own
    # A Gaussian is its own mirror image along each of its axes: one of them makes a rotation of it again.
    turned[..., 2] *= np.sign(np.linalg.det(axes))
    sh = scene.sh.astype(np.float64)
    if sh.shape[1] > 1:
        towards = np.random.default_rng(0).normal(size=(200, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        before, after = (ac_basis(d)[:, : sh.shape[1] - 1] for d in (towards, towards @ axes.T))
        sh[:, 1:] = np.einsum("mn,knc->kmc", np.linalg.lstsq(after, before, rcond=None)[0], sh[:, 1:])
    return dataclasses.replace(
        scene,
        means=(scale * scene.means.astype(np.float64) @ axes.T + np.asarray(shift)).astype(np.float32),
        log_scales=scene.log_scales + np.float32(math.log(scale)),
        quaternions=_quaternions(turned).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _matrices(q: F64) -> F64:
    """(n, 3, 3) rotations of quaternions (n, 4), w first."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _quaternions(m: F64) -> F64:
    """(n, 4) quaternions of rotations (n, 3, 3): the eigenvector of Bar-Itzhack's symmetric matrix."""
    k = np.empty((len(m), 4, 4))
    diagonal = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    k[:, 0, 0] = diagonal[0] + diagonal[1] + diagonal[2]
    for i in range(3):
        j, o = (i + 1) % 3, (i + 2) % 3
        k[:, 1 + i, 1 + i] = diagonal[i] - diagonal[j] - diagonal[o]
        k[:, 0, 1 + i] = k[:, 1 + i, 0] = m[:, o, j] - m[:, j, o]
        k[:, 1 + i, 1 + j] = k[:, 1 + j, 1 + i] = m[:, i, j] + m[:, j, i]
    q: F64 = np.linalg.eigh(k)[1][:, :, -1]
    return q
