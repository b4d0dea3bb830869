"""Which splats a view may show, without looking at all of them: :class:`SplatGroups`. Pure NumPy.

Splats are put into groups of neighbours, with the box of their centres and how far they reach. A group is left out for
a view only if none of its splats could be drawn there: by what cl/raster/project.cl computes, rounding included, each
lies behind the near plane, or beside the picture by more than it reaches. So it makes no difference to any pixel
whether splats of such groups are there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.morton import morton_order
from potr_cl.model.scene import Scene

Indices = NDArray[np.int64]
F64 = NDArray[np.float64]

#: Splats of a group.
LARGEST = 1024
#: Groups whose boxes are found at a time.
_GROUPS = 256
#: Splats that are so many times as large as the median have groups of their own: they can be seen from everywhere.
_LARGE = 8.0
#: A splat reaches so many of its largest standard deviations on screen, sqrt(2 ln 255) and LEVEL_SLACK of splat.clh,
#: with some room for single precision; and so many pixels through the low-pass filter, PIXEL_SLACK and the pixels'
#: centres. No less than in unseen.py.
_REACH, _PIXELS = 3.5, 3.0
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
        order: (N,) the splats' numbers, group by group.
        starts: (G + 1,) where each group begins in the order, and the end.
        centres, halves: (G, 3) float64, the middle of the box of a group's centres, and half its edges, world units.
        sizes: (G,) float64 largest standard deviation of a group, world units.
    """

    order: Indices
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
        logarithms = largest_scales(scene.log_scales)
        large = logarithms > np.median(logarithms) + math.log(_LARGE)
        along = morton_order(scene.means, run)
        order = np.concatenate([along[~large[along]], along[large[along]]])
        n, small = len(order), len(order) - int(np.count_nonzero(large))
        starts = np.concatenate([np.arange(0, small, group), np.arange(small, n, group), [n]])
        low, high = np.empty((2, len(starts) - 1, 3))
        largest = np.empty(len(starts) - 1)

        def bound(first: int) -> None:
            """The boxes of some groups."""
            some = slice(first, min(first + _GROUPS, len(starts) - 1))
            begins = starts[some]
            own = order[begins[0] : starts[some.stop]]
            for axis in range(3):
                column = scene.means[own, axis].astype(np.float64)
                low[some, axis] = np.minimum.reduceat(column, begins - begins[0])
                high[some, axis] = np.maximum.reduceat(column, begins - begins[0])
            largest[some] = np.maximum.reduceat(logarithms[own], begins - begins[0])

        for _ in run(bound, range(0, len(starts) - 1, _GROUPS)):
            pass
        # Halved each first: the sum of two large numbers may be infinite.
        return SplatGroups(order, starts, low / 2 + high / 2, high / 2 - low / 2, np.exp(np.minimum(largest, 100)))

    @property
    def counts(self) -> Indices:
        """(G,) splats of each group."""
        return np.diff(self.starts)

    @property
    def group_of(self) -> NDArray[np.uint32]:
        """(N,) the group of each splat."""
        found = np.empty(len(self.order), np.uint32)
        found[self.order] = np.repeat(np.arange(len(self.starts) - 1, dtype=np.uint32), self.counts)
        return found

    def splats(self, groups: NDArray[np.bool_]) -> Indices:
        """The numbers of the splats of some groups, ascending; ``groups``: (G,)."""
        return np.sort(self.order[np.repeat(groups, self.counts)])

    def only(self, groups: NDArray[np.bool_]) -> tuple[Indices, SplatGroups]:
        """Some groups as those of a scene that has their splats and no others; ``groups``: (G,), at least one.

        Returns:
            The numbers of these splats, ascending, and the groups, which name them by their places there.
        """
        own = self.order[np.repeat(groups, self.counts)]
        splats = np.sort(own)
        places = np.empty(len(self.order), np.int64)
        places[splats] = np.arange(len(splats))
        starts = np.concatenate([[0], np.cumsum(self.counts[groups])])
        return splats, SplatGroups(places[own], starts, self.centres[groups], self.halves[groups], self.sizes[groups])

    def visible_by(self, cameras: Sequence[Camera], near: float, run: Run = map) -> NDArray[np.bool_]:
        """(views, G) :meth:`visible` of some views; ``run`` shares the work out."""
        found = np.zeros((len(cameras), len(self.starts) - 1), bool)

        def look(view: int) -> None:
            found[view] = self.visible(cameras[view], near)

        for _ in run(look, range(len(cameras))):
            pass
        return found

    def visible(self, camera: Camera, near: float) -> NDArray[np.bool_]:
        """(G,) the groups of which a view may draw a splat; ``near`` as in the rasterizer's rules."""
        right, down, forward = camera.rotation
        middle = self.centres - camera.centre
        distance = np.linalg.norm(middle, axis=1) + np.linalg.norm(self.halves, axis=1)
        slack = _ROUNDING * distance

        def furthest(direction: F64) -> F64:
            """Of each group's box, along a direction from the camera."""
            found: F64 = middle @ direction + self.halves @ np.abs(direction)
            return found

        shown: NDArray[np.bool_] = furthest(forward) + slack > near
        for axis, focal, before, pixels in (
            (right, camera.fx, camera.cx, camera.width),
            (down, camera.fy, camera.cy, camera.height),
        ):
            # All in pixels times depth, which is above 0: a position on screen is focal · along / depth + before.
            steepest = max(_LIMIT * pixels / 2, abs(before) + _PIXELS, abs(pixels - before) + _PIXELS) / focal
            reach = _REACH * focal * math.hypot(1, steepest) * self.sizes + focal * slack
            shown &= furthest(focal * axis + (before + _PIXELS) * forward) + reach >= 0
            shown &= furthest(-focal * axis + (pixels - before + _PIXELS) * forward) + reach >= 0
        return shown
