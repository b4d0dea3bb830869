"""A street: heaps of splats in a row, of which no view sees much but one along the street."""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from tests.reference.captures import looking
from tests.reference.scenes import random_scene


def street(houses: int = 5, splats: int = 300, across: bool = False) -> tuple[Scene, list[Camera]]:
    """Heaps in a row, each with views of its own, and one along the street.

    Args:
        houses: heaps.
        splats: of each.
        across: whether the heaps' views look across the street, and see no other heap.
    """
    rng = np.random.default_rng(8)
    scene = random_scene(houses * splats, 1, seed=8)
    at = np.repeat(np.arange(houses) * 12.0, splats)
    means = rng.normal(size=(len(scene), 3)) * 0.5
    means[:, 0] += at
    rng.shuffle(means)
    log_scales = rng.normal(-2.2, 0.4, (len(scene), 3))
    scene = dataclasses.replace(scene, means=means.astype(np.float32), log_scales=log_scales.astype(np.float32))
    cameras = []
    for house in range(houses):
        there = np.array([house * 12.0, 0, 0])
        for turn in (1.4, 1.7, 4.5) if across else (0.4, 2.2, 4.5):
            here = there + 3 * np.array([np.cos(turn), np.sin(turn), 0.3])
            cameras.append(looking(here, there, name=f"{house}_{turn}", wide=0.4))
    cameras.append(looking(np.array([-6.0, 0, 0.2]), np.array([50.0, 0, 0]), name="along", wide=0.4))
    cameras = [cameras[k] for k in rng.permutation(len(cameras))]
    return scene, [dataclasses.replace(c, width=80, height=60, fx=c.fx / 7, fy=c.fy / 7, cx=40, cy=30) for c in cameras]
