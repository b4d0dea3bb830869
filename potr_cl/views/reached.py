"""Which splats each view reaches, as a device finds it: :func:`reached_splats`; and which are surely seen at all:
:func:`surely_seen`, the quick part of :func:`potr_cl.model.splat_groups.unseen_splats`.

A view reaches a splat if a sweep fetches it, for any of its tiles. Most others lie beside the view; or behind what ends
all pixels of their tiles, as most of a city does. What a sweep computes is the same to the last bit if the others are
not there, while geometry and opacities stay as they are (cl/raster/reached.cl).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.splat_groups import NEAR, REACH, bounds, stretches, views_in_turn
from potr_cl.opencl.memory import Memory, Reused
from potr_cl.opencl.structs import struct_dtype
from potr_cl.raster.picked_splats import Picker
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.raster.view_set import camera_struct

#: Fewer splats are looked at together as fast.
LEAST_SPLATS = 1 << 19
#: Views must reach no more than this part of the splats, on the average: on the way from sums to coefficients each
#: view goes through the coefficients by itself then, and not together with others.
WORTH_IT = 1 / 5
#: So many views tell.
_SAMPLED = 12
#: Views that are looked at together, at most, and in which part of the memory. Bytes of a view for each splat of the
#: scene: shape, colour, bounds, and few intersections.
_TOGETHER, _ROOM, _VIEW = 8, 1 / 4, 80
#: Numbers for which memory is taken together.
_ROOM_TAKEN = 1 << 24
#: Work-items of a tile's work-group.
_GROUP = 128


@dataclass(frozen=True)
class Reach:
    """What views reach.

    Attributes:
        of: (n,) uint32 for each view by its number, the numbers of the splats that it reaches, ascending.
    """

    of: Mapping[int, NDArray[np.uint32]]

    @property
    def total(self) -> int:
        """Splats that all views reach, each view's counted for itself."""
        return sum(map(len, self.of.values()))

    def marks(self, splats: int) -> NDArray[np.bool_]:
        """(splats,) which of so many any view reaches."""
        found = np.zeros(splats, bool)
        for numbers in self.of.values():
            found[numbers] = True
        return found

    @property
    def most(self) -> int:
        """Splats that the view reaches that reaches most."""
        return max(map(len, self.of.values()))


def reached_splats(
    rasterizer: Rasterizer, cameras: Sequence[Camera], numbers: Sequence[int], memory: int | None = None
) -> Reach | None:
    """The splats that each of some views reaches.

    Args:
        numbers: of those that are meant.
        memory: bytes of the device's memory that the user would have taken; None: as much as there is.

    Returns:
        None where views had better share all splats: there are few, or views reach many of them.
    """
    if rasterizer.splats < LEAST_SPLATS or not numbers:
        return None
    found: dict[int, NDArray[np.uint32]] = {}
    device, room = rasterizer.device, _Room()
    passing = Reused(device)
    try:
        with Memory(device) as own, Picker(device, np.zeros(rasterizer.splats, np.uint32)) as picker:
            marks = own.allocate(rasterizer.stride, "the splats that a view reaches")
            some = numbers[:: -(-len(numbers) // _SAMPLED)]
            free = min((device.info.memory if memory is None else memory), device.info.memory - device.allocated)
            most = int(min(max(free * _ROOM / (_VIEW * rasterizer.stride), 1), _TOGETHER))
            if device.family == "cpu":  # a launch does one view
                most = 1
            for views in (some, sorted(set(numbers) - set(some))):
                left = list(views)
                while left:
                    together = left[:most]
                    of_these = [cameras[number] for number in together]
                    try:
                        splats = _reached(rasterizer, of_these, picker, marks, passing)
                    except DeviceMemoryError:
                        if len(together) == 1:
                            raise
                        most = len(together) // 2
                        continue
                    found.update(zip(together, room.of(splats), strict=True))
                    del left[:most]
                if views is some and not _worth_it(found, rasterizer.splats):
                    return None
    finally:
        passing.give_back()
        rasterizer.rest()
    return Reach(found)


class _Room:
    """Keeps arrays in large pieces of memory, each of which the system has back when none of its arrays is left.

    Of arrays of some megabytes, one by one, a process keeps the memory.
    """

    def __init__(self) -> None:
        self._free = np.empty(0, np.uint32)

    def of(self, arrays: Sequence[NDArray[np.uint32]]) -> list[NDArray[np.uint32]]:
        """The same arrays, there."""
        kept = []
        for array in arrays:
            if len(array) > len(self._free):
                self._free = np.empty(max(_ROOM_TAKEN, len(array)), np.uint32)
            own, self._free = self._free[: len(array)], self._free[len(array) :]
            own[:] = array
            kept.append(own)
        return kept


def _worth_it(found: dict[int, NDArray[np.uint32]], splats: int) -> bool:
    return sum(map(len, found.values())) <= WORTH_IT * splats * len(found)


def _reached(
    rasterizer: Rasterizer, cameras: Sequence[Camera], picker: Picker, marks: cl.Buffer, passing: Reused
) -> list[NDArray[np.uint32]]:
    device, rules = rasterizer.device, rasterizer.rules
    ends = {"ALPHA_CAP": float(rules.alpha_cap), "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold}
    of_cpu = device.family == "cpu"
    if of_cpu:
        lanes = max(device.vector_width, 8)
        mark = device.shared_kernel("raster/reached_cpu.cl", "mark_reached", LANES=lanes, **ends)
    else:
        native = int(device.native_exp2)
        mark = device.shared_kernel("raster/reached.cl", "mark_reached", NATIVE_EXP2=native, **ends)
    found: list[NDArray[np.uint32]] = []
    try:
        # Together: the longest tile list of one keeps few work-groups busy.
        views = rasterizer.prepare_set(cameras, passing)
        for number, view in enumerate(views.views):
            device.fill(marks, np.uint8(0))
            lists: dict[str, Any] = {
                "shapes": views.shapes,
                "colours": views.colours,
                "offsets": views.offsets,
                "intersections": views.intersections,
                "subtiles": views.subtiles,
                "marks": marks,
            }
            if of_cpu:
                mark.bind(view=camera_struct(view.camera), **lists).launch((view.tiles,), (1,))
            else:
                mark.bind(views=views.table, number=number, stride=views.stride, **lists)
                mark.launch((view.tiles * _GROUP,), (_GROUP,))
            with Memory(device) as memory:
                numbers, count = picker.pick(memory, np.ones(1, bool), marks, 1)
                found.append(device.download(numbers, (count,), np.uint32))
    finally:
        passing.close()
    return found


_SOURCE = "raster/surely_seen.cl"


class Seen(IntEnum):
    """What is known of a splat, ``enum`` of the kernel."""

    NO, YES, UNDECIDED = range(3)


def surely_seen(scene: SceneBuffers, cameras: Sequence[Camera]) -> NDArray[np.uint8]:
    """Whether splats reach into a view's picture.

    Args:
        scene: the splats on a device.

    Returns:
        (N,) :class:`Seen` of each splat; undecided where rounding could decide it.
    """
    device = scene.device
    seers = np.zeros(len(cameras), struct_dtype(_SOURCE, "Seer"))
    for seer, number in zip(seers, views_in_turn(len(cameras)), strict=True):
        camera = cameras[number]
        seer["rotation"], seer["translation"] = camera.rotation.ravel(), camera.translation
        (seer["low"], seer["high"]), seer["stretch"] = zip(*bounds(camera), strict=True), stretches(camera)
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
