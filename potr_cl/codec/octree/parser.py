"""What an octree is stored as (:class:`OctreeStreams`), which nobody vouches for, to centres: :func:`parse`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native import octree as native_octree
from potr_cl.errors import DataError
from potr_cl.host.threads import Run
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

#: Levels that float64 arithmetic on the root cube can tell apart.
DEEPEST_LEVEL = 52

_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)

U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]


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
        leaf_levels: uint8, one a leaf with a single splat, in Morton order: the level that its tail leads to; there is
            no tail where the splat is still in company at that level.
        tails: uint8, bit planes: for level 1, 2, … of the tails and axis x, y, z one plane, padded to whole bytes
            (first bit lowest), of the leaves whose tail reaches that level, longest tail first, then Morton order.
    """

    origin: tuple[float, float, float]
    side: float
    depth: int
    occupancy: U8
    several: U8
    multiplicities: U64
    leaf_levels: U8
    tails: U8


def check_centres(origin: tuple[float, float, float], side: float, means: NDArray[np.float32]) -> None:
    """Refuse centres, (N, 3), that single precision cannot hold.

    Args:
        origin, side: as of :class:`OctreeStreams`.
        means: the centres.

    Raises:
        DataError: there is one.
    """
    if max(map(abs, origin)) + side > _LARGEST_FLOAT32 and not np.isfinite(means).all():
        raise DataError("positions: a centre is beyond what single precision can hold")


#: Leaves worked on at a time where each stands for itself: the temporaries of a block stay in the cache.
_BLOCK = 1 << 15
#: Splats of a part that is worth a thread's while.
_PART = 1 << 10

Cells = NDArray[np.unsignedinteger]


@definition
def parse(streams: OctreeStreams, splats: int, run: Run = map, parts: int = 1) -> NDArray[np.float32]:
    """Leaf centres of a serialised octree.

    Args:
        streams: as :func:`build` made them, or as read from a file: nothing in them is trusted.
        splats: N, the number of splats that the streams must hold.
        run: shares out the parts of the native path's work.
        parts: at most so many.

    Returns:
        (N, 3) float32 centres, world units, in the order of the leaves.

    Raises:
        DataError: the streams contradict each other or the number of splats.
    """
    depth = streams.depth
    levels = _parse_tree(streams)
    singles = sum(level.singles for level in levels)
    crowded = levels[-1].nodes  # nodes at the deepest level that hold several splats
    _check_leaves(streams, singles, crowded, splats)

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

    alone = alone_level if is_crowded is None else alone_level[~is_crowded]
    _check_leaf_levels(streams)
    lengths = np.maximum(streams.leaf_levels, alone) - alone
    if is_crowded is not None:
        of_singles = lengths
        lengths = np.zeros(leaves, np.uint8)
        lengths[~is_crowded] = of_singles
    level_of = alone_level.astype(np.uint16) + lengths
    _append_tails(coordinates, lengths, streams.tails)

    cell = np.ldexp(streams.side, -np.arange(depth + 1))
    means = np.empty((leaves, 3), np.float32)
    with np.errstate(over="ignore"):
        for start in range(0, leaves, _BLOCK):
            block = slice(start, start + _BLOCK)
            size = cell[level_of[block]]
            for axis, c in enumerate(coordinates):
                means[block, axis] = (c[block].astype(np.float64) + 0.5) * size + streams.origin[axis]
    check_centres(streams.origin, streams.side, means)
    if is_crowded is not None:
        counts = np.ones(leaves, np.int64)
        counts[is_crowded] = streams.multiplicities.astype(np.int64)
        means = np.repeat(means, counts, axis=0)
    return means


def _parse_by_c(
    c: CFunctions, streams: OctreeStreams, splats: int, run: Run = map, parts: int = 1
) -> NDArray[np.float32]:
    depth = _checked_depth(streams.depth)
    tree = native_octree.tree(c, streams.occupancy, streams.several, depth, _crowded_root(streams))
    if tree is None:
        raise _no_tree()
    _check_leaves(streams, tree.singles, tree.crowded, splats)
    _check_leaf_levels(streams)
    walk = native_octree.Walk(
        c, tree, streams.leaf_levels, streams.multiplicities, splats, max(1, min(parts, splats // _PART))
    )
    list(run(walk.leaves, range(walk.parts)))
    counts = walk.counts
    _check_tail_size(np.cumsum(counts[::-1].astype(np.int64))[::-1], len(streams.tails))
    if not walk.check_tails(streams.tails):
        raise _padded_wrongly()
    sides, origin = np.ldexp(streams.side, -np.arange(depth + 1)), np.array(streams.origin, np.float64)
    list(run(lambda part: walk.centres(part, sides, origin), range(walk.parts)))
    check_centres(streams.origin, streams.side, walk.means)
    return walk.means


def _checked_depth(depth: int) -> int:
    if not 0 <= depth <= DEEPEST_LEVEL:
        raise DataError(f"positions: an octree of {depth} levels, the format allows {DEEPEST_LEVEL}")
    return depth


def _crowded_root(streams: OctreeStreams) -> bool:
    return len(streams.occupancy) > 0 or len(streams.multiplicities) > 0


def _check_leaves(streams: OctreeStreams, singles: int, crowded: int, splats: int) -> None:
    total = int(singles) + int(np.minimum(streams.multiplicities, np.uint64(splats + 1)).sum(dtype=np.float64))
    if len(streams.multiplicities) != crowded or len(streams.leaf_levels) != singles:
        raise DataError("positions: the octree's leaves do not match its multiplicities and tails")
    if total != splats or (streams.multiplicities < 2).any():
        raise DataError(f"positions: the octree holds {total} splats, the header says {splats}")


def _check_leaf_levels(streams: OctreeStreams) -> None:
    if len(streams.leaf_levels) and int(streams.leaf_levels.max()) > streams.depth:
        raise DataError(f"positions: a leaf lies below the octree's deepest level {streams.depth}")


def _check_tail_size(reach: NDArray[np.int64], size: int) -> None:
    """``reach``: leaves whose tail has at least 0, 1, … levels."""
    expected = sum(3 * ((int(k) + 7) // 8) for k in reach[1:])
    if expected != size:
        raise DataError(f"positions: {size} bytes of tails where their lengths ask for {expected}")


def _no_tree() -> DataError:
    return DataError("positions: the octree's nodes do not add up")


def _padded_wrongly() -> DataError:
    return DataError("positions: a tail's padding is not zero")


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
    damaged = _no_tree()
    depth = _checked_depth(streams.depth)
    root_several = _crowded_root(streams)
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
    _check_tail_size(reach, len(tails))
    longest_first = np.argsort(np.uint8(255) - lengths, kind="stable")[: reach[1] if len(reach) > 1 else 0]
    at = 0
    word = coordinates[0].dtype.type
    values: list[Cells] = [np.zeros(len(longest_first), word) for _ in range(3)]
    for k in reach[1:]:
        nbytes = (int(k) + 7) // 8
        for value in values:
            bits = np.unpackbits(tails[at : at + nbytes], bitorder="little")
            if bits[k:].any():
                raise _padded_wrongly()
            value[:k] <<= word(1)
            value[:k] |= bits[:k]
            at += nbytes
    for c, value in zip(coordinates, values, strict=True):
        c <<= lengths
        c[longest_first] |= value
