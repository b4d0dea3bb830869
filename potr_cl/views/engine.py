"""Brings the groups of a plan in, keeps or streams them, on one device: :class:`ViewEngine`.

A *use* says what is computed with a group: it makes its own thing of a set of prepared views (:class:`Ready`), with all
buffers and kernels that it needs. What the engine knows is where splats come from (:mod:`potr_cl.views.subsets`), what
fits (:mod:`potr_cl.views.budget`), and in which sets views are prepared: as many as one launch does.

- :attr:`ViewEngine.resident`: sets that stay on the device, with what the use has made of them.
- :attr:`ViewEngine.streamed`: groups that do not. :meth:`ViewEngine.stream` opens the splats of one, and
  :meth:`ViewEngine.prepared` prepares its sets, one after the other in the same memory.
- :meth:`ViewEngine.walk`: both, for a use to which it makes no difference, with :meth:`ViewEngine.ready` for each.

Pruning is a use (:mod:`potr_cl.stages.pruning.removal`): lists of stale tiles, targets, and integer totals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import MARGIN, Memory, Owner, Reused
from potr_cl.raster.view_set import ViewSet
from potr_cl.views.budget import GEOMETRY, ViewCache, target_bytes
from potr_cl.views.plan import ViewPlan
from potr_cl.views.subsets import Left, SplatSource, Subset
from potr_cl.views.visibility import ViewGroup


class Work(Protocol):
    """What a use makes of a set of views."""

    @property
    def nbytes(self) -> int:
        """Bytes of its own that stay with the set."""
        ...

    def close(self) -> None:
        """Give them back, and the views' own."""


W = TypeVar("W", bound=Work)


@dataclass(frozen=True)
class Ready(Generic[W]):
    """A set of views, prepared with the splats of their group.

    Attributes:
        numbers: of the views among all.
        work: what the use has made of it.
        geometry: shapes and colours, its own or, where it has none, those that it shares with other sets.
    """

    numbers: Sequence[int]
    subset: Subset
    views: ViewSet
    work: W
    cache: ViewCache | None = None

    @property
    def geometry(self) -> tuple[cl.Buffer, cl.Buffer]:
        if self.shares and self.cache is not None and self.cache.shared is not None:
            return self.cache.shared
        return self.views.shapes, self.views.colours

    @property
    def shares(self) -> bool:
        """Whether it has no geometry of its own, so that it is projected whenever it is looked at."""
        return self.views.shapes is None


@dataclass(frozen=True)
class Launch(Generic[W]):
    """Views that are looked at together.

    Attributes:
        numbers: of the views among all.
        resident: what is there of them; None: they are streamed.
        group: of the streamed ones.
    """

    numbers: tuple[int, ...]
    resident: Ready[W] | None
    group: ViewGroup | None = None

    @property
    def size(self) -> int:
        """Splats that they project at most, each view's counted for itself; padded if the plan's are."""
        of_view = self.resident.views.stride if self.resident else self.group.count if self.group else 0
        return len(self.numbers) * of_view


class ViewEngine(Owner, Generic[W]):
    """The views of one device.

    Args:
        source: of the groups' splats; the engine's from now on.
        plan: of those that are looked at here.
        attach: makes the use's work of numbers, subset and prepared views, which are the work's to close from then on.
        most_views: how many views one launch can do.
        progress: called with the views prepared and their number.

    Attributes:
        resident, streamed: see above.
        idle: numbers of views that draw nothing.
        passing: bytes that a set of streamed views takes while it is there, at most, where they take turns in the same
            memory. Others may have what that leaves.
    """

    def __init__(
        self,
        source: SplatSource,
        cameras: Sequence[Camera],
        plan: ViewPlan,
        attach: Callable[[Sequence[int], Subset, ViewSet, Memory | None, cl.Buffer | None], W],
        most_views: int,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.device: Device = source.device
        self.source, self.cameras, self.plan, self._attach = source, cameras, plan, attach
        self.most_views = most_views
        self.resident: list[Ready[W]] = []
        self.idle = list(plan.idle)
        self.passing = 0
        #: One streamed group after the other takes its splats and its views from these.
        self._splats, self._views = source.streams_in(), source.streams_in()
        others: list[ViewGroup] = []
        done, count, told = len(plan.idle), len(plan.numbers), -1
        with ExitStack() as owned:
            for owner in (source, self._splats, self._views):
                owned.enter_context(owner)
            self._owned = owned
            with source.foreseen(plan.groups) if plan.groups else nullcontext():
                for group in plan.groups:

                    def said(some: int, before: int = done) -> None:
                        nonlocal told
                        if progress is not None and before + some > told:
                            told = before + some
                            progress(told, count)

                    room = plan.budget.room(group)
                    if room >= 0:
                        others += self._bring_in(group, room, said)
                    else:
                        plan.budget.took(group, 0)
                        others.append(group)
                    done += len(group.numbers)
                    said(len(group.numbers))
                self.device.finish()
            source.forget_scratch()
            self.streamed = plan.together(others)
            self._owned = owned.pop_all()

    def _bring_in(self, group: ViewGroup, room: float, said: Callable[[int], None]) -> list[ViewGroup]:
        """Prepare the views of a group, and keep those that fit; returns the groups of the others."""
        try:
            return self._bring_in_whole(group, room, said)
        except DeviceMemoryError:
            half = len(group.numbers) // 2
            if not half or not group.most:
                raise
        halves = [replace(group, numbers=numbers) for numbers in (group.numbers[:half], group.numbers[half:])]
        return [left for some in halves for left in self._bring_in(some, room, said)]

    def _bring_in_whole(self, group: ViewGroup, room: float, said: Callable[[int], None]) -> list[ViewGroup]:
        device, plan = self.device, self.plan
        before, some, most = device.allocated, list[Ready[W]](), 0
        subset: Subset | None = None
        with ExitStack() as stack, suppress(DeviceMemoryError) if plan.singly else nullcontext():
            memory = stack.enter_context(Memory(device))
            subset = self.source.open(stack, memory, group)
            if subset is None:
                self.idle += group.numbers
                plan.budget.took(group, 0)
                return []
            cache = plan.budget.cache
            if cache is None and not plan.singly:
                cache = stack.enter_context(ViewCache(device, room))
            some, most = self._prepare_all(group, subset, cache, room, before, said)
            if some:
                self._owned.enter_context(stack.pop_all())  # what all sets of the group need; the sets go first
                for ready in some:
                    self._owned.callback(ready.work.close)
                self.source.forget([number for ready in some for number in ready.numbers])
                if plan.copies_rest:
                    self.source.rest(subset)
        self.resident += some
        own = 0 if subset is None or subset.scene is None or subset.scene.rests else subset.scene.nbytes
        plan.budget.took(group, device.allocated - before - own if some else 0)
        kept = {number for ready in some for number in ready.numbers}
        left = tuple(number for number in group.numbers if number not in kept)
        return [replace(group, numbers=left, most=most)] if left else []

    def _prepare_all(
        self, group: ViewGroup, subset: Subset, cache: ViewCache | None, room: float, before: int,
        said: Callable[[int], None],
    ) -> tuple[list[Ready[W]], int]:  # fmt: skip
        """The sets of a group that fit, and how many views one has at most."""
        found: list[Ready[W]] = []
        most, first, numbers = max(group.most, 1), 0, group.numbers
        if cache is not None and not group.most:
            largest = max(target_bytes(self.cameras[number]) for number in numbers)
            most = cache.most_views(self.most_views, GEOMETRY * subset.rasterizer.stride + largest)
        try:
            with subset.rasterizer.preparing_many():
                while first < len(numbers):
                    some, there = numbers[first : first + most], self.device.allocated
                    try:
                        work, views = self._prepare(some, subset)
                    except DeviceMemoryError:
                        if most == 1 or group.most:
                            raise
                        most //= 2
                        continue
                    try:
                        fits = (
                            self.device.allocated - before <= room
                            if cache is None
                            else cache.keep(views, work.nbytes)
                        )  # fmt: skip
                    except BaseException:
                        work.close()
                        raise
                    if fits:
                        found.append(Ready(some, subset, views, work, cache))
                    else:
                        named = 0 if subset.numbers is None else subset.numbers.size
                        self.passing = max(self.passing, int(MARGIN * (self.device.allocated - there + named)))
                        work.close()
                    first += len(some)
                    said(first)
        except BaseException:
            for ready in found:
                ready.work.close()
            raise
        return found, most

    def _prepare(
        self, numbers: Sequence[int], subset: Subset, memory: Memory | None = None, target: cl.Buffer | None = None
    ) -> tuple[W, ViewSet]:
        views = subset.rasterizer.prepare_set([self.cameras[number] for number in numbers], memory)
        return self._attach(numbers, subset, views, memory, target), views

    def project(self, ready: Ready[W]) -> None:
        """Enqueue the projection of a resident set, if it has none of its own."""
        if ready.shares:
            self.source.project(ready.subset, ready.views, *ready.geometry)

    @contextmanager
    def stream(self, group: ViewGroup, left: Left | None) -> Iterator[Subset | None]:
        """The splats of a streamed group on the device, inside the block; see :meth:`SplatSource.open`."""
        with ExitStack() as stack:
            yield self.source.open(stack, stack.enter_context(self._splats), group, left)

    @contextmanager
    def prepared(self, numbers: Sequence[int], subset: Subset, target: cl.Buffer | None = None) -> Iterator[Ready[W]]:
        """A set of a streamed group's views, inside the block."""
        work, views = self._prepare(numbers, subset, self._views, target)
        try:
            yield Ready(numbers, subset, views, work)
        finally:
            work.close()

    def sets(self, group: ViewGroup) -> list[tuple[int, ...]]:
        """The numbers of a group's views, set by set."""
        most = group.most or self.most_views
        return [group.numbers[first : first + most] for first in range(0, len(group.numbers), most)]

    def walk(self) -> list[Launch[W]]:
        """All views."""
        resident = [Launch(tuple(each.numbers), each) for each in self.resident]
        return [*resident, *(Launch(some, None, group) for group in self.streamed for some in self.sets(group))]

    @contextmanager
    def ready(self, launch: Launch[W]) -> Iterator[Ready[W]]:
        """Views with their geometry, inside the block; streamed ones' splats' numbers stay until the next ones'."""
        if launch.resident is not None:
            self.project(launch.resident)
            yield launch.resident
            return
        assert launch.group is not None
        # The group that is opened is these views', so that its splats are in their order.
        with self.stream(replace(launch.group, numbers=launch.numbers), None) as subset:
            assert subset is not None
            with self.prepared(launch.numbers, subset) as ready:
                yield ready

    def give_back(self) -> None:
        """Give back what streamed groups leave for the next ones."""
        for memory in (self._splats, self._views):
            if isinstance(memory, Reused):
                memory.give_back()

    def close(self) -> None:
        self.give_back()
        self._owned.close()
