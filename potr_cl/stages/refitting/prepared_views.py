"""The views of a sweep, prepared for the launches that do them, and kept as far as a budget of device memory allows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol

import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_cache import ViewCache
from potr_cl.raster.view_set import ViewSet

#: Part of the device's memory not yet taken that is the budget unless the caller sets one: of a memory of its own, and
#: of one that is the host's too.
_SHARE, _SHARE_OF_HOST = 0.4, 0.25


@dataclass(frozen=True)
class Ready:
    """A launch's views, with their geometry.

    Attributes:
        views: the views.
        anew: whether their colours were made anew since the last time.
    """

    views: ViewSet
    anew: bool


class SweptViews(Protocol):
    """Prepared views, launch by launch."""

    #: The numbers of the views of each launch.
    launches: list[range]
    #: Its ``room`` is what is left of the memory.
    budget: ViewCache

    def stride(self, numbers: range) -> int:
        """Room for the splats of each view of a launch."""
        ...

    def picks(self, numbers: range) -> cl.Buffer | None:
        """(views, stride) uint32, the numbers of the splats of each view of a launch; None: all views have all."""
        ...

    def ready(self, numbers: range) -> AbstractContextManager[Ready]:
        """Make sure that a launch's views are there, with their geometry, inside the block.

        Raises:
            DeviceError: they do not fit the device.
        """
        ...

    def close(self) -> None:
        """Give all device memory back."""
        ...


def budget_of(device: Device, memory: int | None) -> float:
    """Bytes that kept views may take: what is given, or a part of what is free."""
    free = device.info.memory - device.allocated
    of_host = device.info.kind == "cpu" or device.info.integrated
    return free * (_SHARE_OF_HOST if of_host else _SHARE) if memory is None else memory


class PreparedViews(Owner):
    """Prepared views, launch by launch.

    Args:
        rasterizer: that prepares them.
        cameras: the views.
        most_views: how many views a launch can do.
        nbytes: bytes that a view takes in a sweep's own buffers.
        breaks: numbers of views at which a launch begins, whatever came before.
        memory: bytes that the kept views, and what else is taken from :attr:`budget`, may take; None: two fifths of
            what is free, or a quarter where that is the host's memory.
        others: bytes that will be taken from the budget besides: views' projections leave room for them.

    Attributes:
        launches: the numbers of the views of each launch.
        budget: its ``room`` is what is left of the memory.

    Raises:
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        most_views: int,
        nbytes: int,
        memory: int | None,
        breaks: Sequence[int] = (),
        others: int = 0,
    ) -> None:
        self._rasterizer = rasterizer
        self._cameras = list(cameras)
        self._breaks = sorted({*breaks, len(cameras)})
        self.budget = ViewCache(rasterizer, budget_of(rasterizer.device, memory), others)
        self.launches: list[range] = []
        self._kept: dict[range, ViewSet] = {}
        #: Memory for views that are not kept, by their number.
        self._spare: dict[int, ViewSet] = {}
        try:
            with rasterizer.preparing_many():
                self._prepare_all(self.budget.most_views(most_views, nbytes))
        except BaseException:
            self.close()
            raise

    def stride(self, numbers: range) -> int:
        """That of the scene."""
        return self._rasterizer.stride

    def picks(self, numbers: range) -> cl.Buffer | None:
        """None: all views have all splats."""
        return None

    def _prepare_all(self, most: int) -> None:
        number = 0
        while number < len(self._cameras):
            stop = next(each for each in self._breaks if each > number)
            numbers = range(number, min(number + most, stop))
            try:
                views = self._prepare_again(numbers)
            except DeviceMemoryError:
                self._forget_spare()
                if most == 1:
                    raise
                most //= 2
                continue
            self._keep_if_possible(numbers, views)
            self.launches.append(numbers)
            number += len(numbers)

    def _keep_if_possible(self, numbers: range, views: ViewSet) -> None:
        if self.budget.keep(views):
            self._kept[numbers] = self._spare.pop(len(numbers))

    def _forget_spare(self) -> None:
        for views in self._spare.values():
            views.close()
        self._spare = {}

    def _prepare(self, numbers: range) -> ViewSet:
        return self._rasterizer.prepare_set([self._cameras[number] for number in numbers])

    @contextmanager
    def ready(self, numbers: range) -> Iterator[Ready]:
        """See :meth:`SweptViews.ready`."""
        kept = self._kept.get(numbers)
        views = self._prepare_again(numbers) if kept is None else kept
        with self.budget.geometry(views) as projected:
            yield Ready(views, projected or kept is None)

    def _prepare_again(self, numbers: range) -> ViewSet:
        """Views that are not kept, in the memory of others: drivers take long to give memory back and take it anew."""
        cameras = [self._cameras[number] for number in numbers]
        views = self._spare.pop(len(numbers), None)
        if views is not None:
            fits = False
            try:
                fits = self._rasterizer.prepare_again(views, cameras)
            finally:
                if not fits:
                    views.close()
            if fits:
                self._spare[len(numbers)] = views
                return views
        views = self._spare[len(numbers)] = self._prepare(numbers)
        return views

    def close(self) -> None:
        """Give all device memory back."""
        self._forget_spare()
        for views in self._kept.values():
            views.close()
        self._kept = {}
        self.budget.close()
