"""The solvers of colours, the compaction's ridge and the re-fit, against float64: a part of tools.stress.run."""

from __future__ import annotations

import numpy as np

from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.views.targets import RenderedTargets
from tests.reference.refit import Reference, to_ycocg
from tests.reference.ridge import YCOCG, Ridges, triangles
from tools.stress.cases import RefitCase, RidgeCase
from tools.stress.measures import Measures
from tools.stress.precise import F64, ULP

#: Colour error of a least-squares solution that is a matter of rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6
#: What the re-fit promises beside that: this part of the way to the solution, after enough steps.
REFIT_PROMISE = 1e-3


def check_ridge(device: Device, case: RidgeCase) -> Measures:
    """How far the compaction's colours are above the optimum, see :func:`ridge_errors`."""
    dense = case.weights
    offsets = np.concatenate([[0], np.cumsum((dense > 0).sum(axis=1))])
    weights = ViewWeights(offsets, np.nonzero(dense)[1].astype(np.int32), dense[dense > 0].astype(np.float32))
    compacted = Compactor(device).compact(case.scene, case.centres, weights, case.options)
    if not np.isfinite(compacted.sh).all():
        return {"ridge": (np.inf, ROUNDING)}
    errors = ridge_errors(case.scene, compacted, case.centres, weights, case.options)
    return {"ridge": (float(errors.max(initial=0)), ROUNDING)}


def ridge_errors(scene: Scene, compacted: Scene, centres: F64, weights: ViewWeights, options: CompactionOptions) -> F64:
    """(K, 3) weighted colour errors above the optimum over the coefficients left free, of the splats that are seen.

    Relative to the largest coefficient or 1.
    """
    before, after = scene.sh @ YCOCG.T, compacted.sh @ YCOCG.T
    largest = np.maximum(np.abs(before).max(axis=1), 1)
    squares = np.add.reduceat(np.append(weights.weights.astype(np.float64) ** 2, 0), weights.offsets[:-1])
    errors = []
    for splats, triangle in triangles(scene.means.astype(np.float64), centres, weights, scene.sh_degree):
        found = np.zeros((len(splats), 3))
        for c in range(3):
            used = np.abs(after[splats, :, c]) > 1e-6 * np.abs(compacted.sh[splats]).max(axis=(1, 2))[:, None]
            used[:, 0] = True
            lam = options.lam * (options.chroma_factor if c else 1)
            excess = Ridges(triangle, before[splats, :, c], used, lam).excess(after[splats, :, c])[0]
            kept = np.isclose(after[splats, 1:, c], before[splats, 1:, c], rtol=1e-5, atol=1e-7).all(axis=1)
            found[:, c] = np.where(kept, 0, np.sqrt(excess / squares[splats]) / largest[splats, c])
        errors.append(found)
    return np.concatenate(errors)


def check_refit(device: Device, case: RefitCase) -> Measures:
    """How far the pictures are above the optimum, cut colours staying cut, and whether anything was lost."""
    with Rasterizer(device, case.other) as rasterizer:
        pictures = [rasterizer.render(view)[0] for view in case.views]
        targets = RenderedTargets(rasterizer, case.views)
        refitted = refit_colours(device, case.scene, case.views, targets, case.options)
    if not np.isfinite(refitted.sh).all():
        return {"re-fit: loss": (np.inf, ULP)}
    before, after = refitted.errors
    found = {"re-fit: loss": (max(after - before, 0.0) / max(before, 1e-12), ULP)}
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
