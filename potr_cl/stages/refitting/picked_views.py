"""The views of a sweep over a large scene, each with the splats that it reaches: :class:`PickedViews`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

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
        self._strides = [_padded(numbers) for numbers in reached]
        device = rasterizer.device
        self._preparing = PreparingMemory(device)
        self._passing = Reused(device)
        self.budget = ViewCache(rasterizer, budget_of(device, memory), others)
        self.launches: list[range] = []
        self._kept: dict[range, _Kept] = {}
        #: What the last views that are not kept have picked.
        self._passed: tuple[range, cl.Buffer] | None = None
        try:
            # The largest view has its room in any case.
            most_splats = max(self.budget.room // (LEAST_SETS * (GEOMETRY + nbytes)), *self._strides, 0)
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

    def _dealt(self, most_views: int, most_splats: float, breaks: Sequence[int]) -> list[range]:
        launches: list[range] = []
        first = 0
        for stop in sorted({*breaks, len(self._cameras)}):
            while first < stop:
                together = int(min(max(most_splats // self._strides[first], 1), most_views, stop - first))
                launches.append(range(first, first + together))
                first += together
        return launches

    def stride(self, numbers: range) -> int:
        """Room for the splats of each view of a launch."""
        return self._strides[numbers.start]

    def picks(self, numbers: range) -> cl.Buffer:
        """(views, stride) uint32, the numbers of the splats of each view of a launch that is ready, or was last."""
        if numbers in self._kept:
            return self._kept[numbers].picks
        assert self._passed is not None
        assert self._passed[0] == numbers, "only valid while its views are"
        return self._passed[1]

    def _prepare(self, numbers: range) -> None:
        with ExitStack() as stack:
            memory = stack.enter_context(Memory(self._rasterizer.device))
            rasterizer, picks = self._picked(numbers, memory)
            stack.enter_context(rasterizer)
            views = rasterizer.prepare_set([self._cameras[number] for number in numbers])
            stack.enter_context(views)
            if self.budget.keep(views, picks.size):
                self._kept[numbers] = _Kept(views, rasterizer, picks, stack.pop_all())
                for number in numbers:  # they lie on the device
                    self._reached[number] = self._reached[number][:0].copy()
        self.launches.append(numbers)

    def _picked(self, numbers: range, memory: Memory) -> tuple[Rasterizer, cl.Buffer]:
        """What prepares a launch's views, and the numbers of their splats, which the memory owns."""
        stride = self.stride(numbers)
        padded = np.full((len(numbers), stride), NO_SPLAT, np.uint32)
        for row, number in zip(padded, numbers, strict=True):
            row[: len(self._reached[number])] = self._reached[number]
        picks = memory.upload(padded, "the numbers of views' splats")
        scene = PickedSplats(self._rasterizer.parameters, picks, stride, apart=stride)
        return Rasterizer(self._rasterizer.device, scene, self._rasterizer.rules, preparing=self._preparing), picks

    @contextmanager
    def ready(self, numbers: range) -> Iterator[Ready]:
        """See :meth:`potr_cl.stages.refitting.prepared_views.PreparedViews.ready`."""
        kept = self._kept.get(numbers)
        if kept is not None:
            with self.budget.geometry(kept.views, kept.rasterizer) as projected:
                yield Ready(kept.views, projected)
            return
        try:
            rasterizer, picks = self._picked(numbers, self._passing)
            self._passed = numbers, picks
            yield Ready(rasterizer.prepare_set([self._cameras[number] for number in numbers], self._passing), True)
        finally:
            self._passing.close()  # what lies there stays until the next views come

    def close(self) -> None:
        """Give all device memory back."""
        for kept in self._kept.values():
            kept.owned.close()
        self._kept, self._passed = {}, None
        self._passing.give_back()
        self._preparing.close()
        self.budget.close()


@dataclass(frozen=True)
class _Kept:
    """The views of a launch that stay prepared.

    Attributes:
        views: the views.
        rasterizer: has prepared them.
        picks: (views, stride) uint32, the numbers of their splats.
        owned: all of these.
    """

    views: ViewSet
    rasterizer: Rasterizer
    picks: cl.Buffer
    owned: ExitStack


def _padded(numbers: NDArray[np.uint32]) -> int:
    return max(-(-len(numbers) // SPLAT_GROUP), 1) * SPLAT_GROUP
