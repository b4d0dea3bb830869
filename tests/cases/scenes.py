"""How a scene that was written and read again is compared with itself; scenes made antialiased."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import LOW_PASS, Scene
from tests.reference.raster import rotation_matrices


def in_order_of(scene: Scene, back: Scene) -> Scene:
    """The splats of a scene that was written and read, in the order of ``scene``: writers sort them."""
    distances = np.abs(back.means[None] - scene.means[:, None]).max(axis=-1)
    index = distances.argmin(axis=1)
    assert len(np.unique(index)) == len(scene) == len(back)
    return back.subset(index)


def rows_of(scene: Scene) -> set[bytes]:
    """The splats of a scene without their order, each as all of its values."""
    return {row.tobytes() for row in np.hstack([array.reshape(len(scene), -1) for array in scene.arrays])}


def turned_by(scene: Scene, back: Scene) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """How far the splats of a file are turned, and how their scales differ, whichever way their axes are numbered.

    Args:
        scene, back: the same splats in the same order; axes may have other numbers and directions in ``back``.

    Returns:
        (N,) angles in radians, the smallest of all numberings, and (N, 3) differences of log scales with that one.
    """
    wanted, found = (rotation_matrices(of.quaternions.astype(np.float64)) for of in (scene, back))
    forms = [
        np.eye(3)[:, list(order)] * signs
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    ]
    forms = [form for form in forms if np.linalg.det(form) > 0]
    traces = np.stack([np.einsum("nik,nij,jk->n", wanted, found, form) for form in forms])
    best = traces.argmax(axis=0)
    orders = np.array([np.abs(form).argmax(axis=0) for form in forms])[best]
    differences = np.take_along_axis(back.log_scales, orders, axis=1) - scene.log_scales
    return np.arccos(((traces.max(axis=0) - 1) / 2).clip(-1, 1)), differences


def antialiased(scene: Scene, low_pass: float = LOW_PASS, smaller: float = 1.0) -> Scene:
    """The same as an antialiased scene, its splats e to ``smaller`` times as small, so that the filter matters."""
    return dataclasses.replace(
        scene, log_scales=scene.log_scales - np.float32(smaller), antialiased=True, low_pass=low_pass
    )
