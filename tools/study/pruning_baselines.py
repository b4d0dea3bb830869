"""Removal orders of other pruners, computed with our renderer on the same views, for honest comparison.

All are scores: the splats with the lowest go first, once and for all. The definitions follow the papers and what their
published programs compute where the two differ:

- LightGaussian (Fan et al. 2023), global significance: Σ over views and pixels of o T, times V^0.1. o is the splat's
  opacity (not its α in the pixel) and T the transmittance in front of it, taken in the pixels where it is composited. V
  is the product of its three standard deviations; the paper caps V at its 90th percentile, the program does not and
  neither do we. The first published program left T out; this is the corrected one.
- MesonGS (Xie et al. 2024): Σ α T times V^β, with β chosen for each scene.
- importance: Σ α T, the paper's I_k. opacity: o. random: a seeded permutation.

Dividing V by a percentile of V, as both programs do, changes no order and is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.memory import Memory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import TILE, camera_struct

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]

LIGHTGAUSSIAN_POWER = 0.1
#: MesonGS sets β by scene.
MESONGS_POWERS = {"lego": 0.05, "plush": 0.1}
_MESONGS_DEFAULT = 0.1

#: Kernels of its own, for :class:`potr_cl.opencl.device.Device`.
KERNELS = {"baselines/transmittance_sums.cl": Path(__file__).with_name("transmittance_sums.cl")}


def transmittance_sums(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> F64:
    """(N,) float64: for each splat the sum, over all views and the pixels in which it is composited, of the
    transmittance in front of it.

    Raises:
        DeviceError: a view does not fit the device.
        FileNotFoundError: the rasterizer's device was made without the variants :data:`KERNELS`.
    """
    device = rasterizer.device
    kernel = device.kernel(
        "baselines/transmittance_sums.cl",
        "transmittance_sums",
        LANES=1 if device.family == "gpu" else max(device.vector_width, 4),
        ALPHA_CAP=float(rasterizer.rules.alpha_cap),
        TRANSMITTANCE_THRESHOLD=float(rasterizer.rules.transmittance_threshold),
    )
    group = TILE * TILE if device.family == "gpu" else 1
    total = np.zeros(rasterizer.splats)
    for camera in cameras:
        with rasterizer.prepare(camera) as view, Memory(device) as memory:
            sums = memory.allocate(4 * view.intersection_count, "the sums of transmittances")
            kernel.bind(
                shapes=view.shapes,
                offsets=view.offsets,
                intersections=view.intersections,
                view=camera_struct(camera),
                sums=sums,
            ).launch((view.tiles * group,), (group,))
            weights = device.download(sums, (view.intersection_count,), np.float32)
            splats = device.download(view.intersections, (view.intersection_count,), np.uint32)
            total += np.bincount(splats, weights, rasterizer.splats)
    return total


def scores(scene: Scene, importance: F64, transmittance: F64, mesongs_power: float, seed: int = 0) -> dict[str, F64]:
    """Each baseline's score of each splat, (N,) float64; low scores go first.

    Args:
        importance: (N,) Σ α T, to any scale (:meth:`potr_cl.stages.pruning.removal.RemovalSweep.measure`).
        transmittance: (N,) :func:`transmittance_sums`.
        mesongs_power: β of MesonGS.
        seed: of the random order.
    """
    log_volume = scene.log_scales.sum(axis=1, dtype=np.float64)
    log_volume -= np.median(log_volume)
    opacity = scene.opacities.astype(np.float64)
    return {
        "LightGaussian": opacity * transmittance * np.exp(LIGHTGAUSSIAN_POWER * log_volume),
        "MesonGS": importance * np.exp(mesongs_power * log_volume),
        "importance": importance,
        "opacity": opacity,
        "random": np.random.default_rng(seed).permutation(len(scene)).astype(np.float64),
    }


def mesongs_power(scene_name: str) -> float:
    """β of MesonGS for a scene."""
    return MESONGS_POWERS.get(scene_name, _MESONGS_DEFAULT)


def removal_order(score: F64) -> Indices:
    """(N,) splats in the order in which they go; equal scores by number."""
    return np.argsort(score, kind="stable")
