"""Least-squares systems of the compaction, and what their solutions must be."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo
from potr_cl.stages.compaction.ridge import CompactionOptions
from potr_cl.stages.compaction.view_weights import ViewWeights
from tests.devices import KERNELS, shared_device
from tests.reference.ridge import YCOCG, objective, ridge, weighted_basis

#: Those of :data:`tests.devices.KERNELS`, and GPUs' where several work-items share a splat.
COMPACTING = [*KERNELS, "gpu, a splat shared"]

#: Colour error, in colour units, that is a matter of rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6


@contextmanager
def compacting_device(kernels: str) -> Iterator[Device]:
    """The device of one of :data:`COMPACTING`, which has to have all its memory back in the end."""
    family, _, shared = kernels.partition(", ")
    device = shared_device(family)
    with patch.object(DeviceInfo, "indexes_in_memory", bool(shared)):
        yield device
    assert device.allocated == 0, "a compactor did not give all its memory back"


def dense_weights(dense: NDArray[np.floating]) -> ViewWeights:
    """Weights (N, S), zeros left out."""
    offsets = np.concatenate([[0], np.cumsum((dense > 0).sum(axis=1))])
    return ViewWeights(offsets, np.nonzero(dense)[1].astype(np.int32), dense[dense > 0].astype(np.float32))


def on_a_sphere(views: int, seed: int = 0, distance: float = 6.0) -> NDArray[np.float64]:
    directions = np.random.default_rng(seed).normal(size=(views, 3))
    return distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def sparse_weights(splats: int, views: int, seed: int = 0) -> NDArray[np.float32]:
    """(N, S), half of them zero, the others spread over five decades; from no view to all a splat."""
    rng = np.random.default_rng(seed)
    weights = 10 ** rng.uniform(-3, 2, size=(splats, views))
    return (weights * (rng.random((splats, views)) < rng.random((splats, 1)))).astype(np.float32)


def channels(sh: NDArray[np.floating], ycocg: bool = True) -> NDArray[np.float64]:
    """(N, M, 3) in the colour model."""
    return sh @ YCOCG.T if ycocg else sh.astype(np.float64)


def check_optimal(
    scene: Scene,
    compacted: Scene,
    centres: NDArray[np.float64],
    dense: NDArray[np.floating],
    options: CompactionOptions,
    rounding: float = ROUNDING,
) -> None:
    """Every channel's objective is within 0.1 % and rounding of the optimum over the coefficients that it left free."""
    ycocg = options.colour_model == "ycocg"
    before, after = channels(scene.sh, ycocg), channels(compacted.sh, ycocg)
    assert np.isfinite(compacted.sh).all()
    for k in range(len(scene)):
        rows = dense[k] > 0
        if not rows.any():
            continue
        weights = dense[k, rows].astype(np.float64)
        basis = weighted_basis(scene.means[k].astype(np.float64), centres[rows], weights, scene.sh_degree)
        for c in range(3):
            lam = options.lam * (options.chroma_factor if ycocg and c else 1)
            # The way through YCoCg and back leaves a rounding error where a coefficient is zero.
            used = np.abs(after[k, :, c]) > 1e-6 * np.abs(compacted.sh[k]).max(initial=1e-30)
            used[0] = True
            best = objective(basis, before[k, :, c], ridge(basis, before[k, :, c], used, lam), lam)
            ours = objective(basis, before[k, :, c], np.where(used, after[k, :, c], 0), lam)
            scale = max(1, np.abs(before[k]).max())
            assert ours <= 1.001 * best + (rounding * scale) ** 2 * np.sum(weights**2), (k, c, ours, best)
