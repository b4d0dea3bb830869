"""The views of a sweep over a large scene, each with the splats that it reaches: :class:`PickedViews`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.picked_splats import NO_SPLAT, PickedSplats
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_cache import GEOMETRY, LEAST_SETS, ViewCache
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.refitting.prepared_views import Ready, budget_of


class PickedViews(Owner):
    """What :class:`potr_cl.stages.refitting.prepared_views.PreparedViews` is, where views have splats of their own.

    Views of one launch have room for as many splats as the first of them has, so views that follow each other should
    have about as many. Those that are not kept take turns in the same memory.

    Args:
        rasterizer: of the whole scene.
        cameras: the views.
        reached: the numbers of the splats of each; fewer and fewer, but at the breaks.
        most_views: how many views a launch can do.
        nbytes: bytes that a splat of a view takes in a sweep's own buffers.
        breaks, memory, others: as of :class:`~potr_cl.stages.refitting.prepared_views.PreparedViews`.

    Attributes:
        launches, budget: as there.

    Raises:
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        reached: Sequence[NDArray[np.uint32]],
        most_views: int,
        nbytes: int,
        memory: int | None,
        breaks: Sequence[int] = (),
        others: int = 0,
    ) -> None:
        self._rasterizer, self._cameras, self._reached = rasterizer, list(cameras), list(reached)
        device = rasterizer.device
        self._memory, self._preparing = Memory(device), PreparingMemory(device)
        self._passing = Reused(device)
        self.budget = ViewCache(rasterizer, budget_of(device, memory), others)
        self._picked: dict[range, Rasterizer] = {}
        self._numbers: dict[range, cl.Buffer] = {}
        self._kept: dict[range, ViewSet] = {}
        try:
            most_splats = self.budget.room // (LEAST_SETS * (GEOMETRY + nbytes))
            to_do = self._dealt(most_views, most_splats, breaks)
            self.budget.largest = max((self.stride(numbers) * len(numbers) for numbers in to_do), default=0)
            while to_do:
                numbers = to_do.pop(0)
                try:
                    self._prepare(numbers)
                except DeviceMemoryError:
                    if len(numbers) == 1:
                        raise
                    middle = (numbers.start + numbers.stop) // 2
                    to_do[:0] = [range(numbers.start, middle), range(middle, numbers.stop)]
        except BaseException:
            self.close()
            raise
        self.launches = list(self._picked)
        self._reached = [numbers[:0] for numbers in self._reached]  # they lie on the device

    def _dealt(self, most_views: int, most_splats: float, breaks: Sequence[int]) -> list[range]:
        launches: list[range] = []
        first = 0
        for stop in sorted({*breaks, len(self._cameras)}):
            while first < stop:
                together = int(min(max(most_splats // _padded(self._reached[first]), 1), most_views, stop - first))
                launches.append(range(first, first + together))
                first += together
        return launches

    def stride(self, numbers: range) -> int:
        """Room for the splats of each view of a launch."""
        picked = self._picked.get(numbers)
        return max(map(_padded, self._reached[numbers.start : numbers.stop])) if picked is None else picked.stride

    def picks(self, numbers: range) -> cl.Buffer:
        """(views, stride) uint32, the numbers of the splats of each view of a launch."""
        return self._numbers[numbers]

    def _prepare(self, numbers: range) -> None:
        device, stride = self._rasterizer.device, self.stride(numbers)
        padded = np.full((len(numbers), stride), NO_SPLAT, np.uint32)
        for row, number in zip(padded, numbers, strict=True):
            row[: len(self._reached[number])] = self._reached[number]
        picks = self._memory.upload(padded, "the numbers of views' splats")
        try:
            scene = PickedSplats(self._rasterizer.parameters, picks, stride, apart=stride)
            rasterizer = Rasterizer(device, scene, self._rasterizer.rules, preparing=self._preparing)
            views = rasterizer.prepare_set([self._cameras[number] for number in numbers])
        except BaseException:
            self._memory.free(picks)
            raise
        self._picked[numbers], self._numbers[numbers] = rasterizer, picks
        self.budget.room -= picks.size
        if self.budget.keep(views):
            self._kept[numbers] = views
        else:
            views.close()

    @contextmanager
    def ready(self, numbers: range) -> Iterator[Ready]:
        """See :meth:`potr_cl.stages.refitting.prepared_views.PreparedViews.ready`."""
        views, rasterizer = self._kept.get(numbers), self._picked[numbers]
        if views is not None:
            with self.budget.geometry(views, rasterizer) as projected:
                yield Ready(views, projected)
            return
        try:
            cameras = [self._cameras[number] for number in numbers]
            yield Ready(rasterizer.prepare_set(cameras, self._passing), True)
        finally:
            self._passing.close()

    def close(self) -> None:
        """Give all device memory back."""
        for views in self._kept.values():
            views.close()
        for rasterizer in self._picked.values():
            rasterizer.close()
        self._kept, self._picked, self._numbers = {}, {}, {}
        self._passing.give_back()
        self._preparing.close()
        self.budget.close()
        self._memory.close()


def _padded(numbers: NDArray[np.uint32]) -> int:
    return max(-(-len(numbers) // SPLAT_GROUP), 1) * SPLAT_GROUP
