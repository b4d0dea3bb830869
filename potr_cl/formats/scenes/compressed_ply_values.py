"""What the integers of a compressed PLY stand for, in both directions (:func:`packed_geometry` and its like), and which
splats share their bounds (:func:`in_chunks`).

256 splats in sequence share the bounds of their centres, logarithms of scales and colours; within them centres and
scales have 11, 10 and 11 bits, colours 8. Opacities and SH coefficients have 8 bits, rotations three parts of 10 bits,
without the largest.

The steps of a chunk's centres are parts of its extent, so splats that are near each other should share one. A k-d tree
makes chunks that are more compact than runs of a space-filling curve, which jumps: errors of centres have 0.55 of the
energy on lego.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree
from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.formats.scenes.scene_files import OTHER_PARTS, SH_0, with_largest
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray, Scene

#: Splats that share one set of bounds.
CHUNK = 256
#: Logarithms of scales outside are cut, as other writers do.
_SCALE_LIMIT = np.float32(20)
#: Splats unpacked at a time, whole chunks: the temporaries stay small.
_BLOCK = 1 << 16
#: What readers make of opacities of 0 and 1.
_LARGEST_LOGIT = np.float32(10)
#: Shifts and bits of three values in a word.
_POSITION = ((21, 11), (11, 10), (0, 11))
_COLOUR = ((24, 8), (16, 8), (8, 8))
#: Of the centres' coordinates.
POSITION_BITS = tuple(bits for _, bits in _POSITION)

Words = NDArray[np.uint32]
U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class PackedGeometry:
    """All but the colours, N splats in C chunks.

    Attributes:
        means, log_scales: (C, 2, 3) float32, the lower and the upper bounds.
        positions, rotations, scales: (N,) words.
        opacities: (N,) levels.
    """

    means: FloatArray
    log_scales: FloatArray
    positions: Words
    rotations: Words
    scales: Words
    opacities: U8

    @staticmethod
    def joined(parts: Sequence[PackedGeometry]) -> PackedGeometry:
        """One of several, each of which but the last has whole chunks."""
        return PackedGeometry(
            *(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(PackedGeometry))
        )


def packed_geometry(scene: Scene) -> PackedGeometry:
    """Geometry and opacities of a scene with unit quaternions, in its order."""
    means, positions = _packed_in_bounds(scene.means, _POSITION)
    log_scales, scales = _packed_in_bounds(np.clip(scene.log_scales, -_SCALE_LIMIT, _SCALE_LIMIT), _POSITION)
    with np.errstate(over="ignore"):
        opacities = np.round(255 / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))).astype(np.uint8)
    return PackedGeometry(means, log_scales, positions, _packed_rotations(scene.quaternions), scales, opacities)


def unpacked_geometry(packed: PackedGeometry) -> Scene:
    """What readers see, with colours of zero."""
    count = len(packed.positions)
    byte = np.arange(256, dtype=np.float32) / np.float32(255)
    with np.errstate(divide="ignore"):
        logits = np.zeros(256, np.float32)
        logits[1:255] = natural_logarithm((byte / (1 - byte))[1:255])
    logits[[0, 255]] = -_LARGEST_LOGIT, _LARGEST_LOGIT
    return Scene(
        _unpacked_in_bounds(packed.means, packed.positions, _POSITION),
        _unpacked_in_bounds(packed.log_scales, packed.scales, _POSITION),
        _unpacked_rotations(packed.rotations),
        logits.take(packed.opacities),
        np.zeros((count, 1, 3), np.float32),
    )


def packed_colours(dc: FloatArray) -> tuple[FloatArray, Words]:
    """Constant coefficients (N, 3) as bounds (C, 2, 3) of colours, and words without opacities."""
    return _packed_in_bounds(dc * np.float32(SH_0) + np.float32(0.5), _COLOUR)


def packed_sh(sh: NDArray[np.floating]) -> U8:
    """AC coefficients as levels of the same shape. 0 and 255, which readers disagree about, are not used."""
    levels: U8 = np.clip(np.floor(sh * np.float32(32)) + np.float32(128), 1, 254).astype(np.uint8)
    return levels


def unpacked_sh(levels: U8) -> FloatArray:
    """Levels of :func:`packed_sh` as coefficients."""
    return (levels.astype(np.float32) - np.float32(127.5)) / np.float32(32)


def element_bytes(packed: PackedGeometry, colours: tuple[FloatArray, Words], sh: U8) -> tuple[bytes, bytes, bytes]:
    """The elements chunk, vertex and sh of a file.

    Args:
        packed: geometry.
        colours: of :func:`packed_colours`.
        sh: of :func:`packed_sh`.
    """
    bounds, words = colours
    parts = [packed.means, packed.log_scales, bounds]
    chunk = np.concatenate([part.reshape(len(part), 6) for part in parts], axis=1).astype("<f4")
    vertex = np.stack([packed.positions, packed.rotations, packed.scales, words | packed.opacities], axis=1)
    return chunk.tobytes(), vertex.astype("<u4").tobytes(), np.ascontiguousarray(sh.transpose(0, 2, 1)).tobytes()


def unpacked(chunk: bytes, vertex: bytes, sh: bytes) -> Scene:
    """The scene of what :func:`element_bytes` has returned."""
    all_bounds = np.frombuffer(chunk, "<f4").reshape(-1, 3, 2, 3)
    all_words = np.frombuffer(vertex, "<u4").reshape(-1, 4)
    levels = np.frombuffer(sh, np.uint8).reshape(len(all_words), 3, -1).transpose(0, 2, 1)
    scene = Scene.blank(len(all_words), 1 + levels.shape[1], by_splat=True)

    def unpack(start: int) -> None:
        words, bounds = all_words[start : start + _BLOCK], all_bounds[start // CHUNK : (start + _BLOCK) // CHUNK]
        opacities = (words[:, 3] & np.uint32(255)).astype(np.uint8)
        packed = PackedGeometry(bounds[:, 0], bounds[:, 1], words[:, 0], words[:, 1], words[:, 2], opacities)
        with np.errstate(all="ignore"):  # of bounds that are not finite, whose splats are dropped
            colours = _unpacked_in_bounds(bounds[:, 2], words[:, 3], _COLOUR)
            part = unpacked_geometry(packed)
        coefficients = scene.sh[start : start + _BLOCK]
        coefficients[:, 0] = (colours - np.float32(0.5)) / np.float32(SH_0)
        coefficients[:, 1:] = unpacked_sh(levels[start : start + _BLOCK])
        scene.put(start, replace(part, sh=coefficients))

    with thread_pool() as pool:
        list(pool.map(unpack, range(0, len(all_words), _BLOCK)))
    return scene


def _packed_in_bounds(values: FloatArray, places: Any) -> tuple[FloatArray, Words]:
    starts = np.arange(0, len(values), CHUNK)
    bounds = np.stack([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    chunk = np.arange(len(values)) // CHUNK
    words = np.zeros(len(values), np.uint32)
    for axis, (shift, bits) in enumerate(places):
        low = bounds[:, 0, axis].astype(np.float64)
        extent = bounds[:, 1, axis] - low
        scale = np.divide((1 << bits) - 1, extent, out=np.zeros_like(extent), where=extent > 0)
        levels = np.floor((values[:, axis] - low[chunk]) * scale[chunk] + 0.5)
        words |= np.clip(levels, 0, (1 << bits) - 1).astype(np.uint32) << np.uint32(shift)
    return bounds, words


def _unpacked_in_bounds(bounds: FloatArray, words: Words, places: Any) -> FloatArray:
    chunk = np.arange(len(words)) // CHUNK
    values = np.empty((len(words), 3), np.float32)
    for axis, (shift, bits) in enumerate(places):
        most = (1 << bits) - 1
        part = (words >> np.uint32(shift) & np.uint32(most)) / np.float64(most)
        low, high = bounds[:, 0, axis].astype(np.float64), bounds[:, 1, axis].astype(np.float64)
        values[:, axis] = low[chunk] + part * (high - low)[chunk]
    return values


def _packed_rotations(quaternions: FloatArray) -> Words:
    """The number of the largest part of w, x, y, z and the three others."""
    turned = quaternions.astype(np.float64)
    largest = np.abs(turned).argmax(axis=1)
    turned *= np.where(np.take_along_axis(turned, largest[:, None], axis=1) < 0, -1, 1)
    others = np.take_along_axis(turned, OTHER_PARTS[largest], axis=1)
    levels = np.clip(np.floor((others * np.sqrt(0.5) + 0.5) * 1023 + 0.5), 0, 1023).astype(np.uint32)
    words: Words = largest.astype(np.uint32) << 30 | levels[:, 0] << 20 | levels[:, 1] << 10 | levels[:, 2]
    return words


def _unpacked_rotations(words: Words) -> FloatArray:
    others = np.stack([(words >> np.uint32(shift) & np.uint32(1023)) for shift in (20, 10, 0)], axis=1)
    parts = (others / 1023.0 - 0.5) * np.sqrt(2.0)
    largest = (words >> np.uint32(30)).astype(np.intp)
    return with_largest(largest, parts, OTHER_PARTS)


#: Parts of the tree that threads take, at least so many splats each.
_PART = 1 << 15


def in_chunks(means: FloatArray, threads: int = 0) -> NDArray[np.int64]:
    """(N,) the numbers of splats in an order of which each :data:`CHUNK` in sequence lie near each other.

    Those of a chunk follow Morton's curve.

    Args:
        means: (N, 3) float32, finite.
        threads: to work with; the result does not depend on it. 0: one a processor.
    """
    # Viewers draw splats of nearly the same depth in the order of the file, so it should be that of other writers.
    side = max(float(axis.max()) - float(axis.min()) for axis in means.T)
    order = octree.leaf_order(means, max(side * 2.0**-20, 1e-30))
    tree = _Tree(means.take(order, axis=0))
    parts, small = [(0, len(means))], []
    while parts:
        start, end = parts.pop()
        if end - start <= max(_PART, CHUNK):
            small.append((start, end))
        else:
            middle = tree.split(start, end)
            parts += [(start, middle), (middle, end)]
    with thread_pool(threads) as pool:
        list(pool.map(lambda part: tree.split_to_chunks(*part), small))
    return order.take(tree.numbers.astype(np.int64))


class _Tree:
    """Numbers of splats, and their coordinates in the same order."""

    def __init__(self, means: FloatArray) -> None:
        self.numbers = np.arange(len(means), dtype=np.uint64)
        self._axes = [np.ascontiguousarray(column) for column in means.T]

    def split(self, start: int, end: int) -> int:
        """Order a part by the coordinate with the coarsest steps, as far as its two halves go; where they meet."""
        some = slice(start, end)
        steps = [(float(axis[some].max()) - float(axis[some].min())) / 2.0**bits
                 for axis, bits in zip(self._axes, POSITION_BITS, strict=True)]  # fmt: skip
        values = self._axes[int(np.argmax(steps))][some]
        chunks = -(-(end - start) // CHUNK)
        half = chunks // 2 * CHUNK
        # With its number, no coordinate is there twice: which splats are in which half does not depend on the machine.
        order = np.argpartition(_ascending(values) << np.uint64(32) | self.numbers[some], half)
        for each in (self.numbers, *self._axes):
            each[some] = each[some][order]
        return start + half

    def split_to_chunks(self, start: int, end: int) -> None:
        """Split a part until there are chunks, the splats of each in the order that the tree was given."""
        if end - start > CHUNK:
            middle = self.split(start, end)
            self.split_to_chunks(start, middle)
            self.split_to_chunks(middle, end)
        else:
            self.numbers[start:end].sort()


def _ascending(values: FloatArray) -> NDArray[np.uint64]:
    """Integers of 32 bits in the order of floats."""
    bits = np.ascontiguousarray(values + np.float32(0)).view(np.uint32)  # -0.0 is 0.0 then
    flipped = np.where(bits >> np.uint32(31), ~bits, bits | np.uint32(1 << 31))
    return flipped.astype(np.uint64)
