"""Which splats a view may show, without looking at all of them (:class:`SplatGroups`), and which none shows
(:func:`unseen_splats`). Pure NumPy.

Splats are put into groups of neighbours, with the box of their centres and how far they reach. A group is left out for
a view only if none of its splats could be drawn there: by what cl/raster/project.cl computes, rounding included, each
lies behind the near plane, or beside the picture by more than it reaches. So it makes no difference to any pixel
whether splats of such groups are there.

Unseen are the splats beside, behind or right in front of every camera, whatever hides the others. Views cannot say what
they are worth: perhaps nothing, perhaps the other half of the scene, of which somebody gave no cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.order import BITS, ascending, morton_codes
from potr_cl.model.scene import Scene, opacities_of

Indices = NDArray[np.int64]
F64 = NDArray[np.float64]

#: Splats of a group.
LARGEST = 1024
#: Groups whose boxes are found at a time.
_GROUPS = 256
#: Splats whose sizes are looked at at a time, and views; splats of which it is asked one by one whether they are seen.
_ROWS, _VIEWS, _BLOCK = 1 << 18, 4, 1 << 16
#: Splats that are so many times as large as the median of some have groups of their own: they can be seen from
#: everywhere.
_LARGE, _SAMPLED = 8.0, 100_000
#: The renderer's near plane, world units: a splat whose centre is nearer is not drawn.
NEAR = 0.2
#: A splat reaches so many of its largest standard deviations on screen, sqrt(2 ln 255) and LEVEL_SLACK of splat.clh,
#: with some room for single precision; and so many pixels through the low-pass filter, PIXEL_SLACK and the pixels'
#: centres: in groups, and of one splat, where it may be less.
REACH, _PIXELS, _PIXELS_OF_ONE = 3.5, 3.0, 2.0
#: The projection's view directions end at so many half widths of the picture.
_LIMIT = 1.3
#: Of a distance from the camera: more than single precision loses on the way to the screen.
_ROUNDING = 1e-5


def largest_scales(log_scales: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N,) the largest of each splat's three; several times as fast as a maximum along an axis."""
    found: NDArray[np.float32] = np.maximum(np.maximum(log_scales[:, 0], log_scales[:, 1]), log_scales[:, 2])
    return found


@dataclass(frozen=True)
class SplatGroups:
    """A scene's splats in groups of neighbours.

    Attributes:
        order: (N,) uint32 the splats' numbers, group by group.
        group_of: (N,) uint32 the group of each splat.
        starts: (G + 1,) where each group begins in the order, and the end.
        centres, halves: (G, 3) float64, the middle of the box of a group's centres, and half its edges, world units.
        sizes: (G,) float64 largest standard deviation of a group, world units.
    """

    order: NDArray[np.uint32]
    group_of: NDArray[np.uint32]
    starts: Indices
    centres: F64
    halves: F64
    sizes: F64

    @staticmethod
    def of(scene: Scene, group: int | None = None, run: Run = map) -> SplatGroups:
        """Group the splats of a scene, clean and with at least one.

        Args:
            scene: whose splats.
            group: so many of them are a group at most.
            run: shares the work out.
        """
        group = group or LARGEST
        numbers, logarithms, large = _in_order(scene, run)
        order, group_of = np.empty((2, len(numbers)), np.uint32)
        n, small = len(order), len(order) - large
        starts = np.concatenate([np.arange(0, small, group), np.arange(small, n, group), [n]])
        low, high = np.empty((2, len(starts) - 1, 3))
        largest = np.empty(len(starts) - 1)

        def bound(first: int) -> None:
            """The boxes of some groups."""
            some = slice(first, min(first + _GROUPS, len(starts) - 1))
            begins = starts[some] - starts[first]
            own = numbers[starts[first] : starts[some.stop]]
            order[starts[first] : starts[some.stop]] = own
            group_of[own] = np.repeat(
                np.arange(first, some.stop, dtype=np.uint32), np.diff(starts[first : some.stop + 1])
            )
            for axis, column in enumerate(np.ascontiguousarray(scene.means[own].T)):
                low[some, axis] = np.minimum.reduceat(column, begins)
                high[some, axis] = np.maximum.reduceat(column, begins)
            largest[some] = np.maximum.reduceat(logarithms[own], begins)

        for _ in run(bound, range(0, len(starts) - 1, _GROUPS)):
            pass
        # Halved each first: the sum of two large numbers may be infinite.
        return SplatGroups(
            order, group_of, starts, low / 2 + high / 2, high / 2 - low / 2, np.exp(np.minimum(largest, 100))
        )

    @property
    def counts(self) -> Indices:
        """(G,) splats of each group."""
        return np.diff(self.starts)

    def splats(self, groups: NDArray[np.bool_]) -> Indices:
        """The numbers of the splats of some groups, ascending; ``groups``: (G,)."""
        return np.flatnonzero(groups[self.group_of])

    def only(self, groups: NDArray[np.bool_]) -> tuple[Indices, SplatGroups]:
        """Some groups as those of a scene that has their splats and no others; ``groups``: (G,), at least one.

        Returns:
            The numbers of these splats, ascending, and the groups, which name them by their places there.
        """
        own = self.order[np.repeat(groups, self.counts)]
        splats = np.sort(own).astype(np.int64)
        places = np.empty(len(self.order), np.uint32)
        places[splats] = np.arange(len(splats), dtype=np.uint32)
        starts = np.concatenate([[0], np.cumsum(self.counts[groups])])
        group_of = (np.cumsum(groups) - 1).astype(np.uint32)[self.group_of[splats]]
        return splats, SplatGroups(
            places[own], group_of, starts, self.centres[groups], self.halves[groups], self.sizes[groups]
        )

    def visible_by(self, cameras: Sequence[Camera], near: float, run: Run = map) -> NDArray[np.bool_]:
        """(views, G) the groups of which views may draw a splat.

        Args:
            cameras: the views.
            near: as in the rasterizer's rules.
            run: shares the work out.
        """
        found = np.zeros((len(cameras), len(self.starts) - 1), bool)
        features, origin = self._features()

        def look(first: int) -> None:
            rows = np.concatenate([_bounds(camera, near, origin) for camera in cameras[first : first + _VIEWS]])
            # Without BLAS, whose threads would wait for each other.
            sums = np.einsum("bf,fg->bg", rows, features)
            np.all(sums.reshape(-1, 5, len(self.sizes)) >= 0, axis=1, out=found[first : first + _VIEWS])

        for _ in run(look, range(0, len(cameras), _VIEWS)):
            pass
        return found

    def visible(self, camera: Camera, near: float) -> NDArray[np.bool_]:
        """(G,) the same of one view."""
        found: NDArray[np.bool_] = self.visible_by([camera], near)[0]
        return found

    def _features(self) -> tuple[F64, F64]:
        """(9, G) what bounds of views are linear in (:func:`_bounds`), of each group; and (3,) the scene's middle."""
        origin = np.median(self.centres, axis=0)
        middle = self.centres - origin
        spans = np.linalg.norm(middle, axis=1) + np.linalg.norm(self.halves, axis=1)
        features = np.empty((9, len(self.sizes)))
        features[:3], features[3:6], features[6], features[7], features[8] = (
            middle.T,
            self.halves.T,
            self.sizes,
            spans,
            1,
        )
        return features, origin


def _in_order(scene: Scene, run: Run) -> tuple[Indices, NDArray[np.float32], int]:
    """The splats' numbers along a Morton curve, large ones last; their largest scales; and how many are large."""
    few = largest_scales(scene.log_scales[:: max(len(scene) // _SAMPLED, 1)])
    limit = np.median(few) + math.log(_LARGE)
    codes = morton_codes(scene.means, run)
    logarithms = np.empty(len(scene), np.float32)

    def flag(first: int) -> int:
        rows = slice(first, first + _ROWS)
        logarithms[rows] = largest_scales(scene.log_scales[rows])
        large = logarithms[rows] > limit
        codes[rows] |= large.astype(np.uint64) << np.uint64(3 * BITS)
        return int(np.count_nonzero(large))

    large = sum(run(flag, range(0, len(scene), _ROWS)))
    return ascending(codes, run), logarithms, large


def _bounds(camera: Camera, near: float, origin: F64) -> F64:
    """(5, 9) what makes a group visible: none of these sums is negative.

    In front of the near plane, in world units; and not beyond the left, right, upper and lower edge of the picture, in
    pixels times depth, which is above 0: a position on screen is focal · along / depth + before. By the features of a
    group: its box's middle from ``origin``, the box's half edges, its largest size, its span, that is more than how far
    it is from ``origin``, and 1.
    """
    right, down, forward = camera.rotation
    place = camera.centre - origin
    away = float(np.linalg.norm(place))
    rows = np.empty((5, 9))

    def bound(row: int, direction: F64, offset: float, size: float, slack: float) -> None:
        """How far a box reaches along a direction from the camera, and more."""
        rows[row, :3], rows[row, 3:6] = direction, np.abs(direction)
        # A group is no farther from the camera than its span and the camera from the origin are together.
        rows[row, 6], rows[row, 7] = size, slack * _ROUNDING
        rows[row, 8] = offset - direction @ place + slack * _ROUNDING * away

    bound(0, forward, -near, 0.0, 1.0)
    for row, axis, focal, before, pixels, stretch in zip(
        (1, 3), (right, down), *_along_axes(camera), stretches(camera), strict=True
    ):
        size = REACH * focal * stretch
        bound(row, focal * axis + (before + _PIXELS) * forward, 0.0, size, focal)
        bound(row + 1, -focal * axis + (pixels - before + _PIXELS) * forward, 0.0, size, focal)
    return rows


def _along_axes(camera: Camera) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    """Across and down: the focal length, where the principal point is, and the size; pixels."""
    return (camera.fx, camera.fy), (camera.cx, camera.cy), (camera.width, camera.height)


def stretches(camera: Camera) -> list[float]:
    """By how much a view stretches splats, across and down, at the most.

    A splat is projected as if it were flat where it is: beside the middle of a wide picture it becomes longer than a
    sphere's outline would, and beside the picture as long as at 1.3 times its half.
    """
    return [
        math.hypot(1, max(_LIMIT * pixels / 2, abs(before) + _PIXELS, abs(pixels - before) + _PIXELS) / focal)
        for focal, before, pixels in zip(*_along_axes(camera), strict=True)
    ]


def unseen_splats(
    scene: Scene, cameras: Sequence[Camera], groups: SplatGroups | None = None, run: Run = map
) -> NDArray[np.bool_]:
    """Which splats lie outside of every view's picture.

    Args:
        scene: clean.
        cameras: the views; without any, no splat is seen.
        groups: of the scene, where they are known: most views show nothing of a neighbourhood of a large scene.
        run: shares the work out.

    Returns:
        (N,) whether it is unseen. A splat of which any part may touch a picture is not, even if others hide it.
    """
    unseen = np.ones(len(scene), bool)
    order = views_in_turn(len(cameras))
    shown = np.zeros((0, 0), bool) if groups is None else groups.visible_by(cameras, NEAR, run)

    def look(start: int) -> None:
        """Find out which of a block of splats are seen."""
        stop = min(start + _BLOCK, len(scene))
        left = np.arange(start, stop) if groups is None else groups.order[start:stop]
        among = None if groups is None else np.searchsorted(groups.starts, np.arange(start, stop), "right") - 1
        means = scene.means[left].astype(np.float64)
        with np.errstate(over="ignore"):
            reach = REACH * np.exp(np.minimum(largest_scales(scene.log_scales[left]), 80).astype(np.float64))
        for view in order:
            if among is None:
                seen = _shows(cameras[view], means, reach)
            else:
                if not shown[view][among[0] : among[-1] + 1].any():
                    continue
                near = np.flatnonzero(shown[view][among])
                if not len(near):
                    continue
                seen = np.zeros(len(left), bool)
                seen[near] = _shows(cameras[view], means[near], reach[near])
            unseen[left[seen]] = False
            left, means, reach = left[~seen], means[~seen], reach[~seen]
            among = None if among is None else among[~seen]
            if not len(left):
                break

    for _ in run(look, range(0, len(scene), _BLOCK)):
        pass
    return unseen


def views_in_turn(count: int) -> NDArray[np.int64]:
    """The numbers of views, those far from each other first: what one does not see the next one may."""
    return np.argsort((np.arange(count) * (math.sqrt(5) - 1) / 2) % 1, kind="stable")


def bounds(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """The planes left and right of a view's picture, and above and below it, as positions at a depth of 1."""
    x, y = (
        ((-_PIXELS_OF_ONE - centre) / focal, (pixels + _PIXELS_OF_ONE - centre) / focal)
        for focal, centre, pixels in zip(*_along_axes(camera), strict=True)
    )
    return x, y


def opacity_weighted_areas(scene: Scene, run: Run = map) -> NDArray[np.float64]:
    """(N,) area of each splat's largest cross-section times its opacity, up to a common factor; for shares of a scene.

    The factor makes the largest of them 1, so that no scene's units are too large. ``run`` shares the work out.
    """
    areas = np.empty(len(scene))
    starts = range(0, len(scene), _BLOCK)

    def largest_two(start: int) -> float:
        a, b, c = scene.log_scales[start : start + _BLOCK].T.astype(np.float64)
        low, high = np.minimum(a, b), np.maximum(a, b)
        some = areas[start : start + _BLOCK]
        some[:] = np.maximum(low, np.minimum(high, c)) + np.maximum(high, c)
        return float(some.max())

    largest = max(run(largest_two, starts), default=-math.inf)

    def area(start: int) -> None:
        some = areas[start : start + _BLOCK]
        some[:] = np.exp(some - largest) * opacities_of(scene.opacity_logits[start : start + _BLOCK])

    for _ in run(area, starts):
        pass
    return areas


def _shows(camera: Camera, means: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which splats of some reach may touch a view's picture; their centres in front of the near plane."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, depth = camera.rotation @ means.T + camera.translation[:, None]
        shown = depth > NEAR
        for along, (low, high), stretch in zip((x, y), bounds(camera), stretches(camera), strict=True):
            shown &= along - low * depth > -reach * stretch
            shown &= along - high * depth < reach * stretch
    return np.asarray(shown)
