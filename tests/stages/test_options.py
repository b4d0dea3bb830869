"""Options of stages that are out of range are refused."""

from __future__ import annotations

import math

import pytest

from potr_cl.errors import UsageError
from potr_cl.stages.compaction.ridge import CompactionOptions
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.fit import FitOptions
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.views_between import Between

#: Values that are wrong, one at a time, and what is said, if it matters.
WRONG = {
    CompactionOptions: (None, {
        "lam": (-1.0, math.nan, 1e30), "chroma_factor": (-1.0,), "alpha": (0.0, 1.5), "sf_sh": (0.0,),
        "colour_model": ("cmyk",), "weighting": ("heavy",), "precision": ("fp8",),
    }),
    RefitOptions: ("re-fit|slices", {
        "steps": (-1,), "selection_steps": (-1,), "gain": (1, -0.1), "lam": (-1,), "prior": (math.nan,),
        "drop": (math.inf,), "chroma_factor": (-1,), "selection_lam": (1e13,), "slices": (0,),
    }),
    PruningOptions: (None, {
        "delta_mse_max": (-1, math.nan), "iterations": (0,), "a": (0, math.inf), "count": (0,),
        "decay": (-0.1, 1.1, math.nan),
    }),
    SweepOptions: (None, {
        "tolerance": (math.nan, math.inf), "turns": (0,), "memory": (-1,),
        "transmittance_threshold": (0.0, 1.0, math.nan),
    }),
    FitOptions: ("the fit", {"steps": (-1, 10**7), "batch": (0,), "rounds": (0,), "patience": (0,), "last": (0, 2)}),
    Fit: ("the fit", {"further": (-0.5,), "cycles": (0,), "finer": (-1,), "between": (-1,)}),
    Between: ("between", {"views": (-1, 1000), "spread": (-1.0, math.nan)}),
}  # fmt: skip
#: What has to be given.
NEEDED = {PruningOptions: {"delta_mse_max": 1.0}}


@pytest.mark.parametrize(
    ("kind", "said", "wrong"),
    [
        pytest.param(kind, said, {name: value}, id=f"{kind.__name__}({name}={value})")
        for kind, (said, names) in WRONG.items()
        for name, values in names.items()
        for value in values
    ],
)
def test_options_out_of_range_are_refused(kind, said, wrong):
    with pytest.raises(UsageError, match=said):
        kind(**{**NEEDED.get(kind, {}), **wrong})
