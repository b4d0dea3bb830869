"""The steps of a fit, by one device or by several together: :class:`DeviceFit`, :class:`SharedFit`.

Every device has all parameters and takes every step. What a step costs are the views' sums, so the views of a batch are
dealt out, and each device tells the others its views' sums. These are integers that do not depend on who found them,
and each adds them up in the order of the batch: the bits are those of one device.

A device that is made anew on the way, because another one was lost, does not know what the others do by now; it is
given all of the first one's numbers then.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.opencl.narrow import Narrowed
from potr_cl.raster.resident import ResidentScene, scene_on
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.fitting.adam import UNROUNDED, Adam, Factors, Limits, Rates
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import Room, TargetPictures, Targets, targets_of
from potr_cl.workers.helping import Helping
from potr_cl.workers.parts import Each, Parts
from potr_cl.workers.pool import Part

#: Part of a device's memory not yet taken that target pictures may take unless the caller says how much.
_SHARE = 0.25
#: So many steps are taken together, then alone, to see which is faster; before, so many that do not count.
_TRIED, _FIRST = 6, 2

#: Sums of some of a batch's views, by their places.
Sums = list[tuple[int, Narrowed]]


@dataclass(frozen=True)
class Ground:
    """What a fit begins with.

    Attributes:
        scene: whose parameters move.
        rates, limits, factors: as of :class:`potr_cl.stages.fitting.adam.Adam`.
    """

    scene: Scene
    cameras: Sequence[Camera]
    background: tuple[float, float, float]
    rates: Rates
    limits: Limits
    factors: Factors = UNROUNDED


@dataclass(frozen=True)
class Batch:
    """What a step looks at.

    Attributes:
        unit: as of :meth:`potr_cl.stages.fitting.derivatives.PictureDerivatives.add`.
        part: of the rates that the step is long.
    """

    numbers: Sequence[int]
    unit: float
    part: float


def kept_pictures(
    device: Device, cameras: Sequence[Camera], targets: Targets, memory: int | None = None
) -> TargetPictures:
    """Target pictures for fits, kept in so many bytes of device memory (None: a quarter of what is free).

    The caller closes them.
    """
    room = Room((device.info.memory - device.allocated) * _SHARE if memory is None else memory)
    return TargetPictures(device, cameras, room, targets)


class DeviceFit(Owner):
    """A fit on one device.

    Args:
        pictures: the targets; the caller's.

    Attributes:
        derivatives, adam: of the scene.
        taken: steps, so far.
    """

    def __init__(self, device: Device, ground: Ground, pictures: TargetPictures) -> None:
        self.device, self.taken = device, 0
        self._cameras, self._pictures = ground.cameras, pictures
        with ExitStack() as owned:
            self.derivatives = owned.enter_context(
                PictureDerivatives(device, ground.scene, background=ground.background)
            )
            buffers, columns = self.derivatives.rasterizer.parameters, self.derivatives.columns
            self.adam = owned.enter_context(
                Adam(device, ground.scene, buffers, columns, ground.rates, ground.limits, ground.factors)
            )
            self.adam.give()
            self._owned = owned.pop_all()

    def restart(self) -> None:
        """Begin anew."""
        self.adam.restart()
        self.taken = 0

    def step(self, batch: Batch) -> None:
        """Take a step alone."""
        self.derivatives.add(self._of(batch), self._pictures.of(batch.numbers), unit=batch.unit)
        self._take(batch)

    def sums(self, batch: Batch, places: Sequence[int]) -> Sums:
        """The sums of some of a batch's views."""
        if not places:
            return []
        target = self._pictures.of([batch.numbers[place] for place in places])
        return self.derivatives.sums(self._of(batch), places, target, batch.unit)

    def follow(self, batch: Batch, sums: Sums) -> None:
        """Take the step for which these are the sums."""
        self.derivatives.add_sums(self._of(batch), sums, batch.unit)
        self._take(batch)

    def _take(self, batch: Batch) -> None:
        self.adam.step(self.derivatives.gradient, batch.part)
        self.taken += 1

    def _of(self, batch: Batch) -> list[Camera]:
        return [self._cameras[number] for number in batch.numbers]


class FitPart(Part):
    """A :class:`DeviceFit` that follows another one.

    Args:
        memory: bytes of its memory that target pictures may take; None: a quarter of what is free.
        source: the scene whose pictures are the targets.
    """

    def __init__(self, device: Device, memory: int | None, ground: Ground, source: Drawable | ResidentScene) -> None:
        with ExitStack() as owned:
            scene = owned.enter_context(scene_on(device, source))
            targets = owned.enter_context(targets_of(device, scene, ground.cameras, ground.background))
            pictures = owned.enter_context(kept_pictures(device, ground.cameras, targets, memory))
            self._descent = owned.enter_context(DeviceFit(device, ground, pictures))
            self._owned = owned.pop_all()

    def sums(self, taken: int, before: tuple[Batch, Sums] | None, batch: Batch, places: Sequence[int]) -> Sums | None:
        """The sums of some of a batch's views.

        Args:
            taken: how many steps the others have taken.
            before: the last one of these, which is taken here too.
            batch, places: the batch, and the views.

        Returns:
            The sums; None: it has not been there in all steps, see :meth:`adopt`.
        """
        descent = self._descent
        if before is not None and descent.taken == taken - 1:
            descent.follow(*before)
        return descent.sums(batch, places) if descent.taken == taken else None

    def adopt(self, taken: int, state: Sequence[FloatArray]) -> None:
        """Go on from another one's numbers after so many steps."""
        self._descent.adam.adopt(taken, state)
        self._descent.taken = taken


class SharedFit(Helping):
    """A fit that others help with, each a :class:`FitPart`, as long as this is faster.

    Args:
        descent: the first device's.
        help_from: where they are from, which is told if they make it slower; None: there are none.
        memory: bytes of a device's memory that target pictures may take; None: a quarter of what is free.
        batch: views of a step: there is no use for more workers.
    """

    def __init__(
        self, descent: DeviceFit, ground: Ground, help_from: HelpFrom | None, memory: int | None, batch: int
    ) -> None:
        super().__init__(descent.device, "fit")
        self._descent, self._help_from, self._takes_part = descent, help_from, False
        self._before: tuple[Batch, Sums] | None = None
        self._steps = 0
        self._since, self._seconds = 0.0, list[float]()
        if help_from is not None and not help_from.slower and help_from.pool.first is descent.device:
            self._takes_part = help_from.pool.in_process
            self.open(partial(_parts, help_from, ground, memory, batch))

    def step(self, batch: Batch) -> None:
        """Take a step."""
        self._look_at_the_time()
        if self.parts is None or _FIRST + _TRIED <= self._steps < _FIRST + 2 * _TRIED:
            self._descent.step(batch)
        else:
            self._step_together(batch)
        self._steps += 1

    def _step_together(self, batch: Batch) -> None:
        descent, count = self._descent, len(batch.numbers)
        assert self.parts is not None
        doing = len(self.parts) + self._takes_part
        dealt = [list(range(first, count, doing)) for first in range(doing)]
        own, others = (dealt[0], dealt[1:]) if self._takes_part else ([], dealt)
        before = self._before if descent.taken else None

        pending = self.begin("sums", descent.taken, before, batch, Each(others), logged=False)
        sums = descent.sums(batch, own)
        for place, found in enumerate(self.results(pending) or []):
            if found is None:
                found = self.asked(partial(self._adopted, batch, place, others[place]))
            sums += found or []
        known = {place for place, _ in sums}
        sums += descent.sums(batch, [place for place in range(count) if place not in known])
        descent.follow(batch, sums)
        self._before = batch, sums

    def _adopted(self, batch: Batch, place: int, places: Sequence[int], parts: Parts) -> Sums:
        """The sums of a part that has not been there in all steps."""
        parts.ask(place, "adopt", self._descent.taken, self._descent.adam.state())
        found: Sums = parts.ask(place, "sums", self._descent.taken, None, batch, places)
        return found

    def _look_at_the_time(self) -> None:
        """Measure both ways once, and stay with the faster one: the bits are the same."""
        if self.parts is None or self._steps not in (_FIRST, _FIRST + _TRIED, _FIRST + 2 * _TRIED):
            return
        with self._descent.device.errors("failed while computing"):
            self._descent.device.queue.finish()
        now = time.perf_counter()
        self._seconds.append(now - self._since)
        self._since = now
        if len(self._seconds) == 3 and self._seconds[1] > self._seconds[2]:
            self.close()
            if self._help_from is not None:
                self._help_from.slower = True


def _parts(help_from: HelpFrom, ground: Ground, memory: int | None, batch: int, stack: ExitStack) -> Parts | None:
    pool = help_from.pool
    count = min(len(pool.workers()), batch - pool.in_process)
    given = [stack.enter_context(pool.shared(each)) for each in (ground, help_from.source)]
    if count <= 0:
        return None
    parts = stack.enter_context(Parts(pool, FitPart, [given] * count, memory))
    parts.ready()
    return parts
