"""The stage "fit": splats that are left move, turn, grow and fade, so that the pictures look again as before."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from potr_cl.errors import UsageError
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import FitOptions, LeftOut, fit_scene
from potr_cl.stages.refitting.targets import RenderedTargets
from potr_cl.stages.stage import Flag, Stage, State, Workbench, option


def _steps(text: str) -> int:
    if text == "off":
        return 0
    if not text.isdecimal() or len(text) > 9:
        raise UsageError(f"--fit is '{text[:40]}': give a number of steps, or off")
    return int(text)


@dataclass(frozen=True)
class Fit(Stage):
    """Fit all parameters of the splats that are left to the uncompressed scene's pictures.

    Where colours have been compacted, their AC coefficients stay as they are, because others would not be sparse.

    Attributes:
        steps: the most steps of the fit; with 0 it is left out.
        batch, rounds, patience, rates, last, seed: see :class:`potr_cl.stages.fitting.fit.FitOptions`.

    Raises:
        UsageError: a value is out of range.
    """

    name = "fit"
    title = "fit of all parameters"

    steps: int = option(
        0,
        Flag(
            "--fit",
            "steps in which positions, shapes, opacities and colours of the splats that are left are fitted to the "
            "uncompressed scene's pictures: fewer bytes, and much slower; 1000 to 2000 do for most scenes; off: none",
            "STEPS",
            _steps,
            default="off",
        ),
    )
    batch: int = option(FitOptions.batch)
    rounds: int = option(FitOptions.rounds)
    patience: int = option(FitOptions.patience)
    rates: Rates = option(FitOptions.rates)
    last: float = option(FitOptions.last)
    seed: int = option(FitOptions.seed)

    def __post_init__(self) -> None:
        _ = self._options(None)

    @property
    def asked_for(self) -> bool:
        return self.on and self.steps > 0

    def _options(self, memory: int | None) -> FitOptions:
        return FitOptions(
            steps=self.steps,
            batch=self.batch,
            rounds=self.rounds,
            patience=self.patience,
            rates=self.rates,
            last=self.last,
            seed=self.seed,
            memory=memory,
        )

    def run(self, state: State, bench: Workbench) -> State:
        """Fit, and leave a :class:`potr_cl.stages.fitting.fit.Fitted` in ``learnt``.

        Or, where too few views are given for any to be held out, a :class:`potr_cl.stages.fitting.fit.LeftOut`.
        """
        if len(state.views) - state.added < 2:
            return state.having_learnt(self.name, LeftOut())
        bench.progress("fit", 0.0)
        options = self._options(bench.memory)
        if "compact" in state.learnt:
            options = dataclasses.replace(options, rates=dataclasses.replace(options.rates, ac=0.0))
        with Rasterizer(bench.opened, bench.drawable(state.source), background=bench.background) as rasterizer:
            fitted = fit_scene(
                bench.opened,
                state.scene,
                state.views,
                RenderedTargets(rasterizer, state.views),
                options,
                state.added,
                bench.background,
                lambda done, steps: bench.progress("fit", 0.99 * done / steps),
            )
        bench.progress("fit", 1.0)
        return dataclasses.replace(state, scene=fitted.scene, geometry=None).having_learnt(self.name, fitted)
