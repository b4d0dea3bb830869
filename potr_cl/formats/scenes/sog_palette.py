"""The palette of a scene's SH coefficients that a SOG file wants: :func:`palette_of`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from potr_cl.clustering.codebook import codebook, nearest
from potr_cl.formats.scenes.sog_images import CODEBOOK, PALETTE, Palette
from potr_cl.model.scene import FloatArray, Scene

if TYPE_CHECKING:
    from potr_cl.opencl.device import Device

#: What a splat counts for at most, in those that count for as much as the median does: so that not one of them, as a
#: backdrop may be, has all entries near it.
_MOST_MEDIANS = 1000.0
#: Rows that are made numbers of at a time.
_BLOCK = 1 << 16
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
