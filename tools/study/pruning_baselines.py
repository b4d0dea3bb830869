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

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.source import kernel_source
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import TILE, camera_struct

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]

LIGHTGAUSSIAN_POWER = 0.1
#: MesonGS sets β by scene.
MESONGS_POWERS = {"lego": 0.05, "plush": 0.1}
_MESONGS_DEFAULT = 0.1

#: Sums of T over a tile's pixels, one for each intersection of the tile's list. Groups share a tile on a GPU and add up
#: in
#: fixed point, of which 256 ones just fit 32 bits: the sums are the same on every run.
_KERNELS = """
kernel void transmittance_sums(
    global const float4 *shapes,
    global const uint *offsets,
    global const uint *intersections,
    View view,
    global float *sums)
{
#if LANES == 1
    local float4 near_s0[TILE * TILE];
    local float2 near_s1[TILE * TILE];
    local uint parts[TILE * TILE];
    const int lid = get_local_id(0), tile = get_group_id(0);
    const int column = tile % view.columns * TILE + lid % TILE;
    const int row = tile / view.columns * TILE + lid / TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];
    int alive = column < view.width && row < view.height;
    float t = 1.0f;
    for (uint batch = begin; batch < end; batch += TILE * TILE) {
        const int size = min(end - batch, (uint)(TILE * TILE));
        if (lid < size) {
            const uint splat = intersections[batch + lid];
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = shapes[2 * splat + 1].xy;
        }
        parts[lid] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int k = 0; k < size && alive; ++k) {
            const float4 s0 = near_s0[k];
            const float2 s1 = near_s1[k];
            const float dy = row + 0.5f - s0.y;
            const float u = s0.z * (column + 0.5f - s0.x) + s0.w * dy;
            const float v = s1.x * dy;
            const float power = s1.y - u * u - v * v;
            if (power >= LOG2_ALPHA_MIN) {
                const float after = t - t * fmin(exp2_polynomial(power), ALPHA_CAP);
                if (after < TRANSMITTANCE_THRESHOLD) {
                    alive = 0;
                } else {
                    atomic_add(&parts[k], convert_uint_rte(t * 8388608.0f));
                    t = after;
                }
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < size)
            sums[batch + lid] = parts[lid] * (1.0f / 8388608.0f);
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#else
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const int pixel_rows = min(TILE, view.height - origin.y);
    vfloat t[TILE * TILE / LANES]; /* of a pixel that has ended: negative */
    for (int i = 0; i < TILE * TILE / LANES; ++i) {
        const vfloat column = LANE_NUMBERS + (float)(origin.x + i % (TILE / LANES) * LANES);
        t[i] = column < (float)view.width ? (vfloat)(1.0f) : (vfloat)(-1.0f);
    }
    const uint end = offsets[tile + 1];
    for (uint intersection = offsets[tile]; intersection < end; ++intersection) {
        const uint splat = intersections[intersection];
        const float4 s0 = shapes[2 * splat];
        const float2 s1 = shapes[2 * splat + 1].xy;
        const float reach = sqrt(fmax(s1.y - LOG2_ALPHA_MIN + LEVEL_SLACK, 0.0f)) / s1.x + 1.0f;
        const float centre = s0.y - origin.y - 0.5f;
        const int first = (int)fmin(fmax(centre - reach, 0.0f), (float)TILE);
        const int last = (int)fmin(fmax(centre + reach + 1.0f, 0.0f), (float)pixel_rows);
        vfloat sum = 0.0f;
        for (int row = first; row < last; ++row) {
            const float dy = origin.y + row + 0.5f - s0.y;
            const float v = s1.x * dy;
            for (int part = 0; part < TILE / LANES; ++part) {
                const int i = row * (TILE / LANES) + part;
                const vfloat x = LANE_NUMBERS + (origin.x + part * LANES + 0.5f);
                const vfloat u = s0.z * (x - s0.x) + s0.w * dy;
                const vfloat power = s1.y - u * u - v * v;
                const vfloat before = t[i];
                const vint touched = (power >= LOG2_ALPHA_MIN) & (before > 0.0f);
                const vfloat after = before - before * fmin(exp2_polynomial(power), (vfloat)(ALPHA_CAP));
                const vint goes_on = touched & (after >= TRANSMITTANCE_THRESHOLD);
                sum += goes_on ? before : (vfloat)(0.0f);
                t[i] = touched ? (goes_on ? after : -before) : before;
            }
        }
        float lanes[LANES], total = 0.0f;
        VSTORE(sum, 0, lanes);
        for (int lane = 0; lane < LANES; ++lane)
            total += lanes[lane];
        sums[intersection] = total;
    }
#endif
}
"""


def _kernel(device: Device, rasterizer: Rasterizer) -> cl.Kernel:
    lanes = 1 if device.family == "gpu" else max(device.vector_width, 4)
    rules = rasterizer.rules
    options = [
        "-cl-std=CL1.2",
        f"-DLANES={lanes}",
        f"-DALPHA_CAP={rules.alpha_cap:.9e}f",
        f"-DTRANSMITTANCE_THRESHOLD={rules.transmittance_threshold:.9e}f",
    ]
    source = kernel_source("include/lanes.clh") + kernel_source("include/splat.clh") + _KERNELS
    return cl.Kernel(cl.Program(device.context, source).build(options), "transmittance_sums")


def transmittance_sums(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> F64:
    """(N,) float64: for each splat the sum, over all views and the pixels in which it is composited, of the
    transmittance in front of it.

    Raises:
        DeviceError: a view does not fit the device.
    """
    device = rasterizer.device
    kernel = _kernel(device, rasterizer)
    group = TILE * TILE if device.family == "gpu" else 1
    total = np.zeros(rasterizer.splats)
    for camera in cameras:
        view = rasterizer.prepare(camera)
        sums = device.allocate(4 * view.intersection_count, "the sums of transmittances")
        kernel.set_args(view.shapes, view.offsets, view.intersections, camera_struct(camera), sums)
        device.launch(kernel, (view.tiles * group,), (group,))
        weights = device.download(sums, (view.intersection_count,), np.float32)
        splats = device.download(view.intersections, (view.intersection_count,), np.uint32)
        total += np.bincount(splats, weights, rasterizer.splats)
        device.free(sums)
        view.free()
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
