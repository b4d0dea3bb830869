"""A fit of all parameters of a reduced scene to target pictures: :func:`fit_scene`.

Pruning leaves splats where they were: here they move, turn, grow and fade, so that together they show again what the
uncompressed scene shows. Adam goes down the mean squared error of a few views at a time (adam.py, derivatives.py). Some
views are held out; after each round these tell whether the scene has become better, and the best round is kept. So the
result is never worse on them than the scene was before.

The targets are pictures of the uncompressed scene, so any number of views between the true ones may be targets too.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.adam import UNROUNDED, Adam, Factors, Limits, Rates
from potr_cl.stages.fitting.fitted import Fitted, decibels
from potr_cl.stages.fitting.together import Batch, DeviceFit, Ground, SharedFit, kept_pictures
from potr_cl.stages.held_out import share_out
from potr_cl.views.budget import target_bytes
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import TargetPictures, Targets

logger = logging.getLogger("potr_cl")

#: The opacity below which a splat is not drawn is 1/255, of logit -5.54: none falls so far that nothing can bring it
#: back. Single precision tells opacities up to a logit of 16 from 1.
_LEAST_LOGIT, _GREATEST_LOGIT = -5.5, 16.0
#: Differences are multiplied by a power of two while they are summed up, so that they are about this large.
_USUAL_DIFFERENCE = 1 / 8
_LARGEST_UNIT = 2.0**20
#: Of the first step, means in parts of a usual splat's size, for a scene whose mean squared error has this root. All
#: rates go with the root, because a step in all parameters at once must not do more harm than it can mend; but no rate
#: is larger than these, or smaller than a part of them, before the pace is looked for.
RATES = Rates(means=0.005, log_scales=1e-2, quaternions=2e-3, opacity_logits=4e-2, dc=5e-3, ac=5e-4)
_USUAL_ERROR, _SLOWEST = 1 / 128, 0.02
#: A pace is tried for so many steps, if they are no more than such a part of all; the slowest and the fastest one; and
#: by how many times two of them differ.
_TRIED, _AT_MOST, _PACES, _FASTER = 32, 0.25, (1 / 16, 8.0), 2.0
#: Rates are multiplied by this after a round in which held-out views became worse.
_SLOWER = 0.5


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        steps: in all, at the most.
        batch: views that a step looks at. More steps with fewer views each come farther; with one view, some come to
            nothing (docs/benchmarks/time_error.md).
        rounds: after how many equal parts of the steps the held-out views are looked at.
        patience: the fit ends after so many rounds in which they did not become better.
        rates: of the first step, if the scene is far from the targets; smaller where it is near to them. ``means`` in
            parts of a usual splat's size.
        start: part of the rates that it begins with.
        pace: by how many times these are larger; None: as much as helps in the first steps, which are tried.
        last: part of these that is left at the end; they fall by the same factor in each step, and by half after a
            round in which the held-out views became worse.
        seed: of the order of the views.
        memory: bytes of device memory that target pictures may take; None: a quarter of what is free.

    Raises:
        UsageError: a value is out of range.
    """

    steps: int = 1500
    batch: int = 2
    rounds: int = 10
    patience: int = 3
    rates: Rates = RATES
    start: float = 1.0
    pace: float | None = 1.0
    last: float = 0.1
    seed: int = 0
    memory: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= 10**6:
            raise UsageError(f"{self.steps} steps of the fit: it must be from 0 to 1,000,000")
        for name in ("batch", "rounds", "patience"):
            if not 1 <= getattr(self, name) <= 1000:
                raise UsageError(f"the fit's {name} is {getattr(self, name)}, it must be from 1 to 1000")
        if self.pace is not None and not 0 < self.pace <= 1000:
            raise UsageError(f"the fit's pace is {self.pace:g}, it must be above 0 and at most 1000")
        for name in ("start", "last"):
            if not 0 < getattr(self, name) <= 1:
                raise UsageError(f"the fit's {name} rate is {getattr(self, name):g}, it must be above 0 and at most 1")


class SupportsBool(Protocol):
    """What is true or false whenever it is looked at."""

    def __bool__(self) -> bool: ...


#: Called with the steps done, and their greatest number.
FitProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class Following:
    """Who follows a fit.

    Attributes:
        progress: called after each step.
        tell: called with a line for each round.
        asked: whether to end before the next step, with the best of the whole rounds; looked at after each.
    """

    progress: FitProgress = lambda done, steps: None
    tell: Callable[[str], None] = logger.debug
    asked: SupportsBool = False


@dataclass(frozen=True)
class Sight:
    """What a fit looks at.

    Attributes:
        targets: the picture that each of them should show; pictures that are kept already stay so.
        added: how many of the views, the last ones, lie between those that were given: they are never held out.
        help_from: do some of the views; the result is the same.
        judges: numbers of the views to judge by; None: some of the given ones are held out.
        fit_to: numbers of the views to look at; None: those that do not judge.
    """

    cameras: Sequence[Camera]
    targets: Targets | TargetPictures
    added: int = 0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    help_from: HelpFrom | None = None
    judges: Sequence[int] | None = None
    fit_to: Sequence[int] | None = None

    @property
    def held_out(self) -> Sequence[int]:
        """Numbers of the views to judge by."""
        return share_out(len(self.cameras) - self.added, self.added)[1] if self.judges is None else self.judges

    def pictures(self, device: Device, memory: int | None) -> AbstractContextManager[TargetPictures]:
        """The pictures, of which so many bytes are kept for as long as the context lasts, unless they are already."""
        if isinstance(self.targets, TargetPictures):
            return nullcontext(self.targets)
        return kept_pictures(device, self.cameras, self.targets, memory)


def fit_scene(
    device: Device,
    scene: Scene,
    sight: Sight,
    options: FitOptions | None = None,
    following: Following | None = None,
    factors: Factors = UNROUNDED,
) -> Fitted:
    """Fit all parameters of a scene to pictures of some views.

    Args:
        scene: where the fit begins.
        factors: what a file will round shapes and opacities with. All is looked at as it is rounded, but what comes of
            it is not. The scene as :class:`potr_cl.stages.fitting.adam.Adam` takes it then.

    Raises:
        UsageError: there are fewer than two given views, so that none can be held out.
        DeviceError: the scene does not fit the device.
    """
    options, cameras, held_out = options or FitOptions(), sight.cameras, sight.held_out
    fit_to = sight.fit_to or [number for number in range(len(cameras)) if number not in set(held_out)]
    if not held_out or not fit_to:
        raise UsageError("a fit needs two training views or more: one of them is held out and tells whether it helps")
    rates = dataclasses.replace(options.rates, means=options.rates.means * _usual_size(scene))
    ground = Ground(scene, cameras, sight.background, rates, _limits(scene), factors)
    following = following or Following()
    with sight.pictures(device, options.memory) as pictures:
        if options.memory is None and options.steps * options.batch >= len(fit_to):
            pictures.fill([(number,) for number in (*held_out, *fit_to)])

        with (
            DeviceFit(device, ground, pictures) as descent,
            Judges(
                device, descent.derivatives.rasterizer, cameras, pictures, held_out, options.memory is None
            ) as judges,
        ):

            def run(options: FitOptions, following: Following, tried: bool = False) -> Fitted:
                helping = sight.help_from if options.steps and not tried else None
                with SharedFit(descent, ground, helping, options.memory, min(options.batch, len(fit_to))) as steps:
                    return _run(options, steps, descent.adam, judges, fit_to, following, scene if tried else None)

            def trial(options: FitOptions, following: Following) -> Fitted:
                found = run(options, following, tried=True)
                descent.restart()
                return found

            if options.pace is None:
                options = dataclasses.replace(options, pace=_best_pace(options, trial, following))
            return run(options, following)


def _best_pace(options: FitOptions, run: Callable[[FitOptions, Following], Fitted], following: Following) -> float:
    """The longest steps that help: longer ones if held-out views gain more by them at first, and where usual ones do
    harm, the first shorter ones that do none, or the shortest.

    What suits all depends on how many of the views show a splat, and on how far these are from their targets. In a
    large scene, of which each shows little, steps that are right for an object make it worse. But where steps help,
    shorter ones help more at first, and come less far in the end.
    """
    if not tries_paces(options.steps):
        return 1.0
    quiet = Following(lambda *_: following.progress(0, options.steps), lambda line: None, following.asked)

    def errors(pace: float) -> tuple[float, float]:
        """Before, and after; where someone asks to end meanwhile, this pace is no good."""
        tried = dataclasses.replace(options, steps=_TRIED, rounds=1, last=1.0, pace=pace)
        found = run(tried, quiet)
        if found.ended_early:
            return found.errors[0], math.inf
        said = f"{decibels(found.errors[-1]):.2f} dB after {_TRIED} steps at a pace of {pace:g}"
        following.tell(f"fit: held-out views {said}, {decibels(found.errors[0]):.2f} dB at first")
        return found.errors[0], found.errors[-1]

    slowest, fastest = _PACES
    pace, (before, least) = 1.0, errors(1.0)
    while not least < before and pace > slowest and not following.asked:
        pace /= _FASTER
        _, least = errors(pace)
    while 1 <= pace < fastest and not following.asked:
        _, found = errors(pace * _FASTER)
        if not found < least:
            break
        pace, least = pace * _FASTER, found
    return pace


def tries_paces(steps: int) -> bool:
    """Whether a fit of so many steps tries how long they may be."""
    return _AT_MOST * steps >= _TRIED


def held_out_error(device: Device, scene: Drawable, sight: Sight) -> float:
    """The mean squared error of a scene in the views that a fit which looks at these holds out."""
    with (
        Rasterizer(device, scene, background=sight.background) as rasterizer,
        sight.pictures(device, 0) as pictures,
        Judges(device, rasterizer, sight.cameras, pictures, sight.held_out) as judges,
    ):
        return judges.error()


def _run(
    options: FitOptions, steps: SharedFit, adam: Adam, judges: Judges, fit_to: Sequence[int], following: Following,
    scene: Scene | None = None,
) -> Fitted:  # fmt: skip
    """Take the steps. ``scene``: what the result has for its scene, where nobody asks for it."""
    errors, asked = [judges.error()], following.asked
    first_pace = 1.0 if options.pace is None else options.pace
    pace = first_pace * options.start * min(max(math.sqrt(errors[0]) / _USUAL_ERROR, _SLOWEST), 1.0)
    slowing = options.last ** (1 / max(options.steps - 1, 1))
    kept = done = since = 0
    order = batches(fit_to, options.batch, options.seed)
    rounds = min(options.rounds, options.steps)
    for round_number in range(1, rounds + 1):
        end = options.steps * round_number // rounds
        unit = _unit(errors[-1])
        while done < end and not asked:
            steps.step(Batch(next(order), unit, pace * slowing**done))
            done += 1
            following.progress(done, options.steps)
        if done < end:
            break
        with adam.averaged():
            errors.append(judges.error())
            if errors[-1] < min(errors[:-1]):
                adam.keep()
                kept, since = done, 0
            else:
                since += 1
                # Roundings that a fit begins with make it worse at first.
                if round_number > 1 and not errors[-1] < errors[-2]:
                    pace *= _SLOWER
        now, first = decibels(errors[-1]), decibels(errors[0])
        following.tell(f"fit: {done} steps, held-out views {now:.2f} dB, {first:.2f} dB at first")
        if since >= options.patience:
            break
    found = adam.kept() if scene is None else scene
    return Fitted(found, done, kept, tuple(errors), len(judges), bool(asked), pace=first_pace)


def _usual_size(scene: Scene) -> float:
    """The median of the splats' middle standard deviations, world units."""
    a, b, c = scene.log_scales.T
    middle = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return math.exp(min(float(np.median(middle.astype(np.float64))), 80.0))


def _limits(scene: Scene) -> Limits:
    """No splat grows larger or thinner than the largest and the thinnest one were."""
    return Limits(
        (float(scene.log_scales.min()), float(scene.log_scales.max())),
        (_LEAST_LOGIT, max(_GREATEST_LOGIT, float(scene.opacity_logits.max()))),
    )


def _unit(error: float) -> float:
    """By what differences of this mean square are multiplied while they are summed up."""
    if not 0 < error < math.inf:
        return 1.0
    return min(max(2.0 ** math.floor(math.log2(_USUAL_DIFFERENCE / math.sqrt(error))), 1.0), _LARGEST_UNIT)


#: Work-items that sum up a picture's squared differences, and those of a group.
_ITEMS, _GROUP = 1 << 14, 64
#: Values of the pictures that are rendered together, if it is not one: a GPU prepares several views in one go.
_RENDERED = 1 << 24


class Judges(Owner):
    """Views that are held out of a fit.

    Args:
        rasterizer: of the scene, which may change between two calls.
        pictures: what they should show.
        held_out: the numbers of those that judge.
        keeps: whether memory that their views are prepared in is kept from one time to the next.
    """

    def __init__(
        self,
        device: Device,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        pictures: TargetPictures,
        held_out: Sequence[int],
        keeps: bool = True,
    ) -> None:
        self._keeps = keeps
        self._device, self._rasterizer, self._cameras, self._pictures = device, rasterizer, cameras, pictures
        self._held_out = list(held_out)
        self._kernel = device.shared_kernel("fit/squared_error.cl", "squared_error")
        self._memory = Memory(device)
        self._sums = self._memory.allocate(4 * _ITEMS * max(len(self), 1), "the judges' sums")
        self._images = Scratch(device, "the judges' pictures")
        self._views: ViewSet | None = None

    def __len__(self) -> int:
        return len(self._held_out)

    def error(self) -> float:
        """The mean squared error of the scene as it is now, all views the same."""
        place = 0
        for numbers in self._together():
            cameras = [self._cameras[number] for number in numbers]
            self._images.reserve(sum(map(target_bytes, cameras)))
            if self._keeps:
                self._views, former = None, self._views
                self._views = self._rasterizer.render_again(cameras, self._images.buffer, former=former)
            else:
                self._rasterizer.render_into(cameras, self._images.buffer)
            first = 0
            for number in numbers:
                self._kernel.bind(
                    picture=self._images.buffer,
                    first=first,
                    target=self._pictures.of([number]),
                    count=self._values(number),
                    sums=self._sums,
                    first_sum=_ITEMS * place,
                )
                self._kernel.launch((_ITEMS,), (_GROUP,))
                first += self._values(number)
                place += 1
        sums = self._device.download(self._sums, (len(self), _ITEMS), np.float32).sum(axis=1, dtype=np.float64)
        return float(np.mean(sums / [self._values(number) for number in self._held_out]))

    def _together(self) -> Iterator[list[int]]:
        """The views, some at a time."""
        some: list[int] = []
        for number in self._held_out:
            if some and sum(map(self._values, (*some, number))) > _RENDERED:
                yield some
                some = []
            some.append(number)
        if some:
            yield some

    def _values(self, number: int) -> int:
        camera = self._cameras[number]
        return 3 * camera.width * camera.height

    def close(self) -> None:
        """Give all device memory back."""
        if self._views is not None:
            self._views.close()
            self._views = None
        self._images.close()
        self._memory.close()


def batches(numbers: Sequence[int], size: int, seed: int) -> Iterator[list[int]]:
    """Views in batches, for ever: all of them in a random order, then all again in another.

    Args:
        numbers: of the views, at least one.
        size: of a batch; less if there are not so many views.
        seed: of the order.
    """
    rng = np.random.default_rng(seed)
    size = min(size, len(numbers))
    waiting: list[int] = []
    while True:
        while len(waiting) < size:
            waiting += [int(number) for number in rng.permutation(numbers)]
        yield waiting[:size]
        waiting = waiting[size:]
