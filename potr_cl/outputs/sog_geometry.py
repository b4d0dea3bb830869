"""Geometry and opacities as a SOG file holds them, as coarse as a quality allows: :func:`rounded_geometry`.

SOG has 8 or 16 bits for every number, mostly more than a quality needs. Fewer different numbers take fewer bytes, so
every number is rounded to multiples of the format's own steps that are about as large as the steps of the package's own
files: for positions they follow the distance from the views, for rotations the splat's size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.curve import along_curve
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.quantize import HyperParameters, canonical_rotations, dequantize_scales, quantize_scales
from potr_cl.formats.scenes.scene_files import byte_logits
from potr_cl.formats.scenes.sog_images import CODEBOOK, FIRST_TAG, U8
from potr_cl.formats.scenes.sog_values import (
    STEPS,
    log_transformed,
    unpacked_means,
    unpacked_rotations,
)
from potr_cl.host.threads import Run
from potr_cl.model.scene import FloatArray, Scene

#: A position's step, as a part of the farthest that its centre may be moved, and the most doublings of the format's.
_POSITION_STEP, _MOST_DOUBLINGS = 1.0, 12
#: A unit of a unit quaternion's part in the format's steps, and the most doublings of these.
_ROTATION_UNIT, _MOST_ROTATION_DOUBLINGS = 127.5 * np.sqrt(2), 6
#: Splats that a thread works on at a time.
_BLOCK = 1 << 15
#: The middle of a part's range, which stands for 0.
_MIDDLE = 128


@dataclass(frozen=True)
class SogGeometry:
    """All of a SOG file but colours, in the order of the file.

    Attributes:
        order: (N,) the number in the scene of each splat of the file.
        least, most, steps, quaternions, scale_book, scales: as of
            :class:`potr_cl.formats.scenes.sog_images.SogImages`.
        opacities: (N,) uint8, in steps of 1/255.
    """

    order: NDArray[np.int64]
    least: FloatArray
    most: FloatArray
    steps: NDArray[np.uint16]
    quaternions: U8
    scale_book: FloatArray
    scales: U8
    opacities: U8

    def seen(self, scene: Scene) -> Scene:
        """What readers see, in the order of the scene; its colours are those of ``scene``."""
        back = np.empty_like(self.order)
        back[self.order] = np.arange(len(self.order))
        return replace(
            scene,
            means=unpacked_means(self.steps, self.least, self.most).take(back, axis=0),
            log_scales=self.scale_book.take(self.scales.take(back, axis=0)),
            quaternions=unpacked_rotations(self.quaternions).take(back, axis=0),
            opacity_logits=byte_logits().take(self.opacities.take(back)),
        )


def rounded_geometry(
    scene: Scene, parameters: HyperParameters, distances: NDArray[np.float64], run: Run = map
) -> SogGeometry:
    """Round a scene's geometry and opacities.

    Args:
        scene: clean, at least one splat.
        parameters: γ, β and the scale factors of scales, rotations and opacities count.
        distances: (N,) to the nearest view, world units; 0 where there is none.
        run: in place of :func:`map`, to work with several threads.

    Raises:
        DataError: a value too large to quantise.
    """
    rules = QUANTISERS[parameters.quantiser]
    world = rules.in_world_units(parameters, scene, distances, run)
    least, most, steps = _positions(scene.means, np.maximum(world.gamma, world.beta * distances), run)
    order = along_curve(steps)
    scale_levels = np.empty((len(order), 3), np.int64)
    quaternions, opacities = np.empty((len(order), 4), np.uint8), np.empty(len(order), np.uint8)

    def shape(start: int) -> None:
        own = slice(start, start + _BLOCK)
        rows = order[own]
        imaginary, log_scales = canonical_rotations(
            scene.quaternions.take(rows, axis=0), scene.log_scales.take(rows, axis=0)
        )
        levels = [quantize_scales(axis.astype(np.float64), world.sf_scale) for axis in log_scales.T]
        factors = rules.rotation_factors(levels, world.sf_rotation)
        scale_levels[own] = own_levels = np.stack(levels, axis=1)
        quaternions[own] = _rotations(imaginary, factors, (own_levels == own_levels[:, :1]).all(axis=1))
        logits = rules.quantize_opacities(scene.opacity_logits.take(rows).astype(np.float64), world.sf_opacity)
        decoded = rules.dequantize_opacities(logits, world.sf_opacity).astype(np.float64)
        opacities[own] = np.rint(255 / (1 + np.exp(-decoded)))

    list(run(shape, range(0, len(order), _BLOCK)))
    least_level = int(scale_levels.min())
    counts = np.bincount((scale_levels - least_level).reshape(-1))
    there = np.flatnonzero(counts)
    values = (there + least_level).astype(np.float32)
    book = np.unique(np.rint(codebook(values, counts[there].astype(np.float64), CODEBOOK)).astype(np.int64))
    entries = np.zeros(len(counts), np.uint8)
    entries[there] = nearest(values, book.astype(np.float32))
    return SogGeometry(
        order,
        least,
        most,
        steps.take(order, axis=0),
        quaternions,
        dequantize_scales(book, world.sf_scale),
        entries.take(scale_levels - least_level),
        opacities,
    )


def _positions(
    means: FloatArray, tolerance: NDArray[np.float64], run: Run
) -> tuple[FloatArray, FloatArray, NDArray[np.uint16]]:
    """What the least and the most step mean, and steps (N, 3), multiples of powers of two that are precise enough.

    Args:
        means: (N, 3) centres that are rounded.
        tolerance: (N,) the farthest that each may be moved.
        run: shares the splats out.
    """
    starts = range(0, len(means), _BLOCK)
    logarithms, wanted = np.empty((2, len(means), 3))

    def take_logarithms(start: int) -> None:
        own = slice(start, start + _BLOCK)
        logarithms[own] = log_transformed(means[own])

    list(run(take_logarithms, starts))
    least, most = logarithms.min(axis=0), logarithms.max(axis=0)
    extent = np.where(most > least, most - least, 1.0)

    def want(start: int) -> None:
        own = slice(start, start + _BLOCK)
        # The logarithm's slope is 1 / (1 + |x|).
        size = _POSITION_STEP * tolerance[own, None] / (1 + np.abs(means[own].astype(np.float64)))
        wanted[own] = np.log2(np.maximum(size / extent * STEPS, 2.0**-20))

    list(run(want, starts))
    # The range may be larger than needed: so that a power of two is just what a typical splat wants.
    typical = np.median(wanted, axis=0)
    wider = np.where(typical >= 1, 2 ** (typical - np.floor(typical)), 1.0)
    least_f, most_f = least.astype(np.float32), (least + extent * wider).astype(np.float32)
    steps = np.empty(means.shape, np.uint16)

    def step(start: int) -> None:
        own = slice(start, start + _BLOCK)
        size = 2.0 ** np.clip(np.round(wanted[own] - np.log2(wider)), 0, _MOST_DOUBLINGS)
        exact = (logarithms[own] - least_f) / (most_f.astype(np.float64) - least_f) * STEPS
        steps[own] = np.clip(np.rint(exact / size) * size, 0, STEPS)

    list(run(step, starts))
    return least_f, most_f, steps


def _rotations(imaginary: NDArray[np.float64], factors: FloatArray, balls: NDArray[np.bool_]) -> U8:
    """(N, 4) pixels of unit quaternions whose real part is the largest.

    Args:
        imaginary: (N, 3) the other parts.
        factors: (N,) or (1,) steps that a unit is to have.
        balls: (N,) whether a splat has no direction.
    """
    doublings = np.clip(np.round(np.log2(_ROTATION_UNIT / factors)), 0, _MOST_ROTATION_DOUBLINGS)
    size = 2.0 ** doublings[:, None]
    offsets = np.where(balls[:, None], 0, np.rint(imaginary * _ROTATION_UNIT / size) * size)
    pixels = np.empty((len(imaginary), 4), np.uint8)
    pixels[:, :3] = np.clip(offsets + _MIDDLE, 0, 255)
    pixels[:, 3] = FIRST_TAG
    return pixels
