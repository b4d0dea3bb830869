"""The solvers of colours, the compaction's ridge and the re-fit, against float64: a part of tools.stress.run."""

from __future__ import annotations

import numpy as np

from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compaction.ridge import Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.views.targets import RenderedTargets
from tests.reference.refit import Reference, to_ycocg
from tests.reference.ridge import YCOCG, objective, ridge, weighted_basis
from tools.stress.cases import RefitCase, RidgeCase
from tools.stress.measures import Measures
from tools.stress.precise import F64, ULP

#: Colour error of a least-squares solution that is a matter of rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6
#: What the re-fit promises beside that: this part of the way to the solution, after enough steps.
REFIT_PROMISE = 1e-3


def check_ridge(device: Device, case: RidgeCase) -> Measures:
    """How far the compaction's colours are above the optimum over the coefficients that it left free.

    A channel that kept its coefficients because its solution would have been out of bounds is left out.
    """
    dense = case.weights
    offsets = np.concatenate([[0], np.cumsum((dense > 0).sum(axis=1))])
    weights = ViewWeights(offsets, np.nonzero(dense)[1].astype(np.int32), dense[dense > 0].astype(np.float32))
    compacted = Compactor(device).compact(case.scene, case.centres, weights, case.options)
    if not np.isfinite(compacted.sh).all():
        return {"ridge": (np.inf, ROUNDING)}
    before = case.scene.sh @ YCOCG.T
    after = compacted.sh @ YCOCG.T
    worst = 0.0
    for k in range(len(case.scene)):
        rows = dense[k] > 0
        if not rows.any():
            continue
        strength = dense[k, rows].astype(np.float64)
        basis = weighted_basis(
            case.scene.means[k].astype(np.float64), case.centres[rows], strength, case.scene.sh_degree
        )
        scale = max(1.0, float(np.abs(before[k]).max()))
        for c in range(3):
            if np.allclose(after[k, :, c], before[k, :, c], rtol=1e-5, atol=1e-6 * scale):
                continue
            lam = case.options.lam * (case.options.chroma_factor if c else 1)
            used = np.abs(after[k, :, c]) > 1e-6 * np.abs(compacted.sh[k]).max(initial=1e-30)
            used[0] = True
            best = objective(basis, before[k, :, c], ridge(basis, before[k, :, c], used, lam), lam)
            ours = objective(basis, before[k, :, c], np.where(used, after[k, :, c], 0), lam)
            worst = max(worst, np.sqrt(max(ours - 1.001 * best, 0) / np.sum(strength**2)) / scale)
    return {"ridge": (float(worst), ROUNDING)}


def check_refit(device: Device, case: RefitCase) -> Measures:
    """How far the pictures are above the optimum, cut colours staying cut, and whether anything was lost."""
    with Rasterizer(device, case.other) as rasterizer:
        pictures = [rasterizer.render(view)[0] for view in case.views]
        targets = RenderedTargets(rasterizer, case.views)
        refitted = refit_colours(device, case.scene, case.views, targets, case.options)
    if not np.isfinite(refitted.sh).all():
        return {"re-fit: loss": (np.inf, ULP)}
    before, after = refitted.errors
    found = {
        "re-fit: loss": (max(after - before, 0.0) / max(before, 1e-12), ULP),
    }
    try:
        true = Reference(case.scene, case.views, pictures, case.options.lam, case.options.prior)
    except ValueError:  # a pixel too near a threshold: whose pictures are meant?
        return found
    x, best = to_ycocg(refitted.sh), true.solution()

    def length(way: F64) -> float:
        # At the optimum the gradient is 0: the excess is the square of the way, without a difference of objectives.
        squares = sum(v.weight * np.sum(i**2) for v, i in zip(true.views, true.forward(way), strict=True))
        squares += np.sum(true.pull * way**2) + true.prior * np.sum(way**2)
        return float(np.sqrt(squares / sum(3 * v.weight * len(v.blend) for v in true.views)))

    # Where colours cut on the way made it worse, the solver goes only a part of it, or stays.
    parts = [0.0, *(0.5**n for n in range(5))]
    off = min(length(x - true.start - part * (best - true.start)) for part in parts)
    return found | {"re-fit: optimum": (off, ROUNDING + REFIT_PROMISE * length(best - true.start))}
