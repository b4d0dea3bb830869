"""Octrees by C: :func:`tree` finds a tree sound, :class:`Walk` finds its leaves' centres, part by part (octree.c); the
other functions make octrees of centres (octree_build.c).

C trusts what it is told: that is made here, of arrays whose sizes are checked. All gives the same bits as NumPy, may be
called from several threads at a time, and leaves the interpreter free.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.order import are_many, over_ranges
from potr_cl.native.declarations import CFunctions, address

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]

_LEVELS = 53  # of an octree, and lengths of tails
_TREE_WORDS = 2 * (_LEVELS + 1)
#: Coordinates of cells of trees that are deeper do not fit 32 bits.
_DEEPEST_NARROW = 32


@dataclass(frozen=True)
class Tree:
    """A tree that was found to be sound, by :func:`tree`.

    Attributes:
        occupancy, several: its streams.
        depth: 0 to 52.
        levels: where its levels begin.
        singles, crowded: leaves with a lone splat, and with several.
    """

    occupancy: U8
    several: U8
    depth: int
    levels: U64
    singles: int
    crowded: int


def tree(c: CFunctions, occupancy: U8, several: U8, depth: int, crowded_root: bool) -> Tree | None:
    """Check a tree; None if its streams contradict each other. ``depth`` is 0 to 52."""
    levels = np.empty(_TREE_WORDS, np.uint64)
    singles, crowded = ctypes.c_uint64(), ctypes.c_uint64()
    wrong = c["potr_octree_levels"](
        address(occupancy, np.uint8, len(occupancy)),
        len(occupancy),
        address(several, np.uint8, len(several)),
        len(several),
        depth,
        crowded_root,
        address(levels, np.uint64, _TREE_WORDS, True),
        ctypes.byref(singles),
        ctypes.byref(crowded),
    )
    return None if wrong else Tree(occupancy, several, depth, levels, singles.value, crowded.value)


class _Leaves(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in ("means", "cells", "levels", "tails"))


class Walk:
    """The leaves of a tree in depth-first order, in parts that threads share out.

    First :meth:`leaves` of each part, in any order, then :meth:`check_tails`, then :meth:`centres` of each part.

    Args:
        c: the library's functions.
        tree: sound.
        leaf_levels: one a leaf with a lone splat, none beyond the tree's depth.
        multiplicities: of the other leaves; with these there are ``splats``, N.
        splats: N.
        parts: at most so many.

    Attributes:
        parts: how many there are.
        means: (N, 3) float32, filled once all is done.

    Raises:
        TypeError: there are not as many splats, or arrays have wrong sizes.
    """

    def __init__(
        self, c: CFunctions, tree: Tree, leaf_levels: U8, multiplicities: U64, splats: int, parts: int
    ) -> None:
        if len(leaf_levels) and int(leaf_levels.max()) > tree.depth:
            raise TypeError("the native path was given leaves below the octree")
        self._c, self._tree = c, tree
        self._leaf_levels, self._multiplicities = leaf_levels, multiplicities
        self._size = c["potr_octree_cut"]()
        self._cuts = np.empty((parts + 1) * self._size // 8, np.uint64)
        self._levels_at = address(leaf_levels, np.uint8, tree.singles)
        self._multiplicities_at = address(multiplicities, np.uint64, tree.crowded)
        self._occupancy_at = address(tree.occupancy, np.uint8, len(tree.occupancy))
        self._several_at = address(tree.several, np.uint8, len(tree.several))
        self._cuts_at = address(self._cuts, np.uint64, len(self._cuts), True)
        self.parts: int = c["potr_octree_cuts"](
            self._occupancy_at,
            len(tree.occupancy),
            self._several_at,
            tree.depth,
            address(tree.levels, np.uint64, _TREE_WORDS),
            tree.singles,
            tree.crowded,
            self._multiplicities_at,
            splats,
            parts,
            self._cuts_at,
        )
        if not self.parts:
            raise TypeError("the native path was given a tree of another number of splats")
        self.means = np.empty((splats, 3), np.float32)
        self._cells = np.empty((splats, 3), np.uint64) if tree.depth > _DEEPEST_NARROW else None
        self._shapes = np.empty((2, splats), np.uint8)
        shapes = address(self._shapes, np.uint8, 2 * splats, True)
        self._leaves = _Leaves(
            address(self.means, np.float32, 3 * splats, True),
            None if self._cells is None else address(self._cells, np.uint64, 3 * splats, True),
            shapes,
            shapes + splats,
        )
        self._counts = np.zeros((self.parts, _LEVELS), np.uint64)
        self._tails: U8 | None = None

    def leaves(self, part: int) -> None:
        """Find a part's leaves."""
        cuts = self._cuts_of(part)
        self._c["potr_octree_leaves"](
            self._occupancy_at,
            self._several_at,
            self._tree.depth,
            *cuts,
            self._levels_at,
            self._multiplicities_at,
            ctypes.byref(self._leaves),
            address(self._counts[part], np.uint64, _LEVELS, True),
        )

    @property
    def counts(self) -> U64:
        """(53,) leaves with a tail of each length, once all leaves are found."""
        total: U64 = self._counts.sum(axis=0, dtype=np.uint64)
        return total

    def check_tails(self, tails: U8) -> bool:
        """Whether the padding of the planes of ``tails``, the bytes that :attr:`counts` ask for, is zero.

        Raises:
            TypeError: these are another number of bytes, or leaves are still to be found.
        """
        counts = self.counts
        reach = np.cumsum(counts[::-1].astype(np.int64))[::-1]
        if reach[0] != self._tree.singles or len(tails) != int((3 * ((reach[1:] + 7) // 8)).sum()):
            raise TypeError("the native path was given tails of another size than their lengths ask for")
        self._all_counts = counts
        # Leaves with a tail of each length come after all that have longer ones, and after those of the parts before.
        self._ranks = (reach - counts.astype(np.int64)).astype(np.uint64) + np.cumsum(
            self._counts, axis=0, dtype=np.uint64
        )
        self._ranks -= self._counts
        self._tails_at = address(tails, np.uint8, len(tails))
        self._tails = tails
        return not self._c["potr_octree_padding"](address(counts, np.uint64, _LEVELS), self._tails_at)

    def centres(self, part: int, sides: F64, origin: F64) -> None:
        """A part of :attr:`means`.

        Args:
            part: which.
            sides: (depth + 1,) edges of the cells of each level.
            origin: (3,).

        Raises:
            TypeError: tails are still to be checked.
        """
        if self._tails is None:
            raise TypeError("the native path was asked for centres before their tails were checked")
        self._c["potr_octree_centres"](
            *self._cuts_of(part),
            address(self._all_counts, np.uint64, _LEVELS),
            address(self._ranks[part], np.uint64, _LEVELS),
            self._multiplicities_at,
            self._tails_at,
            address(sides, np.float64, self._tree.depth + 1),
            address(origin, np.float64, 3),
            ctypes.byref(self._leaves),
        )

    def _cuts_of(self, part: int) -> tuple[int, int]:
        """Where a part begins and ends."""
        if not 0 <= part < self.parts:
            raise TypeError("the native path was asked for a part that is not there")
        return self._cuts_at + part * self._size, self._cuts_at + (part + 1) * self._size


I8 = NDArray[np.int8]
I64 = NDArray[np.int64]

_LEVELS_A_WORD = 21
#: Centres whose words a thread finds at a time.
_AT_A_TIME = 1 << 17
#: The same of decoded ones.
_DECODED = 1 << 15
_COUNTED = 54  # of counts


def bounds(c: CFunctions, means: F32, tolerance: F64) -> tuple[F64, F64, F64, float]:
    """The least and the largest coordinates of (n, 3) centres, (3,) each; (n,) limits, and the least of them.

    Args:
        means: (n, 3). tolerance: (n,) or (1,); limits are these, but never finer than float32 holds a coordinate.
    """
    n = len(means)
    limit, found = np.empty(n), np.empty(7)
    step = 0 if len(tolerance) == 1 else 1
    c["potr_octree_bounds"](
        address(means, np.float32, 3 * n),
        n,
        address(tolerance, np.float64, n if step else 1),
        step,
        address(limit, np.float64, n, True),
        address(found, np.float64, 7, True),
    )
    return found[:3], found[3:6], limit, float(found[6])


def words(c: CFunctions, means: F32, low: F64, ratio: float, depth: int, run: Run = map) -> U64:
    """(words, n) Morton words of (n, 3) centres, the most significant first, 21 levels a word.

    Args:
        means: none is below ``low`` (3,). ratio: cells of the deepest level in a unit of length. depth: 0 to 52.
        run: shares the work out.
    """
    n, number = len(means), max(-(-depth // _LEVELS_A_WORD), 1)
    words = np.empty((number, n), np.uint64)
    points, corner = address(means, np.float32, 3 * n), address(low, np.float64, 3)
    result = address(words, np.uint64, number * n, True)

    def find(first: int) -> None:
        some = min(_AT_A_TIME, n - first)
        c["potr_octree_words"](
            points + 12 * first, some, corner, ratio, 2.0**depth, depth, number, n, result + 8 * first
        )

    for _ in run(find, range(0, n, _AT_A_TIME)):
        pass
    return words


def wanted(c: CFunctions, limit: F64, half_diagonal: float, depth: int) -> I8:
    """(n,) levels of leaves for (n,) limits > 0; -1 where they depend on how a logarithm is rounded."""
    levels = np.empty(len(limit), np.int8)
    c["potr_octree_wanted"](
        address(limit, np.float64, len(limit)),
        len(limit),
        half_diagonal,
        depth,
        address(levels, np.int8, len(limit), True),
    )
    return levels


def order(c: CFunctions, words: U64, run: Run = map) -> tuple[I64, U64]:
    """(n,) the order of (words, n) Morton words, equal ones as they stand; and the words in that order.

    ``run`` shares the work on many out.
    """
    if not are_many(words.shape[1]):
        return _order(c, words)
    ordered = np.empty_like(words)

    def finish(members: I64, place: int) -> None:
        order, own = _order(c, np.ascontiguousarray(words[:, members]))
        members[:] = members[order]
        ordered[:, place : place + len(members)] = own

    return over_ranges(words[0], finish, run), ordered


def _order(c: CFunctions, words: U64) -> tuple[I64, U64]:
    n = words.shape[1]
    scratch = np.empty(int(c["potr_octree_sorting"]()), np.uint8)
    order, other_order, other_keys = np.arange(n), np.empty(n, np.int64), np.empty(n, np.uint64)
    for word in words[::-1]:
        keys = word[order]
        if c["potr_octree_sort"](
            n,
            address(scratch.view(np.uint64), np.uint64, scratch.size // 8, True),
            address(keys, np.uint64, n, True),
            address(order, np.int64, n, True),
            address(other_keys, np.uint64, n, True),
            address(other_order, np.int64, n, True),
        ):
            order, other_order, keys = other_order, order, other_keys
    if len(words) == 1:  # the words came with their numbers
        return order, keys[None]
    return order, np.ascontiguousarray(words[:, order])


def streams(c: CFunctions, words: U64, depth: int, order: I64, wanted: I8) -> tuple[U8, U8, U64, U8, U8]:
    """Occupancy, several-flags, multiplicities, levels of leaves, and tails.

    Args:
        words: (words, n) in the order of the leaves.
        depth: 0 to 52, which the words reach.
        order: (n,) number of each splat. wanted: (n,) levels by that number, 0 to ``depth``.
    """
    number, n = words.shape
    _check(words, depth, order, wanted)
    sizes = np.empty(3 * _COUNTED + 2, np.uint64)
    if c["potr_octree_sizes"]() != sizes.nbytes:
        raise TypeError("the native path counts in another way")
    given = (
        address(words, np.uint64, number * n), n, number, depth,
        address(order, np.int64, n), address(wanted, np.int8, n), address(sizes, np.uint64, sizes.size, True),
    )  # fmt: skip
    c["potr_octree_survey"](*given)
    nodes, children, tails = sizes[:-2].reshape(3, _COUNTED)
    singles, packed = (int(size) for size in sizes[-2:])
    longer = np.cumsum(tails[:0:-1])  # leaves whose tail has at least so many levels
    occupancy = np.zeros(int(nodes.sum()), np.uint8)
    several = np.zeros((int(children.sum()) + 7) // 8, np.uint8)
    multiplicities, lengths = np.zeros(packed, np.uint64), np.zeros(singles, np.uint8)
    planes = np.zeros(3 * int(((longer + np.uint64(7)) // np.uint64(8)).sum()), np.uint8)
    c["potr_octree_streams"](
        *given,
        *(address(each, np.uint8, each.size, True) for each in (occupancy, several)),
        address(multiplicities, np.uint64, packed, True),
        *(address(each, np.uint8, each.size, True) for each in (lengths, planes)),
    )
    return occupancy, several, multiplicities, lengths, planes


def decoded(
    c: CFunctions, words: U64, depth: int, order: I64, wanted: I8, sides: F64, origin: F64, run: Run = map
) -> F32:
    """(n, 3) centres as a decoder of the streams finds them, in the order of the leaves.

    Args:
        words, depth, order, wanted: as of :func:`streams`.
        sides: (depth + 1,) edges of the cells of each level.
        origin: (3,).
        run: shares the work out.
    """
    number, n = words.shape
    _check(words, depth, order, wanted)
    means = np.empty((n, 3), np.float32)
    given = (
        address(words, np.uint64, number * n), n, number, depth,
        address(order, np.int64, n), address(wanted, np.int8, n),
        address(sides, np.float64, depth + 1), address(origin, np.float64, 3),
    )  # fmt: skip
    result = address(means, np.float32, 3 * n, True)

    def find(first: int) -> None:
        c["potr_octree_decoded"](*given, first, min(first + _DECODED, n), result)

    for _ in run(find, range(0, n, _DECODED)):
        pass
    return means


def _check(words: U64, depth: int, order: I64, wanted: I8) -> None:
    number, n = words.shape
    if not 0 <= depth <= number * _LEVELS_A_WORD or depth > _COUNTED - 2:
        raise TypeError("the native path was given words of too few levels")
    if len(order) != n or len(wanted) != n:
        raise TypeError("the native path was given splats or levels that are not there")
    if n and (int(order.min()) < 0 or int(order.max()) >= n or int(wanted.min()) < 0 or int(wanted.max()) > depth):
        raise TypeError("the native path was given splats or levels that are not there")
