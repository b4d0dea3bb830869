"""The stage "fit": splats that are left move, turn, grow and fade, so that the pictures look again as before.

:class:`Fit` first removes more splats, because the fit makes up for them. Whether that was a good trade is decided by
views that are held out: a splat is worth the error for which pruning would have let it go.
"""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Literal

from potr_cl.errors import UsageError
from potr_cl.host.signals import first_interrupt_asks
from potr_cl.opencl.discovery import Family
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import FitOptions, FitProgress, Fitted, SupportsBool, fit_scene, held_out_error
from potr_cl.stages.prune import Prune
from potr_cl.stages.refitting.targets import RenderedTargets, Targets
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option

#: By so much a fit lessens the harm of a splat that is gone, about (docs/benchmarks/fit.md).
FURTHER = 5.0
#: By how much finer than q the re-fit and the coder round, so that the PSNR is about that of q without a fit: at q = 0;
#: less and less up to q = 1, because a fit brings the more, the fewer splats are left.
FINER = 0.115
#: Steps that "auto" stands for.
STEPS: dict[Family, int] = {"cpu": 500, "gpu": 1500}
#: How often it is tried at least, each time from a lower threshold on, before it is left out.
_TRIES = 2
#: Why a fit was left out.
_TOO_FEW_VIEWS = "it needs two training views or more, because one of them is held out and tells whether it helps"
_NO_GAIN = "on the views that were held out it did not make up for the splats that were removed before it"
_INTERRUPTED = "it was interrupted before it had made up for the splats that were removed before it"


@dataclass(frozen=True)
class LeftOut:
    """That a fit was left out, so that the scene is as it would be without it.

    Attributes:
        why: as people are told it.
        ended_early: whether someone has asked it to end.
    """

    why: str
    ended_early: bool = False

    @property
    def facts(self) -> dict[str, Any]:
        """All by name."""
        return {"left_out": self.why}

    def __str__(self) -> str:
        return f"the fit was left out: {self.why}"


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
        further: times the ΔMSE_MAX of the pruning before it up to which splats are removed for the fit to make up for;
            1: none are.
        finer: by how much of its way to 1 the q is higher whose hyper-parameters the re-fit and the coder take.
        cycles: how often at most splats are removed and a fit follows: as long as that pays.
        iterations: of the pruning in each of them.
        batch, rounds, patience, rates, last, seed: see :class:`potr_cl.stages.fitting.fit.FitOptions`.

    Raises:
        UsageError: a value is out of range.
    """

    name = "fit"
    title = "fit of all parameters"

    steps: int | Literal["auto"] = option(
        0,
        Flag(
            "--fit",
            "steps in which positions, shapes, opacities and colours of the splats that are left are fitted to the "
            "uncompressed scene's pictures, so that fewer of them do: fewer bytes at about the same PSNR, and slower; "
            f"auto: {STEPS['gpu']} on a GPU, {STEPS['cpu']} on a CPU; off: none",
            "STEPS",
            _steps,
            default="the preset's: off, but auto in smallest",
        ),
    )
    further: float = option(FURTHER)
    finer: float = option(FINER)
    cycles: int = option(1)
    iterations: int = option(16)
    batch: int = option(FitOptions.batch)
    rounds: int = option(FitOptions.rounds)
    patience: int = option(FitOptions.patience)
    rates: Rates = option(FitOptions.rates)
    last: float = option(FitOptions.last)
    seed: int = option(FitOptions.seed)

    def __post_init__(self) -> None:
        _ = self._options("gpu", None)
        if not 1 <= self.further <= 1e6:
            raise UsageError(f"the fit's further pruning is {self.further:g}, it must be from 1 to 1,000,000")
        if not 0 <= self.finer <= 1:
            raise UsageError(f"the fit's finer quality is {self.finer:g}, it must be from 0 to 1")
        for name in ("cycles", "iterations"):
            if not 1 <= getattr(self, name) <= 1000:
                raise UsageError(f"the fit's {name} are {getattr(self, name)}, they must be from 1 to 1000")

    @property
    def asked_for(self) -> bool:
        return self.on and self.steps != 0

    def quality(self, q: float) -> float:
        return q + self.finer * (1 - q)

    def steps_on(self, family: Family) -> int:
        """The most steps on a device of a family."""
        return STEPS[family] if self.steps == "auto" else self.steps

    def _options(self, family: Family, memory: int | None) -> FitOptions:
        return FitOptions(
            steps=self.steps_on(family),
            batch=self.batch,
            rounds=self.rounds,
            patience=self.patience,
            rates=self.rates,
            last=self.last,
            seed=self.seed,
            memory=memory,
        )

    def run(self, state: State, bench: Workbench) -> State:
        """Remove splats, fit, and leave a :class:`potr_cl.stages.fitting.fit.Fitted` in ``learnt``.

        Or, where the state stays as it was, a :class:`LeftOut`: too few views are given for any to be held out, or
        those say that the fit does not pay.
        """
        if len(state.views) - state.added < 2:
            return state.having_learnt(self.name, LeftOut(_TOO_FEW_VIEWS))
        bench.progress("fit", 0.0)
        with ExitStack() as stack:
            stack.callback(bench.progress, "fit", 1.0)
            source = bench.drawable(state.source)
            rasterizer = stack.enter_context(Rasterizer(bench.opened, source, background=bench.background))
            asked = stack.enter_context(first_interrupt_asks())
            return self._cycles(state, bench, RenderedTargets(rasterizer, state.views), asked)

    def _cycles(self, state: State, bench: Workbench, targets: Targets, asked: SupportsBool) -> State:
        """Remove splats and fit by turns, each time up to a lower threshold, and keep what costs least."""
        price: float | None = state.learnt.get("price")
        worth = price or 0.0
        without = held_out_error(bench.opened, state.scene, state.views, targets, state.added, bench.background)
        best, least, taken = state, without + worth * len(state.scene), None
        tries = 1 if price is None else max(self.cycles, _TRIES)
        accepted = 0
        for number in range(tries):
            start = best if price is None else self._pruned(best, price * self.further ** (0.5**number), bench)

            def progress(done: int, steps: int, number: int = number) -> None:
                bench.progress("fit", min((number + done / steps) / self.cycles, 0.99))

            fitted = self._fitted(start, bench, targets, progress, asked)
            cost = fitted.error + worth * len(fitted.scene)
            if price is None or cost < least:
                if taken is not None:
                    steps, kept = taken.steps + fitted.steps, taken.kept + fitted.kept
                    fitted = dataclasses.replace(fitted, steps=steps, kept=kept)
                taken = dataclasses.replace(fitted, spared=len(state.scene) - len(fitted.scene), without=without)
                best, least = dataclasses.replace(start, scene=fitted.scene, geometry=None), cost
                accepted += 1
                if accepted == self.cycles:
                    break
            elif taken is not None:
                break
            if asked:
                break
            if number + 1 < tries:
                bench.tell("fit: once more, with fewer splats removed before it")
        if taken is None:
            return state.having_learnt(self.name, LeftOut(_INTERRUPTED if asked else _NO_GAIN, bool(asked)))
        return best.having_learnt(self.name, taken)

    def _pruned(self, state: State, limit: float, bench: Workbench) -> State:
        """The state without the splats that a fit will make up for."""
        parameters = dataclasses.replace(bench.parameters, delta_mse_max=limit)
        alone = dataclasses.replace(bench, parameters=parameters, interludes=(), progress=lambda what, done: None)
        left = Prune(iterations=self.iterations).run(state, alone)
        return dataclasses.replace(left, learnt=state.learnt)

    def _fitted(
        self, state: State, bench: Workbench, targets: Targets, progress: FitProgress, asked: SupportsBool
    ) -> Fitted:
        options = self._options(bench.opened.family, bench.memory)
        if "compact" in state.learnt:
            options = dataclasses.replace(options, rates=dataclasses.replace(options.rates, ac=0.0))
        return fit_scene(
            bench.opened, state.scene, state.views, targets, options, state.added, bench.background, progress,
            bench.tell, asked,
        )  # fmt: skip
