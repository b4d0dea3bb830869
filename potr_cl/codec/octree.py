"""Octree: splat centres as leaves of an octree (paper section "Codec"; docs/format.md, "Positions").

A leaf is split while it holds several splats or while its centre is too far from its splat. Two parts are stored:

* The *tree* down to the level at which every splat is alone, breadth first: an occupancy byte for each node that holds
  several splats, and a bit for each child that says whether the child holds several too. Level by level it decodes in
  a few vectorised steps, where the paper's depth-first walk is one step a node.
* The *tails*: the path of a lone splat below that level. In an occupancy byte such a path costs more than the three
  bits a level that it is worth, so tails are stored as plain bit planes, coarsest level first.

Splats that even the deepest level cannot separate share a leaf that carries a multiplicity. The order of all
attribute streams is the depth-first (Morton) order of the leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

#: Levels that float64 arithmetic on the root cube can tell apart.
DEEPEST_LEVEL = 52
_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
#: Splats worked on at a time where each stands for itself: the temporaries of a block stay in the cache.
_BLOCK = 1 << 15
#: Levels whose octants fit a 64-bit Morton word.
_LEVELS_A_WORD = 21

U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
F64 = NDArray[np.float64]
Cells = NDArray[np.unsignedinteger]


@dataclass(frozen=True)
class OctreeStreams:
    """A serialised octree.

    Attributes:
        origin: corner of the root cube with the smallest coordinates, world units.
        side: edge of the root cube, world units; 0 if all centres coincide.
        depth: deepest level of any leaf, 0 to 52.
        occupancy: uint8, one a node that holds several splats and lies above ``depth``, breadth first; bit
            ``x + 2 y + 4 z`` is set if the child octant at (x, y, z) holds a splat.
        several: uint8, bits packed with the first in the lowest bit: one a child in the order of ``occupancy``, set if
            the child holds several splats.
        multiplicities: uint64, number of splats of each leaf at ``depth`` that holds several, in Morton order.
        tail_lengths: uint8, one a leaf with a single splat, in Morton order: levels below the one where it is alone; if
            ``absolute``, the level itself, which is not reached where the splat is still in company there.
        tails: uint8, bit planes: for level 1, 2, … of the tails and axis x, y, z one plane, padded to whole bytes
            (first bit lowest), of the leaves whose tail reaches that level, longest tail first, then Morton order.
    """

    origin: tuple[float, float, float]
    side: float
    depth: int
    occupancy: U8
    several: U8
    multiplicities: U64
    tail_lengths: U8
    tails: U8
    absolute: bool = False


# ---------------------------------------------------------------------------------------------------- build


def build(
    means: NDArray[np.float32], tolerance: F64 | float, absolute: bool = False
) -> tuple[OctreeStreams, NDArray[np.int64]]:
    """Build and serialise the octree of a scene's centres.

    Args:
        means: (N, 3) float32 centres, world units, finite, N >= 1.
        tolerance: the largest allowed distance of a centre to its leaf's centre, world units, > 0: (N,) or one for all.
            Never taken finer than float32 can hold the coordinates themselves.
        absolute: leaves lie at the first level at which no point of a cell is farther than that from its centre, which
            the level of leaves nearby foretells; without, at the first whose centre happens to be near enough.

    Returns:
        The streams, and ``order`` (N,): the splats' indices in the order of the leaves.
    """
    n = len(means)
    axes = [means[:, a].astype(np.float64) for a in range(3)]
    low = [float(a.min()) for a in axes]
    side = max(float(a.max()) - lo for a, lo in zip(axes, low, strict=True))

    resolution = np.maximum(np.maximum(np.abs(axes[0]), np.abs(axes[1])), np.abs(axes[2])) * 2.0**-23
    limit: F64 = np.maximum(tolerance, resolution)
    depth = _depth_for(side, float(limit.min()))

    # Coordinates in units of the deepest cells; the centre test below works with real distances, so that a rounding
    # into the neighbouring cell cannot break the criterion.
    cells = 2.0**depth
    grid = [
        np.minimum((axis - lo) * (cells / side if side > 0 else 0.0), cells - 1).astype(np.uint64)
        for axis, lo in zip(axes, low, strict=True)
    ]

    words = _morton_words(grid, depth)
    order = np.argsort(words[0], kind="stable") if len(words) == 1 else np.lexsort(words[::-1])
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
        tail_lengths=wanted[single].astype(np.uint8) if absolute else lengths,
        tails=tails,
        absolute=absolute,
    )
    return streams, order


def _depth_for(side: float, tolerance: float) -> int:
    """The first level whose cells' half diagonal is below the tolerance (with a margin for rounding)."""
    half_diagonal = side * (np.sqrt(3) / 2)
    if half_diagonal == 0 or half_diagonal < tolerance:
        return 0
    return min(DEEPEST_LEVEL, int(np.floor(np.log2(half_diagonal / tolerance) + 1e-6)) + 1)


def _levels_for(side: float, tolerance: F64, depth: int) -> NDArray[np.int8]:
    """:func:`_depth_for` of each tolerance."""
    half_diagonal = side * (np.sqrt(3) / 2)
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
                bits |= _spread(part & np.uint64(0x1FFFFF)) << np.uint64(axis)
            word[block] = bits
    return words


def _spread(x: U64) -> U64:
    """Move bit i to bit 3 i, for 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


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
    axes: list[F64],
    low: list[float],
    side: float,
    grid: list[U64],
    alone: NDArray[np.int8],
    depth: int,
    limit: F64,
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


# ---------------------------------------------------------------------------------------------------- parse


def parse(streams: OctreeStreams, splats: int) -> NDArray[np.float32]:
    """Leaf centres of a serialised octree.

    Args:
        streams: as :func:`build` made them, or as read from a file: nothing in them is trusted.
        splats: N, the number of splats that the streams must hold.

    Returns:
        (N, 3) float32 centres, world units, in the order of the leaves.

    Raises:
        DataError: the streams contradict each other or the number of splats.
    """
    depth = streams.depth
    levels = _parse_tree(streams)
    singles = sum(level.singles for level in levels)
    crowded = levels[-1].nodes  # nodes at the deepest level that hold several splats
    total = int(singles) + int(np.minimum(streams.multiplicities, np.uint64(splats + 1)).sum(dtype=np.float64))
    if len(streams.multiplicities) != crowded or len(streams.tail_lengths) != singles:
        raise DataError("positions: the octree's leaves do not match its multiplicities and tails")
    if total != splats or (streams.multiplicities < 2).any():
        raise DataError(f"positions: the octree holds {total} splats, the header says {splats}")

    # Leaves in breadth-first order, with the rank of each in Morton order.
    ranks = _morton_ranks(levels)
    leaves = singles + crowded
    alone_level = np.empty(leaves, np.uint8)
    word = np.uint32 if depth < 32 else np.uint64
    coordinates: list[Cells] = [np.empty(leaves, word) for _ in range(3)]
    is_crowded = np.zeros(leaves, bool) if crowded else None
    path: list[Cells] = [np.zeros(1, word) for _ in range(3)]
    for number, level in enumerate(levels):
        if number:
            path = [p[level.parent] << word(1) for p in path]
            for axis, p in enumerate(path):
                p += (level.octant >> np.uint8(axis)) & np.uint8(1)
        ended = ~level.several if number < depth else slice(None)
        where = ranks[number][ended]
        alone_level[where] = number
        for c, p in zip(coordinates, path, strict=True):
            c[where] = p[ended]
        if is_crowded is not None and number == depth:
            is_crowded[ranks[number][level.several]] = True
        if number < depth:
            path = [p[level.several] for p in path]

    lengths = streams.tail_lengths
    if streams.absolute:
        alone = alone_level if is_crowded is None else alone_level[~is_crowded]
        if len(lengths) and int(lengths.max()) > depth:
            raise DataError(f"positions: a leaf lies below the octree's deepest level {depth}")
        lengths = np.maximum(lengths, alone) - alone
    if is_crowded is not None:
        of_singles = lengths
        lengths = np.zeros(leaves, np.uint8)
        lengths[~is_crowded] = of_singles
    level_of = alone_level.astype(np.uint16) + lengths
    if leaves and int(level_of.max()) > depth:
        raise DataError(f"positions: a tail leads below the octree's deepest level {depth}")
    _append_tails(coordinates, lengths, streams.tails)

    cell = np.ldexp(streams.side, -np.arange(depth + 1))
    means = np.empty((leaves, 3), np.float32)
    with np.errstate(over="ignore"):
        for start in range(0, leaves, _BLOCK):
            block = slice(start, start + _BLOCK)
            size = cell[level_of[block]]
            for axis, c in enumerate(coordinates):
                means[block, axis] = (c[block].astype(np.float64) + 0.5) * size + streams.origin[axis]
    if max(map(abs, streams.origin)) + streams.side > _LARGEST_FLOAT32 and not np.isfinite(means).all():
        raise DataError("positions: a centre is beyond what single precision can hold")
    if is_crowded is not None:
        counts = np.ones(leaves, np.int64)
        counts[is_crowded] = streams.multiplicities.astype(np.int64)
        means = np.repeat(means, counts, axis=0)
    return means


@dataclass
class _Level:
    """The nodes of one level that descend from a crowded node: their parents among the level above, octants, kinds."""

    parent: NDArray[np.int32]
    first: NDArray[np.int64]  # child of each crowded node above
    octant: U8
    several: NDArray[np.bool_]
    nodes: int  # that hold several splats
    singles: int


def _parse_tree(streams: OctreeStreams) -> list[_Level]:
    damaged = DataError("positions: the octree's nodes do not add up")
    depth = streams.depth
    root_several = len(streams.occupancy) > 0 or len(streams.multiplicities) > 0
    if not 0 <= depth <= DEEPEST_LEVEL:
        raise DataError(f"positions: an octree of {depth} levels, the format allows {DEEPEST_LEVEL}")
    several = np.array([root_several])
    nothing = np.zeros(1, np.int64)
    levels = [
        _Level(np.zeros(1, np.int32), nothing, np.zeros(1, np.uint8), several, int(root_several), int(not root_several))
    ]
    read = 0
    children_before = 0
    counts = np.bitwise_count(streams.occupancy)
    bits = np.unpackbits(streams.several, bitorder="little").view(bool)
    while levels[-1].nodes and len(levels) <= depth:
        nodes = levels[-1].nodes
        occupancy = streams.occupancy[read : read + nodes]
        if len(occupancy) < nodes or not occupancy.all():
            raise damaged
        children = counts[read : read + nodes]
        parent = np.repeat(np.arange(nodes, dtype=np.int32), children)
        first = np.cumsum(children, dtype=np.int64) - children
        read += nodes
        octant = (np.flatnonzero(np.unpackbits(occupancy, bitorder="little").view(bool)) & 7).astype(np.uint8)
        several = bits[children_before : children_before + len(octant)]
        if len(several) < len(octant):
            raise damaged
        children_before += len(octant)
        crowded = int(np.count_nonzero(several))
        levels.append(_Level(parent, first, octant, several, crowded, len(several) - crowded))
    if (
        read != len(streams.occupancy)
        or len(streams.several) != (children_before + 7) // 8
        or bits[children_before:].any()
        or (levels[-1].nodes and len(levels) != depth + 1)
    ):
        raise damaged
    return levels


def _morton_ranks(levels: list[_Level]) -> list[NDArray[Any]]:
    """For every node of each level the number of leaves before it in Morton order, from leaf counts of subtrees."""
    nodes = sum(len(level.several) for level in levels)
    word: type[np.signedinteger] = np.int32 if nodes < 1 << 31 else np.int64
    counts: list[NDArray[Any]] = []
    below: NDArray[Any] | None = None
    for level in reversed(levels):
        count = np.ones(len(level.several), word)
        if below is not None:
            count[level.several] = below
        counts.append(count)
        if level is not levels[0]:
            below = np.add.reduceat(count, level.first)
    counts.reverse()
    ranks: list[NDArray[Any]] = [np.zeros(1, word)]
    for above, level, count in zip(levels, levels[1:], counts[1:], strict=False):
        before = np.cumsum(count, dtype=word)
        before -= count
        offset = ranks[-1][above.several] - before[level.first]
        before += offset[level.parent]
        ranks.append(before)
    return ranks


def _append_tails(coordinates: list[Cells], lengths: U8, tails: U8) -> None:
    """Shift the tails' bits into the leaves' coordinates, in place."""
    histogram = np.bincount(lengths, minlength=1)
    reach = np.cumsum(histogram[::-1])[::-1]
    expected = sum(3 * ((int(k) + 7) // 8) for k in reach[1:])
    if expected != len(tails):
        raise DataError(f"positions: {len(tails)} bytes of tails where their lengths ask for {expected}")
    longest_first = np.argsort(np.uint8(255) - lengths, kind="stable")[: reach[1] if len(reach) > 1 else 0]
    at = 0
    word = coordinates[0].dtype.type
    values: list[Cells] = [np.zeros(len(longest_first), word) for _ in range(3)]
    for k in reach[1:]:
        nbytes = (int(k) + 7) // 8
        for value in values:
            bits = np.unpackbits(tails[at : at + nbytes], bitorder="little")
            if bits[k:].any():
                raise DataError("positions: a tail's padding is not zero")
            value[:k] <<= word(1)
            value[:k] |= bits[:k]
            at += nbytes
    for c, value in zip(coordinates, values, strict=True):
        c <<= lengths
        c[longest_first] |= value
