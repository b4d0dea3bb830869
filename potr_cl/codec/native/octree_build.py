"""Octrees of centres, by C: :class:`OctreeBuilding` (octree_build.c). C trusts the sizes that are made here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.arrays import address
from potr_cl.host.threads import Run
from potr_cl.model.order import are_many, over_ranges

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]

_LEVELS_A_WORD = 21
#: Centres whose words a thread finds at a time.
_AT_A_TIME = 1 << 17
#: The same of decoded ones.
_DECODED = 1 << 15
_LEVELS = 54  # of counts


class OctreeBuilding:
    """The same bits as NumPy gives. All may be called from several threads at a time, and leave the interpreter free.

    Args:
        functions: of the library, by name.
    """

    def __init__(self, functions: Mapping[str, Any]) -> None:
        self._c = functions

    def bounds(self, means: F32, tolerance: F64) -> tuple[F64, F64, F64, float]:
        """The least and the largest coordinates of (n, 3) centres, (3,) each; (n,) limits, and the least of them.

        Args:
            means: (n, 3). tolerance: (n,) or (1,); limits are these, but never finer than float32 holds a coordinate.
        """
        n = len(means)
        limit, found = np.empty(n), np.empty(7)
        step = 0 if len(tolerance) == 1 else 1
        self._c["potr_octree_bounds"](
            address(means, np.float32, 3 * n),
            n,
            address(tolerance, np.float64, n if step else 1),
            step,
            address(limit, np.float64, n, True),
            address(found, np.float64, 7, True),
        )
        return found[:3], found[3:6], limit, float(found[6])

    def words(self, means: F32, low: F64, ratio: float, depth: int, run: Run = map) -> U64:
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
            self._c["potr_octree_words"](
                points + 12 * first, some, corner, ratio, 2.0**depth, depth, number, n, result + 8 * first
            )

        for _ in run(find, range(0, n, _AT_A_TIME)):
            pass
        return words

    def wanted(self, limit: F64, half_diagonal: float, depth: int) -> I8:
        """(n,) levels of leaves for (n,) limits > 0; -1 where they depend on how a logarithm is rounded."""
        levels = np.empty(len(limit), np.int8)
        self._c["potr_octree_wanted"](
            address(limit, np.float64, len(limit)),
            len(limit),
            half_diagonal,
            depth,
            address(levels, np.int8, len(limit), True),
        )
        return levels

    def order(self, words: U64, run: Run = map) -> tuple[I64, U64]:
        """(n,) the order of (words, n) Morton words, equal ones as they stand; and the words in that order.

        ``run`` shares the work on many out.
        """
        if not are_many(words.shape[1]):
            return self._order(words)
        ordered = np.empty_like(words)

        def finish(members: I64, place: int) -> None:
            order, own = self._order(np.ascontiguousarray(words[:, members]))
            members[:] = members[order]
            ordered[:, place : place + len(members)] = own

        return over_ranges(words[0], finish, run), ordered

    def _order(self, words: U64) -> tuple[I64, U64]:
        n = words.shape[1]
        scratch = np.empty(int(self._c["potr_octree_sorting"]()), np.uint8)
        order, other_order, other_keys = np.arange(n), np.empty(n, np.int64), np.empty(n, np.uint64)
        for word in words[::-1]:
            keys = word[order]
            if self._c["potr_octree_sort"](
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

    def streams(self, words: U64, depth: int, order: I64, wanted: I8) -> tuple[U8, U8, U64, U8, U8]:
        """Occupancy, several-flags, multiplicities, levels of leaves, and tails.

        Args:
            words: (words, n) in the order of the leaves.
            depth: 0 to 52, which the words reach.
            order: (n,) number of each splat. wanted: (n,) levels by that number, 0 to ``depth``.
        """
        number, n = words.shape
        _check(words, depth, order, wanted)
        sizes = np.empty(3 * _LEVELS + 2, np.uint64)
        if self._c["potr_octree_sizes"]() != sizes.nbytes:
            raise TypeError("the native path counts in another way")
        given = (
            address(words, np.uint64, number * n), n, number, depth,
            address(order, np.int64, n), address(wanted, np.int8, n), address(sizes, np.uint64, sizes.size, True),
        )  # fmt: skip
        self._c["potr_octree_survey"](*given)
        nodes, children, tails = sizes[:-2].reshape(3, _LEVELS)
        singles, packed = (int(size) for size in sizes[-2:])
        longer = np.cumsum(tails[:0:-1])  # leaves whose tail has at least so many levels
        occupancy = np.zeros(int(nodes.sum()), np.uint8)
        several = np.zeros((int(children.sum()) + 7) // 8, np.uint8)
        multiplicities, lengths = np.zeros(packed, np.uint64), np.zeros(singles, np.uint8)
        planes = np.zeros(3 * int(((longer + np.uint64(7)) // np.uint64(8)).sum()), np.uint8)
        self._c["potr_octree_streams"](
            *given,
            *(address(each, np.uint8, each.size, True) for each in (occupancy, several)),
            address(multiplicities, np.uint64, packed, True),
            *(address(each, np.uint8, each.size, True) for each in (lengths, planes)),
        )
        return occupancy, several, multiplicities, lengths, planes

    def decoded(self, words: U64, depth: int, order: I64, wanted: I8, sides: F64, origin: F64, run: Run = map) -> F32:
        """(n, 3) centres as a decoder of the streams finds them, in the order of the leaves.

        Args:
            words, depth, order, wanted: as of :meth:`streams`.
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
            self._c["potr_octree_decoded"](*given, first, min(first + _DECODED, n), result)

        for _ in run(find, range(0, n, _DECODED)):
            pass
        return means


def _check(words: U64, depth: int, order: I64, wanted: I8) -> None:
    number, n = words.shape
    if not 0 <= depth <= number * _LEVELS_A_WORD or depth > _LEVELS - 2:
        raise TypeError("the native path was given words of too few levels")
    if len(order) != n or len(wanted) != n:
        raise TypeError("the native path was given splats or levels that are not there")
    if n and (int(order.min()) < 0 or int(order.max()) >= n or int(wanted.min()) < 0 or int(wanted.max()) > depth):
        raise TypeError("the native path was given splats or levels that are not there")
