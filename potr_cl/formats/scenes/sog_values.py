"""A scene in the numbers of a SOG file, as fine as the format is (:func:`quantised`), and the palette of SH
coefficients that it wants (:func:`palette_of`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.clustering.curve import along_curve
from potr_cl.codec.quantize import canonical_rotations
from potr_cl.formats.scenes.scene_files import OTHER_PARTS, with_largest
from potr_cl.formats.scenes.sog_images import CODEBOOK, FIRST_TAG, PALETTE, U8, Palette, SogImages
from potr_cl.model.scene import FloatArray, Scene

if TYPE_CHECKING:
    from potr_cl.opencl.device import Device

#: Of positions, whose logarithms have 16 bits.
STEPS = 65535
#: Splats worked on at a time: the temporaries stay small.
_BLOCK = 1 << 16


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
    quaternions = with_largest(np.maximum(pixels[:, 3].astype(np.intp) - FIRST_TAG, 0), stored, OTHER_PARTS)
    quaternions[pixels[:, 3] < FIRST_TAG] = (1, 0, 0, 0)
    return quaternions


#: What a splat counts for at most, in those that count for as much as the median does: so that not one of them, as a
#: backdrop may be, has all entries near it.
_MOST_MEDIANS = 1000.0
#: Rows that are made numbers of at a time.
#: Factors that make numbers of rows: those of a generator that is known to spread well.
_FACTOR, _STEP = np.uint64(6364136223846793005), np.uint64(1442695040888963407)


def palette_of(scene: Scene, device: Device | None = None, most: int = PALETTE) -> Palette | None:
    """The palette of a scene; exact, but for the digits of 256 numbers, where it has no more than so many sets.

    Args:
        scene: in the order of the file, of any SH degree.
        device: finds clusters where there are too many sets; None: the one that should be fastest, which is opened only
            then.
        most: entries that it may have.

    Returns:
        None for a scene of SH degree 0.

    Raises:
        DeviceError: there is no device and it needs one, or it failed.
    """
    if scene.sh.shape[1] == 1:
        return None
    rows = scene.sh[:, 1:].reshape(len(scene), -1)
    weights = areas(scene)
    found = distinct_rows(rows, most)
    if found is not None:
        sets, labels = found
    else:
        from potr_cl.clustering.kmeans import cluster  # imported on use: most scenes are read, not written
        from potr_cl.opencl.device import Device

        shown = rows.any(axis=1)  # of the others no entry is needed but one
        mass = np.repeat(weights[shown, None].astype(np.float32), scene.sh.shape[1] - 1, axis=1)
        clusters = cluster(device or Device(), scene.sh[shown, 1:], mass, most - 1)
        sets = np.concatenate([np.zeros((1, rows.shape[1]), np.float32), clusters.centres.reshape(-1, rows.shape[1])])
        labels = np.zeros(len(rows), np.int64)
        labels[shown] = clusters.labels.astype(np.int64) + 1
    return coded(sets, labels, np.bincount(labels, weights, len(sets)).astype(np.float64), scene.sh.shape[1])


def coded(sets: FloatArray, labels: NDArray[np.int64], weights: NDArray[np.float64], coefficients: int) -> Palette:
    """A palette of some sets of coefficients, whose numbers it rounds to 256; sets that nobody has are left out.

    Args:
        sets: (K, 3 (M − 1)) float32, R, G, B of a coefficient in sequence.
        labels: (N,) the set of each splat.
        weights: (K,) of the sets.
        coefficients: M.
    """
    used = np.zeros(len(sets), bool)
    used[labels] = True
    # Sets that are alike stand near each other, those that most splats have first: so images and labels pack well.
    order = np.flatnonzero(used)
    places = np.empty(len(sets), np.int64)
    places[order] = np.arange(len(order))
    values = sets[order].reshape(-1)
    book = codebook(values[values != 0], np.repeat(weights[order], sets.shape[1])[values != 0], CODEBOOK - 1)
    book = np.unique(np.concatenate([book, np.zeros(1, np.float32)]))
    entries = nearest(values, book).astype(np.uint8).reshape(len(order), coefficients - 1, 3)
    return Palette(book, entries, places[labels].astype(np.uint16))


def areas(scene: Scene) -> NDArray[np.float64]:
    """(N,) opacity times area of each splat, bounded: what it contributes to views that nobody knows."""
    scales = scene.log_scales.astype(np.float64)
    two = np.sort(np.clip(scales - np.median(scales), -30, 30), axis=1)[:, 1:].sum(axis=1)
    shown: NDArray[np.float64] = scene.opacities * np.exp(two)
    middle = float(np.median(shown))
    most = middle * _MOST_MEDIANS if middle > 0 else np.inf
    return np.minimum(shown, most).astype(np.float64)


def distinct_rows(rows: FloatArray, most: int) -> tuple[FloatArray, NDArray[np.int64]] | None:
    """The different rows, and the number of each row among them; None if there are more than ``most``.

    Args:
        rows: (N, D) float32, C order.
    """
    numbers = np.zeros(len(rows), np.uint64)
    words = np.ascontiguousarray(rows + np.float32(0)).view(np.uint32)  # −0 is 0
    for column in range(words.shape[1]):
        numbers = (numbers ^ words[:, column]) * _FACTOR + _STEP
        numbers ^= numbers >> np.uint64(29)
    _, first, labels = np.unique(numbers, return_index=True, return_inverse=True)
    if len(first) > most:
        return None
    sets, labels = rows[first], labels.reshape(-1).astype(np.int64)
    for start in range(0, len(rows), _BLOCK):
        some = slice(start, start + _BLOCK)
        if not np.array_equal(sets[labels[some]], rows[some]):
            return None  # numbers of different rows may be alike, if somebody wants them to
    return sets, labels
