"""The stage "fit": splats that are left move, turn, grow and fade, so that the pictures look again as before.

:class:`Fit` first removes more splats, because the fit makes up for them. Whether that was a good trade is decided by
views that are held out: a splat is worth the error for which pruning would have let it go.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import partial
from threading import Event
from typing import Any, Literal

from potr_cl.errors import UsageError
from potr_cl.host.process import first_interrupt_asks
from potr_cl.host.threads import in_background
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.discovery import Family
from potr_cl.quality.photographs import GroundTruth
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import (
    FitOptions,
    Following,
    Sight,
    SupportsBool,
    fit_scene,
    held_out_error,
    tries_paces,
)
from potr_cl.stages.fitting.fitted import Fitted, LeftOut
from potr_cl.stages.fitting.photographs import fit_to_photographs, longer
from potr_cl.stages.fitting.settling import PicturesOf, Settling, settle
from potr_cl.stages.fitting.together import kept_pictures
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import RenderedTargets, targets_of

#: Times the threshold of pruning up to which a fit makes up for splats, about (docs/benchmarks/findings.md): for this
#: threshold, and for others as much more as its root is larger, because a fit brings the more, the fewer splats are
#: left; but not more than the most.
FURTHER, _AT_THRESHOLD, _MOST_FURTHER = 3.5, 10**-9.3, 20.0
#: By how much of its way to 1 the q is higher whose steps suit a fit, from that q on; below it less, with the square:
#: few splats are left there, and finer steps for these cost more than they bring (docs/benchmarks/findings.md).
FINER, _FINER_FROM = 0.18, 0.5
#: Steps that "auto" stands for.
STEPS: dict[Family, int] = {"cpu": 1000, "gpu": 1600}
#: Views between for each given one that a fit looks at: they keep it from fitting the given ones too closely.
BETWEEN: dict[Family, float] = {"cpu": 1.0, "gpu": 3.0}
#: Steps of a fit to photographs that "auto" stands for: their number's square, divided by this, because few photographs
#: are followed too closely soon; and the most.
_SQUARE = 10
_MOST_STEPS: dict[Family, int] = {"cpu": 250, "gpu": 1000}
#: Views of each of these.
_PHOTOGRAPHS = 4
#: Iterations of the pruning before a fit.
ITERATIONS = 16
#: Part of the steps in each cycle but the last.
_FIRST = 0.25
#: What a splat costs as a multiple of the error for which pruning would have let it go: what it adds to the error when
#: it is rounded comes on top.
_WORTH = 1.25
#: What is left of the cost has to be less than this part of it: a few held-out views are no exact judges.
_LESS = 0.97
#: A fit that has made up for no splats has to leave less than this part of the held-out views' error: the re-fit takes
#: most of what a little one mends off by itself, and splats that have moved have fewer coefficients that are 0.
_LESS_ALONE = 0.7
#: A larger scene that other computers have not got is not sent to them for a fit.
_SENT_ANYWAY = 1 << 28
#: Why a fit was left out.
_TOO_FEW_VIEWS = "it needs two training views or more, because one of them is held out and tells whether it helps"
_NO_GAIN = "on the views that were held out it did not make up for the splats that were removed before it"
_LITTLE_GAIN = "on the views that were held out it gained little beyond what the re-fit of the colours does"
_INTERRUPTED = "it was interrupted before it had gained enough"


class Sought:
    """Views between for a fit, which a thread of its own looks for.

    Args:
        state: whose given views they lie between.
        each: so many for each of these.
    """

    def __init__(self, state: State, each: float) -> None:
        self.each, self._stopped = each, Event()
        seek = partial(views_between, known=state.results.known, run=self._until_stopped)
        self.views: Future[list[Camera]] = in_background(seek, state.source, state.given, each)

    def stop(self) -> None:
        """Look no further: nobody wants them any more."""
        self._stopped.set()

    def _until_stopped(self, work: Callable[[Any], Any], of: Iterable[Any]) -> Iterator[Any]:
        for each in of:
            if self._stopped.is_set():
                raise CancelledError
            yield work(each)


def _steps(text: str) -> int | Literal["auto"]:
    if text in ("auto", "off"):
        return "auto" if text == "auto" else 0
    if not text.isdecimal() or len(text) > 9:
        raise UsageError(f"--fit is '{text[:40]}': give a number of steps, auto, or off")
    return int(text)


@dataclass(frozen=True)
class Fit(Stage):
    """Fit all parameters of the splats that are left to the uncompressed scene's pictures.

    Where pruning has a threshold, splats are removed up to a higher one before. The result is only taken if the mean
    squared error of held-out views, and what all splats cost at the price that q sets, are less together than without
    it. Where colours have been compacted, their AC coefficients stay as they are, because others would not be sparse.

    Attributes:
        steps: the most steps of the fit; with 0 it is left out. "auto": as many as pay on the device.
        further: times the ΔMSE_MAX of the pruning before it up to which splats are removed for the fit to make up for,
            where that is 10^-9.3; with its root more for a larger one. 0: none are removed.
        finer: by how much of its way to 1 the q is higher whose hyper-parameters the re-fit and the coder take, if it
            is 0.5 or higher; below that less.
        cycles: how often splats are removed and a fit follows, each time up to a higher threshold; before the first of
            several, none are.
        between: views between that the fit looks at, for each given view, unless there are more already. "auto": as
            many as pay on the device.
        photograph_steps: in which what came of it is fitted to photographs, where the re-fit has some; 0: it is not.
            "auto": as many as pay on the device.
        choosing, rounding: how far what is left is fitted once more after the choice of coefficients and the rounding
            of geometry (:class:`potr_cl.stages.fitting.settling.Settling`).
        compared: whether two files say if it pays, where its gain is small (potr_cl/pipeline/run.py).
        rounds, batch: see :class:`potr_cl.stages.fitting.fit.FitOptions`.

    Raises:
        UsageError: a value is out of range.
    """

    name = "fit"
    title = "fit of all parameters"

    steps: int | Literal["auto"] = option(
        0,
        Flag(
            "--fit",
            "steps of optimising positions, shapes, opacities and colours of the remaining splats, so that fewer are "
            "needed: smaller files at about the same PSNR, slower; "
            f"auto: {STEPS['gpu']} on a GPU, {STEPS['cpu']} on a CPU; off: none",
            "STEPS",
            _steps,
            default="the preset's: off, but auto in smallest",
        ),
    )
    further: float = option(FURTHER)
    finer: float = option(FINER)
    cycles: int = option(2)
    between: float | Literal["auto"] = option("auto")
    photograph_steps: int | Literal["auto"] = option("auto")
    rounds: int = option(FitOptions.rounds)
    batch: int = option(FitOptions.batch)
    choosing: float = option(0.3)
    rounding: float = option(0.15)
    compared: bool = option(True)

    def __post_init__(self) -> None:
        _ = self._options("gpu", None), FitOptions(steps=self.photograph_steps_on("gpu", 1))
        if not 0 <= self.further <= 1e6:
            raise UsageError(f"the fit's further pruning is {self.further:g}, it must be from 0 to 1,000,000")
        if self.between != "auto" and not 0 <= self.between <= 100:
            raise UsageError(f"the fit's views between are {self.between:g}, they must be from 0 to 100")
        if not 0 <= self.finer <= 1:
            raise UsageError(f"the fit's finer quality is {self.finer:g}, it must be from 0 to 1")
        for name in ("choosing", "rounding"):
            if not 0 <= getattr(self, name) <= 10:
                raise UsageError(f"the fit's {name} is {getattr(self, name):g}, it must be from 0 to 10")
        if not 1 <= self.cycles <= 1000:
            raise UsageError(f"the fit's cycles are {self.cycles}, they must be from 1 to 1000")

    @property
    def asked_for(self) -> bool:
        return self.on and self.steps != 0

    def quality(self, q: float) -> float:
        return q + self.finer * min(q / _FINER_FROM, 1.0) ** 2 * (1 - q)

    def steps_on(self, family: Family) -> int:
        """The most steps on a device of a family."""
        return STEPS[family] if self.steps == "auto" else self.steps

    def further_steps_on(self, family: Family) -> int:
        """The most steps after the choice of coefficients and the roundings."""
        return round((self.choosing + 2 * self.rounding) * self.steps_on(family))

    def photograph_steps_on(self, family: Family, photographs: int) -> int:
        """The steps of the fit to so many photographs on a device of a family."""
        if self.photograph_steps == "auto":
            return min(max(photographs * photographs // _SQUARE, 1), _MOST_STEPS[family])
        return self.photograph_steps

    def views_on(self, family: Family) -> float:
        """Views between that it looks at on a device of a family, for each given one."""
        return BETWEEN[family] if self.between == "auto" else self.between

    def _options(self, family: Family, memory: int | None) -> FitOptions:
        return FitOptions(steps=self.steps_on(family), batch=self.batch, rounds=self.rounds, memory=memory)

    def limit(self, price: float) -> float:
        """The threshold up to which splats are removed for a fit to make up for, where pruning had this one."""
        further = self.further * math.sqrt(price / _AT_THRESHOLD)
        return price * min(max(further, 1.0), _MOST_FURTHER)

    def begun(self, state: State, bench: Workbench) -> State:
        each = self._each(state, bench)
        return state.with_results(sought=Sought(state, each)) if len(state.given) > 1 and each else state

    def run(self, state: State, bench: Workbench) -> State:
        """Remove splats, fit, and leave a :class:`potr_cl.stages.fitting.fitted.Fitted` in ``results``.

        Or, where the state stays as it was, a :class:`LeftOut`: too few views are given for any to be held out, or
        those say that the fit does not pay.
        """
        if len(state.views) - state.added < 2:
            return state.with_results(fitted=LeftOut(_TOO_FEW_VIEWS))
        bench.progress("fit", 0.0)
        with ExitStack() as stack:
            stack.callback(bench.progress, "fit", 1.0)
            asked = stack.enter_context(first_interrupt_asks())
            seen = self._looking_between(state, bench)

            def pictures(scene: Scene, views: Sequence[Camera]) -> AbstractContextManager[RenderedTargets]:
                visibility = bench.visibility_of_source(state, views) if scene is state.source else None
                return targets_of(bench.opened, bench.drawable(scene), views, bench.background, visibility)

            rendered = stack.enter_context(pictures(state.source, seen.views))
            targets = bench.rendered_before(state, rendered, seen.views)
            sight = Sight(seen.views, targets, seen.added, bench.background, _help_from(bench, state))
            if bench.memory is None:  # else pruning needs all that is allowed, between two fits
                kept = stack.enter_context(kept_pictures(bench.opened, seen.views, targets))
                sight = dataclasses.replace(sight, targets=kept)
            found = self._cycles(seen, bench, sight, asked)
            found = dataclasses.replace(found, views=state.views, added=state.added)
            if bench.photographs is not None and self.photograph_steps != 0 and not asked:
                found = self._to_photographs(found, bench, asked)
            told = found.results.fitted
            # Others do not round as finely then as is known here.
            if asked or not (isinstance(told, Fitted) and told.spared):
                return found
            if found.truth is not None:
                rendered = stack.enter_context(pictures(found.truth, seen.views))
                sight = dataclasses.replace(sight, targets=rendered, help_from=_help_from(bench, found))
            return self._settled(found, bench, sight, partial(pictures, found.goal), asked)

    def _looking_between(self, state: State, bench: Workbench) -> State:
        """The state with the views that the fit looks at."""
        given = state.given
        sought, each = state.results.sought, self._each(state, bench)
        if not each:
            return state
        if sought is not None and sought.each == each:
            added = sought.views.result()
        else:  # with threads it takes twice as long
            added = views_between(state.source, given, each, known=state.results.known)
        return dataclasses.replace(state, views=(*given, *added), added=len(added))

    def _each(self, state: State, bench: Workbench) -> float:
        """How many views between it looks at for each given one, where the state has fewer; else 0."""
        each = self.views_on(bench.opened.family)
        return 0.0 if is_virtual(state.given) or each * len(state.given) <= state.added else each

    def _cycles(self, state: State, bench: Workbench, sight: Sight, asked: SupportsBool) -> State:
        """Remove splats and fit by turns, each time up to a higher threshold, and keep what costs least."""
        price = state.results.price
        worth = 0.0 if price is None else _WORTH * price
        without = held_out_error(bench.opened, state.scene, sight)
        least = plain = without + worth * len(state.scene)
        further = 1.0
        if price is not None:
            least *= _LESS
            further = self.limit(price) / price
        last = best = state
        taken: Fitted | None = None
        pace: float | None = None
        steps_of = self._steps_of_cycles(bench.opened.family, price is not None and further > 1)
        total, done = sum(steps_of) + self.further_steps_on(bench.opened.family), 0
        for number, steps in enumerate(steps_of):
            part = number / (len(steps_of) - 1) if len(steps_of) > 1 else 1.0
            if price is not None and further > 1 and part > 0:
                last = self._pruned(last, price * further**part, bench)

            def progress(now: int, _steps: int, before: int = done) -> None:
                bench.progress("fit", 0.99 * (before + now) / total)

            options = dataclasses.replace(
                self._options(bench.opened.family, bench.memory),
                steps=steps,
                pace=pace,
                rates=self._sparse(FitOptions.rates, last),
            )
            fitted = fit_scene(bench.opened, last.scene, sight, options, Following(progress, bench.tell, asked))
            pace = fitted.pace if tries_paces(steps) else None
            last, done = dataclasses.replace(last, scene=fitted.scene, geometry=None), done + steps
            cost = fitted.error + worth * len(fitted.scene)
            spared = len(state.scene) - len(fitted.scene)
            if cost < least and (spared or fitted.error < _LESS_ALONE * without):
                best, least = last, cost
                taken = dataclasses.replace(fitted, spared=spared, without=without, cost=cost / plain)
            if asked:
                break
        if taken is None:
            why = _INTERRUPTED if asked else _NO_GAIN if len(steps_of) > 1 else _LITTLE_GAIN
            return state.with_results(fitted=LeftOut(why, bool(asked)))
        return best.with_results(fitted=taken)

    def _settled(
        self, state: State, bench: Workbench, sight: Sight, pictures: PicturesOf, asked: SupportsBool
    ) -> State:
        """Choose coefficients and round geometry, with what is left fitted once more in between."""
        told = state.results.fitted
        assert isinstance(told, Fitted)
        # Where usual steps do harm, these do, too.
        options = dataclasses.replace(self._options(bench.opened.family, bench.memory), pace=min(told.pace, 1.0))
        settling = Settling(self.choosing, self.rounding)
        done, total = options.steps, options.steps + self.further_steps_on(bench.opened.family)

        def progress(steps: int) -> None:
            nonlocal done
            done += steps
            bench.progress("fit", min(done / total, 1.0) * 0.99)

        then, errors = settle(state, bench, sight, pictures, settling, options, asked, progress)
        return then.with_results(fitted=dataclasses.replace(told, settled=errors))

    def _steps_of_cycles(self, family: Family, removing: bool) -> list[int]:
        """The steps of the fit in each cycle."""
        steps = self.steps_on(family)
        cycles = min(self.cycles, steps) if removing else 1
        first = max(int(_FIRST * steps), 1)
        return [*[first] * (cycles - 1), max(steps - first * (cycles - 1), 1)]

    def _to_photographs(self, state: State, bench: Workbench, asked: SupportsBool) -> State:
        """Go on with photographs as the targets, if others that are held out agree; and so do later stages."""
        assert bench.photographs is not None
        given = state.given
        photographs = GroundTruth(bench.photographs, given, bench.background)
        views, family = photographs.of(given), bench.opened.family
        options = dataclasses.replace(
            self._options(family, bench.memory),
            steps=self.photograph_steps_on(family, len(views)),
            batch=_PHOTOGRAPHS,
            rates=self._sparse(longer(FitOptions.rates), state),
        )
        bench.progress("fit to photographs", 0.0)
        following = Following(lambda done, steps: bench.progress("fit to photographs", done / steps), bench.tell, asked)
        found = fit_to_photographs(
            bench.opened, state.scene, views, photographs, options, bench.background, following
        )  # fmt: skip
        bench.progress("fit to photographs", 1.0)
        told = state.results.fitted
        assert told is not None
        then = state.with_results(fitted=dataclasses.replace(told, photographs=found))
        if found.scene is None:
            return then
        return dataclasses.replace(then, scene=found.scene, truth=found.scene, geometry=None)

    def _sparse(self, rates: Rates, state: State) -> Rates:
        """The rates, without those that would change coefficients which compaction has chosen."""
        return dataclasses.replace(rates, ac=0.0) if state.results.compacted else rates

    def _pruned(self, state: State, limit: float, bench: Workbench) -> State:
        """The state without the splats that a fit will make up for."""
        parameters = dataclasses.replace(bench.parameters, delta_mse_max=limit)
        alone = dataclasses.replace(
            bench, parameters=parameters, interludes=(), progress=lambda what, done: None, shown_again=False
        )
        left = Prune(iterations=ITERATIONS).run(state, alone)
        return dataclasses.replace(left, results=state.results)


def _help_from(bench: Workbench, state: State) -> HelpFrom | None:
    """Who helps to fit to the pictures of a state's goal."""
    pool, goal = bench.pool, state.goal
    if pool is None or not (pool.in_process or pool.has(goal) or goal.nbytes <= _SENT_ANYWAY):
        return None
    return HelpFrom(pool, bench.as_shared(goal))
