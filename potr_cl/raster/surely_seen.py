"""Which splats views see, found on a device but for few: :func:`surely_seen`, the quick part of
:func:`potr_cl.model.splat_groups.unseen_splats`."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.splat_groups import NEAR, REACH, bounds, views_in_turn
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.structs import struct_dtype
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

_SOURCE = "raster/surely_seen.cl"


class Seen(IntEnum):
    """What is known of a splat, ``enum`` of the kernel."""

    NO, YES, UNDECIDED = range(3)


def surely_seen(scene: SceneBuffers, cameras: Sequence[Camera]) -> NDArray[np.uint8]:
    """Whether splats reach into a view's picture.

    Args:
        scene: the splats on a device.
        cameras: the views.

    Returns:
        (N,) :class:`Seen` of each splat; undecided where rounding could decide it.

    Raises:
        DeviceError: the device has no room, or failed.
    """
    device = scene.device
    seers = np.zeros(len(cameras), struct_dtype(_SOURCE, "Seer"))
    for seer, number in zip(seers, views_in_turn(len(cameras)), strict=True):
        camera = cameras[number]
        seer["rotation"], seer["translation"] = camera.rotation.ravel(), camera.translation
        for axis, (low, high) in enumerate(bounds(camera)):
            seer["low"][axis], seer["high"][axis] = low, high
            seer["low_length"][axis], seer["high_length"][axis] = np.hypot(1, low), np.hypot(1, high)
    kernel = device.shared_kernel(_SOURCE, "surely_seen")
    with Memory(device) as memory:
        found = memory.allocate(scene.stride, "the splats that are seen")
        kernel.bind(
            splats=scene.splats,
            stride=scene.stride,
            means=scene.means,
            scales=scene.scales,
            seers=memory.upload(seers, "the views"),
            views=len(cameras),
            near=NEAR,
            reach_of_one=REACH,
            seen=found,
        )
        kernel.launch((scene.stride,), (SPLAT_GROUP,))
        seen: NDArray[np.uint8] = device.download(found, (scene.splats,), np.uint8)
    return seen
