"""How a scene that was written and read again is compared with itself; scenes made antialiased."""

from __future__ import annotations

import dataclasses

import numpy as np

from potr_cl.model.scene import LOW_PASS, Scene


def in_order_of(scene: Scene, back: Scene) -> Scene:
    """The splats of a scene that was written and read, in the order of ``scene``: writers sort them."""
    distances = np.abs(back.means[None] - scene.means[:, None]).max(axis=-1)
    index = distances.argmin(axis=1)
    assert len(np.unique(index)) == len(scene) == len(back)
    return back.subset(index)


def antialiased(scene: Scene, low_pass: float = LOW_PASS, smaller: float = 1.0) -> Scene:
    """The same as an antialiased scene, its splats e to ``smaller`` times as small, so that the filter matters."""
    return dataclasses.replace(
        scene, log_scales=scene.log_scales - np.float32(smaller), antialiased=True, low_pass=low_pass
    )
