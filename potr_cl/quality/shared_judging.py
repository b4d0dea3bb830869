"""Judging by one device or several: :class:`SharedJudging` deals the views out. The figures are the same."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from types import TracebackType
from typing import Any, TypeVar

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.figures import ViewFigures
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.quality.judging import Judging, JudgingPart, Looks
from potr_cl.quality.metrics_device import in_batches
from potr_cl.raster.carried import Carried, HostScene, LentScene
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.views.pictures import groups_worth_it
from potr_cl.workers.dealing import shares
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Pool

#: A larger uncompressed scene is not sent to another computer to be judged there: its pictures take less time here.
_SENT_ANYWAY = 1 << 28
#: About how often several devices meet while they judge, so that one can tell how far they are.
_MEETINGS = 16

_log = logging.getLogger("potr_cl")

T = TypeVar("T")


class SharedJudging(Owner):
    """Compares candidates with one uncompressed scene.

    Args:
        device: of this process, the pool's first.
        reference: the uncompressed scene.
        views: all views that may be judged.
        looks: how pictures are made.
        pool: workers that views are shared out to; None: the device does all.
        anyway: whether other computers are sent the uncompressed scene, however large.
        coded: the uncompressed scene for other computers, where there is something smaller.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        reference: Drawable | KeptScene,
        views: Sequence[Camera],
        looks: Looks,
        pool: Pool | None = None,
        anyway: bool = False,
        coded: Carried | None = None,
    ) -> None:
        self._device, self._reference, self._views, self._looks = device, reference, list(views), looks
        self._pool = pool if pool is not None and pool.first is device else None
        self._anyway, self._coded = anyway, coded
        self._groups: SplatGroups | None = None
        here: Drawable
        if isinstance(reference, KeptScene):
            here = reference.drawable(device, reference.scene)
            there = isinstance(here, SceneBuffers)
            large = reference.is_large_for(device)
            self._groups = groups_worth_it(
                device, reference.scene, views, looks.rules.near, there, large, reference.groups
            )
        else:
            here = reference
            if isinstance(here, Scene):
                self._groups = groups_worth_it(device, here, views, looks.rules.near)
        self._own = Judging(device, here, looks, self._groups)
        self._parts: Parts | None = None
        self._part_of: dict[str, int] = {}  # who has a view, by its name; the others are this device's
        self._left = ExitStack()

    def figures(
        self,
        candidate: Drawable,
        views: Sequence[Camera],
        coded: Carried | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> list[ViewFigures]:
        """The figures of a candidate from some views, in their order.

        Args:
            candidate: to judge; where it is on a device, that is this one.
            views: among those that this object was made for.
            coded: the same for other computers: what it was coded as is smaller. None: there is nothing smaller.
            progress: called with the number of views that are done.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        return self._of_views("figures", candidate, views, coded, progress)

    def by_photographs(
        self, candidate: Drawable, views: Sequence[Camera], photographs: GroundTruth
    ) -> list[tuple[float, float]]:
        """See :meth:`potr_cl.quality.judging.Judging.by_photographs`; other computers have no photographs."""
        return self._of_views("by_photographs", candidate, views, None, lambda done: None, photographs)

    def pictures(self, candidate: Drawable, cameras: Sequence[Camera]) -> list[tuple[FloatArray, FloatArray]]:
        """(H, W, 3) float32 pictures of both scenes from some views."""
        with ExitStack() as stack:
            self._take(stack, candidate)
            return [self._own.pictures(camera) for camera in cameras]

    def _take(self, stack: ExitStack, candidate: Drawable) -> None:
        self._own.take(candidate, self._groups_of(candidate))
        stack.callback(self._own.forget)

    def _groups_of(self, candidate: Drawable) -> SplatGroups | None:
        """Those of a candidate that is too large for what a user allows, where views see little of it."""
        reference = self._reference
        if not isinstance(candidate, Scene) or not isinstance(reference, KeptScene) or self._groups is None:
            return None
        info = self._device.info
        if not info.shares_host_memory or not reference.is_large_for(self._device, candidate):
            return None
        return groups_worth_it(self._device, candidate, self._views, self._looks.rules.near, large=True)

    def _of_views(
        self,
        command: str,
        candidate: Drawable,
        views: Sequence[Camera],
        coded: Carried | None,
        progress: Callable[[int], None],
        *args: Any,
    ) -> list[Any]:
        found: dict[int, Any] = {}  # by place among the views: from Python, several may have the same name

        def note(places: Sequence[int], results: Iterable[Any]) -> None:
            for place, result in zip(places, results, strict=True):
                found[place] = result
                progress(len(found))

        with ExitStack() as stack:
            self._take(stack, candidate)
            sent = self._for_others(candidate, coded)
            if sent is not None and self._open_parts() is not None:
                self._shared_out(command, sent, views, args, note)
            # All of them, if nobody helps; or what those who are lost have left.
            left = [place for place in range(len(views)) if place not in found]
            note(left, getattr(self._own, command)([views[place] for place in left], *args))
        return [found[place] for place in range(len(views))]

    def _shared_out(
        self,
        command: str,
        sent: Carried,
        views: Sequence[Camera],
        args: Sequence[Any],
        note: Callable[[Sequence[int], Iterable[Any]], None],
    ) -> None:
        """Do the views together; if all others are lost, some are left."""
        parts = self._parts
        assert parts is not None
        dealt: list[list[int]] = [[] for _ in range(len(parts) + 1)]
        for place, camera in enumerate(views):
            dealt[self._part_of.get(camera.name, -1)].append(place)
        *theirs, mine = dealt
        most = max(map(len, dealt))
        # Views that are rendered together are not torn apart: that would take longer.
        together = max(len(next(in_batches(self._device, views), ())), 1)
        some = together * max(round(most / (together * _MEETINGS)), 1)
        try:
            _asked(partial(parts.begin, "take", sent, anew=True))
            for first in range(0, most, some):
                now = [each[first : first + some] for each in theirs]
                cameras = Each([[views[place] for place in each] for each in now])
                pending = _asked(partial(parts.begin, command, cameras, *args, logged=False))
                own = mine[first : first + some]
                note(own, getattr(self._own, command)([views[place] for place in own], *args))
                for places, results in zip(now, _asked(pending.results), strict=True):
                    note(places, results)
            _asked(partial(parts.begin, "forget", anew=True)).results()
        except _NobodyElse as lost:
            self._lose_parts(lost.error)

    def _for_others(self, candidate: Drawable, coded: Carried | None) -> Carried | None:
        """What other devices are given of a candidate; None: nothing that they could use."""
        if self._pool is None:
            return None
        if self._pool.in_process:
            return LentScene(candidate) if isinstance(candidate, SceneBuffers) else HostScene(candidate)
        if coded is not None or isinstance(candidate, SceneBuffers):
            return coded
        return HostScene(candidate, travels=True)

    def _open_parts(self) -> Parts | None:
        """The others' parts; None: they are not worth it, or lost."""
        pool = self._pool
        if pool is None or self._parts is not None:
            return self._parts
        shared = self._shared(pool)
        if shared is None:
            self._pool = None
            return None
        try:
            dealt = shares(pool, len(self._views))
            thing = self._left.enter_context(pool.shared(shared))
            given = [(thing, self._looks, self._groups)] * len(dealt.others)
            if given:
                self._parts = self._left.enter_context(Parts(pool, JudgingPart, given, names=dealt.names))
        except DeviceError as error:
            self._lose_parts(error)
            return None
        for place, numbers in enumerate(dealt.others):
            self._part_of |= {self._views[number].name: place for number in numbers}
        return self._parts

    def _shared(self, pool: Pool) -> Scene | KeptScene | Carried | None:
        """What other devices are given of the uncompressed scene; None: they had better do without."""
        reference = self._reference
        if pool.in_process:
            return LentScene(reference) if isinstance(reference, SceneBuffers) else reference
        if self._looks.lpips is not None or self._looks.ground_truth is not None:
            return None  # they are read, or computed, here
        if self._coded is not None:
            return self._coded
        scene = reference.scene if isinstance(reference, KeptScene) else reference
        if isinstance(scene, SceneBuffers):
            return None
        there = pool.has(scene) or scene.nbytes <= _SENT_ANYWAY
        return scene if there or self._anyway else None

    def _lose_parts(self, error: DeviceError) -> None:
        # What else the line says is how to mend it, which nobody has to.
        _log.warning("no worker can judge (%s); using %s instead", str(error).split(": ")[0], self._device.info)
        self._parts, self._pool, self._part_of = None, None, {}
        abandoned = _Abandoned()
        self._left.__exit__(type(abandoned), abandoned, None)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._parts = None
        self._own.close()
        self._left.__exit__(kind, error, trace)  # after Ctrl-C nobody is waited for

    def close(self) -> None:
        """Give all device memory back, here and elsewhere."""
        self.__exit__(None, None, None)


class _Abandoned(BaseException):
    """Has parts left without waiting for workers that may stand still."""


class _NobodyElse(Exception):
    """All others are lost."""

    def __init__(self, error: DeviceError) -> None:
        super().__init__(str(error))
        self.error = error


def _asked(call: Callable[[], T]) -> T:
    """What the others answer.

    Raises:
        _NobodyElse: none of them can.
    """
    try:
        return call()
    except DeviceError as error:
        raise _NobodyElse(error) from None
