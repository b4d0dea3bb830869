"""Centres to an octree's streams: :func:`build`; or to the order of its leaves alone: :func:`leaf_order`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native import octree as native_octree
from potr_cl.codec.octree.parser import DEEPEST_LEVEL, U8, U64, OctreeStreams, check_centres, parse
from potr_cl.host.threads import Run
from potr_cl.model.order import spread
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

#: Splats worked on at a time where each stands for itself: the temporaries of a block stay in the cache.
_BLOCK = 1 << 15
#: Levels whose octants fit a 64-bit Morton word.
_LEVELS_A_WORD = 21

F64 = NDArray[np.float64]


def build(
    means: NDArray[np.float32], tolerance: F64 | float, absolute: bool = False, run: Run = map
) -> tuple[OctreeStreams, NDArray[np.int64]]:
    """Build and serialise the octree of a scene's centres.

    Args:
        means: (N, 3) float32 centres, world units, finite, N >= 1.
        tolerance: the largest allowed distance of a centre to its leaf's centre, world units, > 0: (N,) or one for all.
            Never taken finer than float32 can hold the coordinates themselves.
        absolute: leaves lie at the first level at which no point of a cell is farther than that from its centre, which
            the level of leaves nearby foretells; without, at the first whose centre happens to be near enough.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        The streams, and ``order`` (N,): the splats' indices in the order of the leaves.
    """
    begun = begin(means, tolerance, absolute, run)
    return begun.streams(), begun.order


@dataclass(frozen=True)
class Begun:
    """An octree whose streams are still to be written.

    Attributes:
        order: (N,) the splats' indices in the order of the leaves.
        depth: of the octree.
        streams: returns the streams; another thread may call it.
        decoded: takes what shares work out, and returns (N, 3) float32, the centres as
            :func:`potr_cl.codec.octree.parse` finds them in the streams; it raises what that does.
    """

    order: NDArray[np.int64]
    depth: int
    streams: Callable[[], OctreeStreams]
    decoded: Callable[[Run], NDArray[np.float32]]


@definition
def begin(means: NDArray[np.float32], tolerance: F64 | float, absolute: bool = False, run: Run = map) -> Begun:
    """:func:`build`, where what the streams are not needed for need not wait for them.

    Args:
        means, tolerance, absolute, run: as :func:`build` takes them.
    """
    streams, order = _build_in_numpy(means, tolerance, absolute)
    parts = -(-len(order) // _BLOCK)
    return Begun(order, streams.depth, lambda: streams, lambda run: parse(streams, len(order), run, parts))


def _build_in_numpy(
    means: NDArray[np.float32], tolerance: F64 | float, absolute: bool
) -> tuple[OctreeStreams, NDArray[np.int64]]:
    """:func:`build`, as NumPy does it."""
    n = len(means)
    axes, low, side, limit, depth, grid = _gridded(means, tolerance)
    words = _morton_words(grid, depth)
    order = _depth_first(words)
    grid = [g[order] for g in grid]
    common = _common_levels([w[order] for w in words], depth)
    del words

    # A splat is alone from the level below the last one that it shares with a neighbour in the order.
    alone = np.maximum(common[:-1], common[1:]) + 1
    single = alone <= depth

    occupancy, several, starts = _serialise_tree(grid, common, alone, depth)
    multiplicities = np.diff(np.append(starts, n))[~single[starts]] if not single.all() else np.empty(0, np.int64)

    if absolute:
        wanted = _levels_for(side, limit, depth)[order]
        leaf_level = np.maximum(wanted, alone)
    else:
        leaf_level = np.empty(n, np.int8)
        for start in range(0, n, _BLOCK):
            block = slice(start, start + _BLOCK)
            rows = order[block]
            leaf_level[block] = _leaf_levels(
                [a[rows] for a in axes], low, side, [g[block] for g in grid], alone[block], depth, limit[rows]
            )
    lengths = (leaf_level[single] - alone[single]).astype(np.uint8)
    tails = _serialise_tails([g[single] for g in grid] if len(multiplicities) else grid, lengths, alone[single], depth)
    streams = OctreeStreams(
        origin=(low[0], low[1], low[2]),
        side=side,
        depth=depth,
        occupancy=occupancy,
        several=several,
        multiplicities=multiplicities.astype(np.uint64),
        leaf_levels=(wanted if absolute else leaf_level)[single].astype(np.uint8),
        tails=tails,
    )
    return streams, order


@definition
def leaf_order(means: NDArray[np.float32], tolerance: F64 | float) -> NDArray[np.int64]:
    """(N,) the order that :func:`build` returns, without the streams; centres and tolerances as it takes them."""
    *_, depth, grid = _gridded(means, tolerance)
    return _depth_first(_morton_words(grid, depth))


def _leaf_order_by_c(c: CFunctions, means: NDArray[np.float32], tolerance: F64 | float) -> NDArray[np.int64]:
    *_, words = _words_of(c, means, tolerance)
    return native_octree.order(c, words)[0]


def _begin_by_c(
    c: CFunctions, means: NDArray[np.float32], tolerance: F64 | float, absolute: bool = False, run: Run = map
) -> Any:
    if not absolute:
        return NotImplemented
    low, side, limit, depth, words = _words_of(c, means, tolerance, run)
    order, words = native_octree.order(c, words, run)
    half_diagonal = _half_diagonal(side)
    wanted = native_octree.wanted(c, limit, half_diagonal, depth) if half_diagonal else np.zeros(len(limit), np.int8)
    unclear = np.flatnonzero(wanted < 0)
    wanted[unclear] = _levels_for(side, limit[unclear], depth)
    origin = (float(low[0]), float(low[1]), float(low[2]))

    def streams() -> OctreeStreams:
        found = native_octree.streams(c, words, depth, order, wanted)
        return OctreeStreams(origin, side, depth, *found)

    def decoded(run: Run) -> NDArray[np.float32]:
        sides = np.ldexp(side, -np.arange(depth + 1))
        centres = native_octree.decoded(c, words, depth, order, wanted, sides, np.array(origin), run)
        check_centres(origin, side, centres)
        return centres

    return Begun(order, depth, streams, decoded)


def _words_of(
    c: CFunctions, means: NDArray[np.float32], tolerance: F64 | float, run: Run = map
) -> tuple[F64, float, F64, int, U64]:
    """The cube's corner and side; tolerances; the deepest level, and Morton words."""
    means = np.ascontiguousarray(means, np.float32)
    tolerances = np.ascontiguousarray(np.atleast_1d(tolerance), np.float64)
    low, high, limit, finest = native_octree.bounds(c, means, tolerances)
    side = float((high - low).max())
    depth = _depth_for(side, finest)
    words = native_octree.words(c, means, low, 2.0**depth / side if side > 0 else 0.0, depth, run)
    return low, side, limit, depth, words


def _gridded(
    means: NDArray[np.float32], tolerance: F64 | float
) -> tuple[list[F64], list[float], float, F64, int, list[U64]]:
    """Coordinates by axis; the cube's corner and side; tolerances; the deepest level, and coordinates in its cells.

    The test of centres works with real distances, so that a rounding into the neighbouring cell cannot break it.
    """
    axes = [means[:, a].astype(np.float64) for a in range(3)]
    low = [float(a.min()) for a in axes]
    side = max(float(a.max()) - lo for a, lo in zip(axes, low, strict=True))
    resolution = np.maximum(np.maximum(np.abs(axes[0]), np.abs(axes[1])), np.abs(axes[2])) * 2.0**-23
    limit: F64 = np.maximum(tolerance, resolution)
    depth = _depth_for(side, float(limit.min()))
    cells = 2.0**depth
    grid = [
        np.minimum((axis - lo) * (cells / side if side > 0 else 0.0), cells - 1).astype(np.uint64)
        for axis, lo in zip(axes, low, strict=True)
    ]
    return axes, low, side, limit, depth, grid


def _depth_first(words: list[U64]) -> NDArray[np.int64]:
    return _ascending(words[0]) if len(words) == 1 else np.lexsort(words[::-1])


def _ascending(words: U64) -> NDArray[np.int64]:
    """The order of the words; equal ones stay in the order that they have.

    NumPy sorts much faster where it need not keep that order, and few words are equal: those are put in order here.
    """
    order = np.argsort(words)
    equal = np.zeros(len(words) + 1, bool)
    sorted_words = words[order]
    np.equal(sorted_words[1:], sorted_words[:-1], out=equal[1:-1])
    among = equal[1:] | equal[:-1]
    if among.any():
        # The runs of equal words, one after the other, each by the words' numbers.
        runs = np.cumsum(~equal[:-1][among])
        tied = order[among]
        order[among] = tied[np.lexsort((tied, runs))]
    return order


def _depth_for(side: float, tolerance: float) -> int:
    """The first level whose cells' half diagonal is below the tolerance (with a margin for rounding)."""
    half_diagonal = _half_diagonal(side)
    if half_diagonal == 0 or half_diagonal < tolerance:
        return 0
    return min(DEEPEST_LEVEL, int(np.floor(np.log2(half_diagonal / tolerance) + 1e-6)) + 1)


def _half_diagonal(side: float) -> float:
    return side * float(np.sqrt(3) / 2)


def _levels_for(side: float, tolerance: F64, depth: int) -> NDArray[np.int8]:
    """:func:`_depth_for` of each tolerance."""
    half_diagonal = _half_diagonal(side)
    if half_diagonal == 0:
        return np.zeros(len(tolerance), np.int8)
    levels = np.floor(np.log2(half_diagonal / tolerance) + 1e-6) + 1
    clipped: NDArray[np.int8] = np.clip(levels, 0, depth).astype(np.int8)
    return clipped


def _morton_words(grid: list[U64], depth: int) -> list[U64]:
    """Interleaved coordinates, most significant word first, 21 levels a word, left-aligned."""
    n = len(grid[0])
    words = [np.empty(n, np.uint64) for _ in range(0, max(depth, 1), _LEVELS_A_WORD)]
    for start in range(0, n, _BLOCK):
        block = slice(start, start + _BLOCK)
        for number, word in enumerate(words):
            shift = depth - (number + 1) * _LEVELS_A_WORD
            bits = np.zeros(len(word[block]), np.uint64)
            for axis, g in enumerate(grid):
                part = g[block] >> np.uint64(shift) if shift >= 0 else g[block] << np.uint64(-shift)
                bits |= spread(part & np.uint64(0x1FFFFF)) << np.uint64(axis)
            word[block] = bits
    return words


def _common_levels(words: list[U64], depth: int) -> NDArray[np.int8]:
    """(N + 1,) levels that splat i - 1 and splat i of the order share; -1 at both ends, which have one neighbour."""
    n = len(words[0])
    common = np.full(n + 1, -1, np.int8)
    inner = np.full(n - 1, depth, np.int8)
    undecided = np.ones(n - 1, bool)
    for k, word in enumerate(words):
        differs = word[1:] ^ word[:-1]
        here = undecided & (differs != 0)
        # Only the top bit counts; clearing the one below it keeps the conversion to float from rounding it up.
        top = differs[here]
        top &= ~(top >> np.uint64(1))
        exponent = np.frexp(top.astype(np.float64))[1] - 1
        inner[here] = _LEVELS_A_WORD * k + (3 * _LEVELS_A_WORD - 1 - exponent) // 3
        undecided &= ~here
    common[1:-1] = inner
    return common


def _octants(grid: list[U64], index: NDArray[np.int64], shift: int) -> U8:
    bits: list[U8] = [((g[index] >> np.uint64(shift)) & np.uint64(1)).astype(np.uint8) for g in grid]
    numbers: U8 = bits[0] | bits[1] << np.uint8(1) | bits[2] << np.uint8(2)
    return numbers


def _serialise_tree(
    grid: list[U64], common: NDArray[np.int8], alone: NDArray[np.int8], depth: int
) -> tuple[U8, U8, NDArray[np.int64]]:
    """Occupancy and several-flags breadth first, and the first splat of each leaf in Morton order."""
    occupancy: list[U8] = []
    flags: list[NDArray[np.bool_]] = []
    # Splats that still share their node with others; a run of them with common > level - 1 is a node of that level.
    crowd = np.flatnonzero(alone > 0)
    for level in range(depth):
        if len(crowd) == 0:
            break
        shared = common[crowd]
        child_starts = crowd[shared <= level]
        node_starts = np.flatnonzero(common[child_starts] < level)
        octants = _octants(grid, child_starts, depth - 1 - level)
        occupancy.append(np.add.reduceat(np.left_shift(np.uint8(1), octants), node_starts, dtype=np.uint8))
        flags.append(alone[child_starts] > level + 1)
        crowd = crowd[alone[crowd] > level + 1]
    # What is still crowded at the deepest level shares a leaf with the splat before it where all levels are common.
    first = common[:-1] < depth
    if depth == 0:
        first[1:] = False
    packed = np.packbits(np.concatenate(flags), bitorder="little") if flags else np.empty(0, np.uint8)
    occupied = np.concatenate(occupancy) if occupancy else np.empty(0, np.uint8)
    return occupied, packed, np.flatnonzero(first)


def _leaf_levels(
    axes: list[F64], low: list[float], side: float, grid: list[U64], alone: NDArray[np.int8], depth: int, limit: F64
) -> NDArray[np.int8]:
    """The first level from ``alone`` on whose cell centre lies within the limit; ``depth`` at the latest."""
    level_of = np.full(len(alone), depth, np.int8)
    pending = np.flatnonzero(alone <= depth)
    squared = limit * limit
    for level in range(depth):
        ready = alone[pending] <= level
        here = pending[ready]
        if len(here) == 0:
            continue
        distance = np.zeros(len(here))
        cell = side * 2.0**-level
        for axis, lo, g in zip(axes, low, grid, strict=True):
            centre = lo + ((g[here] >> np.uint64(depth - level)).astype(np.float64) + 0.5) * cell
            centre -= axis[here]
            distance += centre * centre
        done = distance < squared[here]
        level_of[here[done]] = level
        ready[ready] = done
        pending = pending[~ready]
    return level_of


def _serialise_tails(grid: list[U64], lengths: U8, alone: NDArray[np.int8], depth: int) -> U8:
    longest_first = np.argsort(np.uint8(255) - lengths, kind="stable")
    reach = np.cumsum(np.bincount(lengths, minlength=1)[::-1])[::-1]  # leaves whose tail has at least this length
    shift = (depth - 1 - alone).astype(np.int16)[longest_first]
    sorted_grid = [g[longest_first] for g in grid]
    planes: list[U8] = []
    for level in range(1, len(reach)):
        k = reach[level]
        down = (shift[:k] - (level - 1)).astype(np.uint64)
        planes.extend(
            np.packbits(((g[:k] >> down) & np.uint64(1)).astype(np.uint8), bitorder="little") for g in sorted_grid
        )
    return np.concatenate(planes) if planes else np.empty(0, np.uint8)
