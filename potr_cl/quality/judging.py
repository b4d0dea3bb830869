"""Judging scenes by one uncompressed scene, on one device or several: :class:`Judging`.

A view's figures are found on one device (:class:`JudgingPart`), from sums over parts of its pictures that are the same
on every device of a kind. So it makes no difference who judges which view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import pyopencl as cl

from potr_cl.formats.images import Colour
from potr_cl.host.threads import Ahead
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.figures import Against, ViewFigures
from potr_cl.quality.metrics import Lpips, psnr
from potr_cl.quality.metrics_device import in_batches
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import DeviceScene, HostScene, ResidentScene, SceneHandle, scene_on
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.views.pictures import SeenRasterizer, groups_worth_it, rasterizer_of
from potr_cl.views.targets import RenderedTargets, Room, TargetPictures
from potr_cl.workers.helping import Helping
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Part, Pool, shares

#: Bytes of the uncompressed scene's pictures that are kept from one candidate to the next; others are rendered again.
CACHED_PICTURES = 1 << 30
#: A larger uncompressed scene is not sent to another computer to be judged there: its pictures take less time here.
_SENT_ANYWAY = 1 << 28
#: About how often several devices meet while they judge, so that one can tell how far they are.
_MEETINGS = 16


@dataclass(frozen=True)
class Looks:
    """How pictures are made, and what besides they are compared with.

    Attributes:
        rules: of the rasterizer.
        ground_truth, lpips: as of :class:`potr_cl.quality.figures.Against`.
        remember: whether the uncompressed scene's pictures are kept for the next candidate.
    """

    background: Colour = (0.0, 0.0, 0.0)
    rules: RasterRules = INRIA
    ground_truth: Mapping[str, Path] | None = None
    lpips: Lpips | None = None
    remember: bool = False


class JudgingPart(Part):
    """Compares candidates with one uncompressed scene, on one device.

    Args:
        memory: of no account: pictures come and go.
        reference: the uncompressed scene; its pictures are made when they are first wanted.
        views: all views that may be judged.
        groups: of the reference's splats, where views see little of it.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        reference: Drawable | ResidentScene | SceneHandle,
        looks: Looks,
        views: Sequence[Camera],
        groups: SplatGroups | None = None,
    ) -> None:
        self._device, self._looks, self._views, self._groups = device, looks, views, groups
        self._against = Against(device, looks.background, looks.ground_truth, looks.lpips)
        self._taken, self._opened = ExitStack(), ExitStack()
        self._candidate: Rasterizer | SeenRasterizer | None = None
        self._reference: Rasterizer | SeenRasterizer | None = None
        with ExitStack() as owned:
            self._scene = owned.enter_context(scene_on(device, reference))
            room = min(CACHED_PICTURES, device.info.memory // 16) if looks.remember else 0
            self._pictures = owned.enter_context(TargetPictures(device, views, Room(room), self))
            self._owned = owned.pop_all()

    def take(self, candidate: Drawable | SceneHandle, groups: SplatGroups | None = None) -> None:
        """Judge a candidate from now on, until :meth:`forget`.

        Args:
            groups: of its splats, where it is better drawn by what views see of it.

        Raises:
            DeviceError: it does not fit the device.
        """
        self.forget()
        with ExitStack() as stack:
            scene = stack.enter_context(scene_on(self._device, candidate))
            self._candidate = self._rasterizer(stack, scene, groups)
            self._taken = stack.pop_all()

    def forget(self) -> None:
        """Give the candidate's memory back, and the reference's where its pictures may be all that is needed of it."""
        self._candidate = None
        self._taken.close()
        if self._looks.remember:
            self._reference = None
            self._opened.close()

    def figures(self, numbers: Sequence[int], told: Callable[[], None] = lambda: None) -> list[ViewFigures]:
        """The figures of some views, in their order.

        Raises:
            As :meth:`potr_cl.quality.figures.Against.figures`.
        """
        found = []
        with TargetPictures(self._device, self._views, Room(0), RenderedTargets(self._taken_one, self._views)) as shown:
            for each in self._against.figures(self._pictures, shown, self._views, numbers):
                found.append(each)
                told()
        return found

    def by_photographs(
        self, numbers: Sequence[int], photographs: GroundTruth, told: Callable[[], None] = lambda: None
    ) -> list[tuple[float, float]]:
        """PSNR in decibels of both scenes' pictures against the photograph of each view, the reference's first.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        found = []
        with Ahead(photographs.picture, [self._views[number] for number in numbers]) as read:
            for number, (_, photograph) in zip(numbers, read, strict=True):
                reference, candidate = self.pictures(number)
                found.append((psnr(reference, photograph), psnr(candidate, photograph)))
                told()
        return found

    def pictures(self, number: int) -> tuple[FloatArray, FloatArray]:
        """(H, W, 3) float32 pictures of both scenes from a view."""
        camera = self._views[number]
        return self._original.render(camera)[0], self._taken_one.render(camera)[0]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """The reference's pictures, as a :class:`potr_cl.views.targets.Targets`."""
        RenderedTargets(self._original, self._views).into(numbers, buffer, start)

    def _rasterizer(self, stack: ExitStack, scene: Drawable, groups: SplatGroups | None) -> Rasterizer | SeenRasterizer:
        found = rasterizer_of(self._device, scene, self._looks.rules, self._looks.background, groups)
        stack.callback(found.close)
        return found

    @property
    def _taken_one(self) -> Rasterizer | SeenRasterizer:
        assert self._candidate is not None, "there is no candidate"
        return self._candidate

    @property
    def _original(self) -> Rasterizer | SeenRasterizer:
        if self._reference is None:
            self._reference = self._rasterizer(self._opened, self._scene, self._groups)
        return self._reference

    def close(self) -> None:
        self.forget()
        self._opened.close()
        self._owned.close()


class Judging(Owner):
    """Compares candidates with one uncompressed scene.

    Args:
        views: all views that may be judged.
        pool: workers that views are shared out to; None: the device does all.
        anyway: whether other computers are sent the uncompressed scene, however large.
        coded: the uncompressed scene for other computers, where there is something smaller.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        reference: Drawable | ResidentScene,
        views: Sequence[Camera],
        looks: Looks,
        pool: Pool | None = None,
        anyway: bool = False,
        coded: SceneHandle | None = None,
    ) -> None:
        self.device, self._reference, self._views, self._looks = device, reference, list(views), looks
        self._pool = pool if pool is not None and pool.first is device else None
        self._anyway, self._coded = anyway, coded
        kept = reference if isinstance(reference, ResidentScene) else None
        here = reference if not isinstance(reference, ResidentScene) else reference.drawable(device, reference.scene)
        self._groups: SplatGroups | None = None
        if kept is not None:
            there, large = isinstance(here, SceneBuffers), kept.is_large_for(device)
            self._groups = groups_worth_it(device, kept.scene, views, looks.rules.near, there, large, kept.groups)
        elif isinstance(here, Scene):
            self._groups = groups_worth_it(device, here, views, looks.rules.near)
        self._own = JudgingPart(device, None, here, looks, self._views, self._groups)
        self._helping, self._asked_for = Helping(device, "judge"), False
        self._part_of: dict[int, int] = {}  # who has a view; the others are this device's

    def figures(
        self,
        candidate: Drawable,
        numbers: Sequence[int] | None = None,
        coded: SceneHandle | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> list[ViewFigures]:
        """The figures of a candidate from some views, in their order.

        Args:
            candidate: to judge; where it is on a device, that is this one.
            numbers: of the views; None: all.
            coded: the same for other computers: what it was coded as is smaller. None: there is nothing smaller.
            progress: called with the part of the views that is done.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        return self._of_views("figures", candidate, numbers, coded, progress)

    def by_photographs(self, candidate: Drawable, photographs: GroundTruth) -> list[tuple[float, float]]:
        """See :meth:`JudgingPart.by_photographs`, of all views; other computers have no photographs."""
        return self._of_views("by_photographs", candidate, None, None, lambda done: None, photographs)

    def pictures(self, candidate: Drawable, numbers: Sequence[int]) -> list[tuple[FloatArray, FloatArray]]:
        """(H, W, 3) float32 pictures of both scenes from some views."""
        with ExitStack() as stack:
            self._take(stack, candidate)
            return [self._own.pictures(number) for number in numbers]

    def _take(self, stack: ExitStack, candidate: Drawable) -> None:
        self._own.take(candidate, self._groups_of(candidate))
        stack.callback(self._own.forget)

    def _groups_of(self, candidate: Drawable) -> SplatGroups | None:
        """Those of a candidate that is too large for what a user allows, where views see little of it."""
        reference = self._reference
        if not isinstance(candidate, Scene) or not isinstance(reference, ResidentScene) or self._groups is None:
            return None
        if not self.device.info.shares_host_memory or not reference.is_large_for(self.device, candidate):
            return None
        return groups_worth_it(self.device, candidate, self._views, self._looks.rules.near, large=True)

    def _of_views(
        self,
        command: str,
        candidate: Drawable,
        numbers: Sequence[int] | None,
        coded: SceneHandle | None,
        progress: Callable[[float], None],
        *args: Any,
    ) -> list[Any]:
        numbers = range(len(self._views)) if numbers is None else numbers
        found: dict[int, Any] = {}
        done = 0

        def told(some: int = 1) -> None:
            nonlocal done
            done += some
            progress(done / len(numbers))

        def own(some: Sequence[int]) -> None:
            found.update(zip(some, getattr(self._own, command)(some, *args, told), strict=True))

        with ExitStack() as stack:
            self._take(stack, candidate)
            sent = self._for_others(candidate, coded)
            helping, parts = self._helping, None if sent is None else self._open_parts()
            if parts is not None:
                helping.begin("take", sent, anew=True)
                for mine, theirs in self._meetings(numbers, len(parts)):
                    pending = helping.begin(command, Each(theirs), *args, logged=False)
                    own(mine)
                    results = helping.results(pending)
                    if results is None:
                        break
                    for some, of_these in zip(theirs, results, strict=True):
                        found.update(zip(some, of_these, strict=True))
                        told(len(some))
                helping.results(helping.begin("forget", anew=True))
            # All of them, if nobody helps; or what those who are lost have left.
            if left := [number for number in numbers if number not in found]:
                own(left)
        return [found[number] for number in numbers]

    def _meetings(self, numbers: Sequence[int], others: int) -> list[tuple[list[int], list[list[int]]]]:
        """Who does which views until they meet, from meeting to meeting: this device's first."""
        dealt: list[list[int]] = [[] for _ in range(others + 1)]
        for number in numbers:
            dealt[self._part_of.get(number, -1)].append(number)
        most = max(map(len, dealt))
        # Views that are rendered together are not torn apart: that would take longer.
        together = max(len(next(in_batches(self.device, [self._views[number] for number in numbers]), ())), 1)
        some = together * max(round(most / (together * _MEETINGS)), 1)
        now = [[each[first : first + some] for each in dealt] for first in range(0, most, some)]
        return [(mine, theirs) for *theirs, mine in now]

    def _for_others(self, candidate: Drawable, coded: SceneHandle | None) -> SceneHandle | None:
        """What other devices are given of a candidate; None: nothing that they could use."""
        if self._pool is None:
            return None
        if self._pool.in_process:
            return DeviceScene(candidate) if isinstance(candidate, SceneBuffers) else HostScene(candidate)
        if coded is not None or isinstance(candidate, SceneBuffers):
            return coded
        return HostScene(candidate, travels=True)

    def _open_parts(self) -> Parts | None:
        """The others' parts; None: they are not worth it, or lost."""
        pool = self._pool
        if pool is None or self._asked_for:
            return self._helping.parts
        self._asked_for = True
        shared = self._shared(pool)

        def opened(stack: ExitStack) -> Parts | None:
            dealt = shares(pool, len(self._views))
            self._part_of = {number: place for place, numbers in enumerate(dealt.others) for number in numbers}
            thing = stack.enter_context(pool.shared(shared))
            given = [(thing, self._looks, self._views, self._groups)] * len(dealt.others)
            return stack.enter_context(Parts(pool, JudgingPart, given, names=dealt.names)) if given else None

        return None if shared is None else self._helping.open(opened)

    def _shared(self, pool: Pool) -> Scene | ResidentScene | SceneHandle | None:
        """What other devices are given of the uncompressed scene; None: they had better do without."""
        reference = self._reference
        if pool.in_process:
            return DeviceScene(reference) if isinstance(reference, SceneBuffers) else reference
        if self._looks.lpips is not None or self._looks.ground_truth is not None:
            return None  # they are read, or computed, here
        if self._coded is not None:
            return self._coded
        scene = reference.scene if isinstance(reference, ResidentScene) else reference
        if isinstance(scene, SceneBuffers):
            return None
        there = pool.has(scene) or scene.nbytes <= _SENT_ANYWAY
        return scene if there or self._anyway else None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._own.close()
        self._helping.__exit__(kind, error, trace)

    def close(self) -> None:
        """Give all device memory back, here and elsewhere."""
        self.__exit__(None, None, None)
