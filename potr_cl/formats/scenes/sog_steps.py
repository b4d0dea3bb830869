"""A scene in the numbers of a SOG file, as fine as the format is: :func:`quantised`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.curve import along_curve
from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.codec.quantize import canonical_rotations
from potr_cl.formats.scenes.sog_images import CODEBOOK, FIRST_TAG, OTHER_PARTS, U8, Palette, SogImages
from potr_cl.model.scene import FloatArray, Scene

#: Of positions, whose logarithms have 16 bits.
STEPS = 65535
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16
_LEAST_OPACITY = np.float32(1e-6)


def in_order(scene: Scene) -> Scene:
    """A scene in the order of a file, in which neighbours in the images are neighbours in space."""
    logarithms = log_transformed(scene.means)
    least, most = logarithms.min(axis=0).astype(np.float32), logarithms.max(axis=0).astype(np.float32)
    return scene.subset(along_curve(position_steps(logarithms, least, most)))


def quantised(scene: Scene, palette: Palette | None, weights: NDArray[np.float64] | None = None) -> SogImages:
    """A scene in the numbers of a SOG file.

    Args:
        scene: in the order of the file, of any SH degree; quaternions may have any length.
        palette: the SH coefficients from degree 1 on, which are not looked at in the scene.
        weights: (N,) of the squared errors of scales and colours; None: all alike.
    """
    n = len(scene)
    logarithms = log_transformed(scene.means)
    least, most = logarithms.min(axis=0).astype(np.float32), logarithms.max(axis=0).astype(np.float32)
    quaternions = np.empty((n, 4), np.uint8)
    log_scales = np.empty((n, 3), np.float32)
    for start in range(0, n, _BLOCK):
        some = slice(start, min(start + _BLOCK, n))
        imaginary, log_scales[some] = canonical_rotations(scene.quaternions[some], scene.log_scales[some])
        quaternions[some] = packed_rotations(imaginary)
    thrice = None if weights is None else np.repeat(weights, 3)
    scale_book = codebook(log_scales.reshape(-1), thrice, CODEBOOK)
    colour_book = codebook(scene.sh[:, 0].reshape(-1), thrice, CODEBOOK)
    colours = np.empty((n, 4), np.uint8)
    colours[:, :3] = nearest(scene.sh[:, 0], colour_book)
    colours[:, 3] = np.rint(scene.opacities * np.float32(255))
    return SogImages(
        least,
        most,
        position_steps(logarithms, least, most),
        quaternions,
        scale_book,
        nearest(log_scales, scale_book).astype(np.uint8),
        colour_book,
        colours,
        palette,
        scene.antialiased,
    )


def log_transformed(means: FloatArray) -> NDArray[np.float64]:
    """(N, 3) sign(x) log(1 + |x|)."""
    return np.copysign(np.log1p(np.abs(means.astype(np.float64))), means)


def position_steps(logarithms: NDArray[np.float64], least: FloatArray, most: FloatArray) -> NDArray[np.uint16]:
    """(N, 3) steps from ``least`` (0) to ``most`` (65535), (3,) each; 0 on an axis without extent."""
    extent = np.where(most == least, 1, most.astype(np.float64) - least)
    return np.clip(np.rint((logarithms - least) / extent * STEPS), 0, STEPS).astype(np.uint16)


def unpacked_means(steps: NDArray[np.uint16], least: FloatArray, most: FloatArray) -> FloatArray:
    """(n, 3) float32 positions of steps (n, 3), infinite where single precision cannot hold them."""
    extent = np.where(most == least, np.float32(1), most - least)
    logarithms = least + extent * (steps.astype(np.float32) * np.float32(1 / STEPS))
    means = np.copysign(np.expm1(np.abs(logarithms), dtype=np.float64), logarithms)
    single: FloatArray = means.astype(np.float32)
    return single


def packed_rotations(imaginary: NDArray[np.float64]) -> U8:
    """(N, 4) uint8 of unit quaternions whose real part is the largest, from their imaginary parts, (N, 3)."""
    packed = np.empty((len(imaginary), 4), np.uint8)
    packed[:, :3] = np.clip(np.rint((imaginary * np.sqrt(2) + 1) * 127.5), 0, 255)
    packed[:, 3] = FIRST_TAG
    return packed


def unpacked_rotations(pixels: U8) -> FloatArray:
    """(n, 4) float32 quaternions w, x, y, z of pixels (n, 4); no rotation where a pixel holds none."""
    stored = ((pixels[:, :3].astype(np.float32) / np.float32(255)) * 2 - 1) * np.float32(np.sqrt(0.5))
    squares = stored * stored
    left = 1 - (squares[:, 0] + squares[:, 1] + squares[:, 2])
    largest = np.maximum(pixels[:, 3].astype(np.intp) - FIRST_TAG, 0)
    quaternions = np.empty((len(pixels), 4), np.float32)
    np.put_along_axis(quaternions, OTHER_PARTS[largest], stored, axis=1)
    np.put_along_axis(quaternions, largest[:, None], np.sqrt(np.maximum(left, 0))[:, None], axis=1)
    quaternions[pixels[:, 3] < FIRST_TAG] = (1, 0, 0, 0)
    return quaternions


def opacity_logits() -> FloatArray:
    """(256,) float32, the logit of each opacity; those of 0 and 1 are what eight bits cannot tell from them."""
    opacities = np.clip(np.arange(256).astype(np.float32) / np.float32(255), _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    return natural_logarithm(opacities / (1 - opacities))
