"""The k-d tree of streamed SOG: space cut into leaves with the splats of all levels of detail (:func:`lod_tree`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import in_background, thread_pool
from potr_cl.model.order import least
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.spherical_harmonics import rotation_matrices

#: Splats whose ellipsoids are bounded at a time.
_BLOCK = 1 << 16
#: A node of more splats has a thread for each half.
_MANY = 1 << 19
#: Digits of a bound.
_DIGITS = 7


@dataclass(frozen=True)
class Limits:
    """When a node is split: if it has too many splats; or if it is too wide, and has not too few.

    Attributes:
        splats: of all levels together, that a leaf has at most.
        extent: that a leaf has at most on any axis, world units.
        fewest: a node of no more splats is not split for its extent.
    """

    splats: int
    extent: float
    fewest: int


@dataclass(frozen=True)
class Node:
    """A node of the tree.

    Attributes:
        low, high: (3,) corners of a box around the ellipsoids of its splats, at one standard deviation.
        children: two, or none of a leaf.
        rows: of a leaf, for each level the numbers of its splats, ascending.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    children: tuple[Node, ...] = ()
    rows: tuple[NDArray[np.int64], ...] = ()

    def leaves(self) -> Iterator[Node]:
        """All leaves, the first child's first."""
        if not self.children:
            yield self
        for child in self.children:
            yield from child.leaves()

    def document(self, of_leaf: Callable[[Node], dict[str, Any]]) -> dict[str, Any]:
        """The tree for JSON; leaves have besides what is said of them, in the order of :meth:`leaves`."""
        bound = {"min": _rounded(self.low, -1), "max": _rounded(self.high, 1)}
        if not self.children:
            return {"bound": bound, **of_leaf(self)}
        return {"bound": bound, "children": [child.document(of_leaf) for child in self.children]}


def lod_tree(scenes: Sequence[Scene], limits: Limits, near: Sequence[NDArray[np.bool_]] | None = None) -> Node:
    """Cut space at medians of the centres of all levels, across the longest side each time.

    Args:
        scenes: of the levels, the finest first.
        limits: of the leaves.
        near: for each level, (N,) which of its splats are in the tree, one at least; None: all.
    """
    means = np.concatenate([scene.means for scene in scenes])
    extents = np.concatenate([extents_of(scene) for scene in scenes])
    ends = np.cumsum([0, *map(len, scenes)])

    def node(numbers: NDArray[np.int64]) -> Node:
        centres = means[numbers]
        sides = centres.max(axis=0).astype(np.float64) - centres.min(axis=0)
        wide = sides.max() > limits.extent and len(numbers) > limits.fewest
        if len(numbers) > 1 and (len(numbers) > limits.splats or wide):
            lower = least(centres[:, int(sides.argmax())], len(numbers) // 2)
            first = in_background(node, numbers[lower]) if len(numbers) > _MANY else None
            second = node(numbers[~lower])
            children = node(numbers[lower]) if first is None else first.result(), second
            low = np.minimum(children[0].low, children[1].low)
            return Node(low, np.maximum(children[0].high, children[1].high), children)
        cuts = np.searchsorted(numbers, ends)
        rows = tuple(numbers[a:b] - first for a, b, first in zip(cuts, cuts[1:], ends, strict=False))
        exact = centres.astype(np.float64)
        return Node((exact - extents[numbers]).min(axis=0), (exact + extents[numbers]).max(axis=0), (), rows)

    return node(np.arange(len(means)) if near is None else np.flatnonzero(np.concatenate(near)))


def extents_of(scene: Scene) -> FloatArray:
    """(N, 3) float32: how far each splat's ellipsoid at one standard deviation reaches along the world's axes."""
    found = np.empty((len(scene), 3), np.float32)

    def find(start: int) -> None:
        some = slice(start, start + _BLOCK)
        axes = rotation_matrices(scene.quaternions[some].astype(np.float64))
        reach = axes * np.exp(scene.log_scales[some].astype(np.float64))[:, None, :]
        found[some] = np.sqrt(np.square(reach).sum(axis=2))

    with thread_pool() as pool:
        list(pool.map(find, range(0, len(scene), _BLOCK)))
    return found


def _rounded(corner: NDArray[np.float64], side: int) -> list[float]:
    """A corner in as many digits as single precision has, rounded outwards."""
    found = []
    for value in corner.tolist():
        near = float(f"{value:.{_DIGITS}g}")
        if side * (near - value) < 0:
            near = float(f"{value + side * abs(value) * 10.0 ** (1 - _DIGITS):.{_DIGITS}g}")
        found.append(near)
    return found
