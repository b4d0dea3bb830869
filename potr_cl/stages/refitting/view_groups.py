"""The views of a re-fit in groups that a launch does together, kept or prepared again: :class:`ViewGroups`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.picked_splats import NO_SPLAT, PickedSplats
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.raster.view_cache import GEOMETRY, LEAST_SETS, ViewCache
from potr_cl.raster.view_set import ViewSet

#: Part of the device's memory not yet taken that is the budget unless the caller sets one: of a memory of its own, and
#: of one that is the host's too.
_SHARE, _SHARE_OF_HOST = 0.4, 0.25
#: Where a group was not kept, those are that have no more than this part of its splats: others need not be tried.
_MUCH_LESS = 0.9


@dataclass(frozen=True)
class Ready:
    """A group's views, with their geometry.

    Attributes:
        views: the views.
        picks: (views, stride) uint32, the numbers of the splats of each; None: all views have all.
        anew: whether their colours were made anew since the last time.
    """

    views: ViewSet
    picks: cl.Buffer | None
    anew: bool


@dataclass(frozen=True)
class _Kept:
    """A group's views that stay prepared, what has prepared them, and what is kept with them."""

    views: ViewSet
    rasterizer: Rasterizer
    picks: cl.Buffer | None
    owned: ExitStack


def budget_of(device: Device, memory: int | None) -> float:
    """Bytes that kept views may take: what is given, or a part of what is free."""
    free = device.info.memory - device.allocated
    of_host = device.info.kind == "cpu" or device.info.integrated
    return free * (_SHARE_OF_HOST if of_host else _SHARE) if memory is None else memory


class ViewGroups(Owner):
    """Prepared views, group by group. Those that are not kept take turns in the same memory.

    Args:
        rasterizer: of the whole scene.
        cameras: the views.
        splats: the numbers of the splats of each, fewer and fewer, but at the breaks: views of a group have room for as
            many as the first of them has. None: all views have all splats.
        most_views: how many views a launch can do.
        nbytes: bytes that a splat of a view takes in a sweep's own buffers.
        memory: bytes that the kept views, and what else is taken from :attr:`budget`, may take; None: two fifths of
            what is free, or a quarter where that is the host's memory.
        breaks: numbers of views at which a group begins, whatever came before.
        others: bytes that will be taken from the budget besides: views' projections leave room for them.

    Attributes:
        groups: the numbers of the views of each.
        budget: its ``room`` is what is left of the memory.

    Raises:
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        splats: Sequence[NDArray[np.uint32]] | None,
        most_views: int,
        nbytes: int,
        memory: int | None,
        breaks: Sequence[int] = (),
        others: int = 0,
    ) -> None:
        self._rasterizer, self._cameras = rasterizer, list(cameras)
        self._splats = None if splats is None else list(splats)
        self._strides = [rasterizer.stride] * len(cameras) if splats is None else [_padded(own) for own in splats]
        self._most_views, self._breaks = most_views, sorted({*breaks, len(cameras)})
        device = rasterizer.device
        self._preparing, self._passing = PreparingMemory(device), Reused(device)
        self._of_all = self._rasterizer_of(rasterizer.parameters)
        self.budget = ViewCache(self._of_all, budget_of(device, memory), others)
        self.groups: list[range] = []
        self._kept: dict[range, _Kept] = {}
        self._refused = math.inf
        try:
            # The largest view has its room in any case.
            room = max(self.budget.room // (LEAST_SETS * (GEOMETRY + nbytes)), *self._strides, 0)
            self._prepare_all(room)
            if len(self._kept) == len(self.groups):
                self._preparing.rest()
        except BaseException:
            self.close()
            raise

    def stride(self, group: range) -> int:
        """Room for the splats of each view of a group."""
        return self._strides[group.start]

    def _prepare_all(self, room: float) -> None:
        """Form groups that have no more splats, and keep what can be kept."""
        to_do = self._dealt(0, room)
        self.budget.largest = max(map(self._size, to_do), default=0)
        while to_do:
            group = to_do.pop(0)
            try:
                self._prepare(group)
            except DeviceMemoryError:
                if len(group) == 1:
                    raise
                to_do = self._dealt(group.start, self._size(group) // 2)
            else:
                self.groups.append(group)

    def _dealt(self, first: int, room: float) -> list[range]:
        groups: list[range] = []
        for stop in self._breaks:
            while first < stop:
                together = int(min(max(room // self._strides[first], 1), self._most_views, stop - first))
                groups.append(range(first, first + together))
                first += together
        return groups

    def _size(self, group: range) -> int:
        return self.stride(group) * len(group)

    def _prepare(self, group: range) -> None:
        if self._size(group) > _MUCH_LESS * self._refused:
            with self._passed(group):
                return
        with ExitStack() as stack:
            memory = stack.enter_context(Memory(self._rasterizer.device))
            rasterizer, picks = self._preparer(group, memory)
            views = stack.enter_context(rasterizer.prepare_set(self._cameras[group.start : group.stop]))
            if not self.budget.keep(views, 0 if picks is None else picks.size):
                self._refused = self._size(group)
                return
            self._kept[group] = _Kept(views, rasterizer, picks, stack.pop_all())
        if self._splats is not None:
            for number in group:  # they lie on the device
                self._splats[number] = self._splats[number][:0].copy()

    def _preparer(self, group: range, memory: Memory) -> tuple[Rasterizer, cl.Buffer | None]:
        """What prepares a group's views, and the numbers of their splats, which the memory owns."""
        if self._splats is None:
            return self._of_all, None
        stride = self.stride(group)
        padded = np.full((len(group), stride), NO_SPLAT, np.uint32)
        for row, number in zip(padded, group, strict=True):
            row[: len(self._splats[number])] = self._splats[number]
        picks = memory.upload(padded, "the numbers of views' splats")
        return self._rasterizer_of(PickedSplats(self._rasterizer.parameters, picks, stride, apart=stride)), picks

    def _rasterizer_of(self, scene: SceneBuffers) -> Rasterizer:
        """It owns nothing: the memory in which views are prepared is this object's."""
        return Rasterizer(scene.device, scene, self._rasterizer.rules, preparing=self._preparing)

    @contextmanager
    def _passed(self, group: range) -> Iterator[Ready]:
        """Views that are not kept."""
        try:
            rasterizer, picks = self._preparer(group, self._passing)
            yield Ready(rasterizer.prepare_set(self._cameras[group.start : group.stop], self._passing), picks, True)
        finally:
            self._passing.close()  # what lies there stays until the next views come

    @contextmanager
    def ready(self, group: range) -> Iterator[Ready]:
        """Make sure that a group's views are there, with their geometry, inside the block.

        The numbers of their splats stay until the next views come.

        Raises:
            DeviceError: they do not fit the device.
        """
        kept = self._kept.get(group)
        if kept is None:
            with self._passed(group) as ready:
                yield ready
            return
        with self.budget.geometry(kept.views, kept.rasterizer) as projected:
            yield Ready(kept.views, kept.picks, projected)

    def close(self) -> None:
        """Give all device memory back."""
        for kept in self._kept.values():
            kept.owned.close()
        self._kept = {}
        self._passing.give_back()
        self._preparing.close()
        self.budget.close()


def _padded(numbers: NDArray[np.uint32]) -> int:
    return max(-(-len(numbers) // SPLAT_GROUP), 1) * SPLAT_GROUP
