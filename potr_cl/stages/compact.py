"""The stage "compact": sparse colours, splat by splat (paper section "Spherical harmonics energy compaction")."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import get_args

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import standpoints
from potr_cl.stages.compaction.ridge import ColourModel, CompactionOptions, Compactor, Weighting
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.helpers import importances_of, measurement
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import Flag, Importances, Interlude, Stage, State, Workbench, option


@dataclass(frozen=True)
class Compact(Stage):
    """Make the SH coefficients sparse, so that the colours change little in the training views.

    Attributes:
        at: the part of the pruning iterations after which it is done, so that later ones see its effect.
        lam, alpha: replace q's λ and α.
        colour_model, weighting, two_pass: see :class:`potr_cl.stages.compaction.ridge.CompactionOptions`.

    Raises:
        UsageError: a value is out of range.
    """

    name = "compact"
    title = "compaction of the colours"

    on: bool = option(
        True, Flag("--compact", "make the SH coefficients sparse, splat by splat", default="where there is no re-fit")
    )
    at: float = option(
        0.75,
        Flag("--compact-at", "fraction of the pruning iterations after which colours are compacted", "PART", float),
    )
    lam: float | None = option(
        None, Flag("--lambda", "how strongly AC coefficients are pulled to 0", "X", float), parameter=True
    )
    alpha: float | None = option(
        None,
        Flag("--alpha", "cosine above which two coefficients are treated as one; 1: never", "X", float),
        parameter=True,
    )
    colour_model: ColourModel = option(
        CompactionOptions.colour_model,
        Flag(
            "--colour-model",
            "colour space of the sparse coefficients; ycocg penalises Co and Cg three times as much",
            choices=get_args(ColourModel),
        ),
    )
    weighting: Weighting = option(
        CompactionOptions.weighting,
        Flag(
            "--weighting",
            "weight views by how much of the splat they show (importance), or equally (visibility)",
            choices=get_args(Weighting),
        ),
    )
    two_pass: bool = option(
        CompactionOptions.two_pass,
        Flag("--one-pass", "do not solve again after leaving out coefficients that would be quantised to 0"),
    )

    def __post_init__(self) -> None:
        if not 0 <= self.at <= 1:
            raise UsageError(f"--compact-at is {self.at:g}, it must lie between 0 and 1")
        _ = CompactionOptions(colour_model=self.colour_model, weighting=self.weighting)

    def looks_at(self, scene: Scene) -> bool:
        return self.on and scene.sh_degree > 0

    def interludes(self, iterations: int) -> Sequence[Interlude]:
        after = max(math.ceil(self.at * iterations), 1)
        return [Interlude(after, self, always=True, afresh=True)]

    def run(self, state: State, bench: Workbench) -> State:
        """Make the colours of the state's scene sparse, unless that has been done while splats were removed."""
        if state.results.compacted or state.scene.sh_degree == 0:
            return state
        options = CompactionOptions(
            lam=bench.parameters.lam,
            alpha=bench.parameters.alpha,
            sf_sh=bench.parameters.sf_sh,
            two_pass=self.two_pass,
            colour_model=self.colour_model,
            weighting=self.weighting,
        )
        with _importances(state, bench) as measured:
            bench.progress("compact", 0.0)
            weights = ViewWeights.from_importances(len(state.scene), measured)
            places = standpoints(state.views, state.source.means)
            sh = Compactor(bench.opened).compact(state.scene, places, weights, options).sh
            bench.progress("compact", 1.0)
        return state.recoloured(sh).with_results(compacted=True)


@contextmanager
def _importances(state: State, bench: Workbench) -> Iterator[Importances]:
    """Importances view by view: those that pruning has measured, or, without pruning, measured for this."""
    if state.importances is not None:
        yield state.importances
        return
    bench.progress("prepare views", 0.0)
    with measurement(state, bench, SweepOptions(memory=bench.memory)) as removal:
        removal.measure()
        yield importances_of(removal, np.arange(len(state.scene)))
