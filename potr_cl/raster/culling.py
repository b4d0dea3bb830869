"""Which splats a view may draw, without projecting all of them: :class:`SplatGroups`. Pure NumPy.

Splats are put into groups of neighbours, with the box of their centres and how far they reach. A group is left out for
a view only if none of its splats could be drawn there: by what cl/raster/project.cl computes, rounding included, each
lies behind the near plane, or beside the picture by more than it reaches. So it makes no difference to any pixel
whether splats of such groups are on the device.

:func:`parts_of_views` deals views out to parts that see much of the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.morton import morton_order
from potr_cl.model.scene import Scene

Indices = NDArray[np.int64]
F64 = NDArray[np.float64]

#: Splats of a group.
_GROUP = 1024
#: Splats that are so many times as large as the median have groups of their own: they can be seen from everywhere.
_LARGE = 8.0
#: A splat reaches so many of its largest standard deviations on screen, sqrt(2 ln 255) and LEVEL_SLACK of splat.clh,
#: with some room for single precision; and so many pixels through the low-pass filter, PIXEL_SLACK and the pixels'
#: centres.
_REACH, _PIXELS = 3.4, 3.0
#: The projection's view directions end at so many half widths of the picture.
_LIMIT = 1.3
#: Of a distance from the camera: more than single precision loses on the way to the screen.
_ROUNDING = 1e-5
#: A part's views see so many times as many splats together as three quarters of the views each at most, or this part of
#: the scene. The others, which see more alone, are one part.
_SPREAD, _QUANTILE, _LEAST_PART = 1.25, 0.75, 1 / 16


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
    def of(scene: Scene, group: int | None = None) -> SplatGroups:
        """Group the splats of a scene, clean and with at least one; ``group`` of them are a group at most."""
        group = group or _GROUP
        logarithms = scene.log_scales.max(axis=1)
        large = logarithms > np.median(logarithms) + math.log(_LARGE)
        along = morton_order(scene.means)
        order = np.concatenate([along[~large[along]], along[large[along]]])
        n, small = len(order), len(order) - int(np.count_nonzero(large))
        starts = np.concatenate([np.arange(0, small, group), np.arange(small, n, group), [n]])
        low, high = np.empty((2, len(starts) - 1, 3))
        for axis in range(3):
            column = scene.means[order, axis].astype(np.float64)
            low[:, axis] = np.minimum.reduceat(column, starts[:-1])
            high[:, axis] = np.maximum.reduceat(column, starts[:-1])
        largest = np.maximum.reduceat(logarithms[order], starts[:-1]).astype(np.float64)
        # Halved each first: the sum of two large numbers may be infinite.
        return SplatGroups(order, starts, low / 2 + high / 2, high / 2 - low / 2, np.exp(np.minimum(largest, 100)))

    @property
    def counts(self) -> Indices:
        """(G,) splats of each group."""
        return np.diff(self.starts)

    def splats(self, groups: NDArray[np.bool_]) -> Indices:
        """The numbers of the splats of some groups, ascending; ``groups``: (G,)."""
        return np.sort(self.order[np.repeat(groups, self.counts)])

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
            reach = _REACH * focal * math.hypot(1, _LIMIT * pixels / (2 * focal)) * self.sizes + focal * slack
            shown &= furthest(focal * axis + (before + _PIXELS) * forward) + reach >= 0
            shown &= furthest(-focal * axis + (pixels - before + _PIXELS) * forward) + reach >= 0
        return shown


@dataclass(frozen=True)
class ViewPart:
    """Some views and what they may draw.

    Attributes:
        numbers: of the views, ascending.
        splats: their numbers in the scene, ascending.
    """

    numbers: list[int]
    splats: Indices


def parts_of_views(scene: Scene, cameras: Sequence[Camera], near: float) -> list[ViewPart]:
    """Deal all views out to parts that see much of the same, so that the splats of all parts together are few.

    Args:
        scene: clean.
        cameras: the views.
        near: as in the rasterizer's rules.
    """
    groups = SplatGroups.of(scene)
    counts = groups.counts.astype(np.float64)
    seen = np.stack([groups.visible(camera, near) for camera in cameras])
    totals = seen @ counts
    most = max(_SPREAD * float(np.quantile(totals, _QUANTILE)), _LEAST_PART * len(scene))
    # Along a curve through the middles of what they see, neighbours see much of the same.
    with np.errstate(invalid="ignore", divide="ignore"):
        middles = np.nan_to_num((seen * counts) @ groups.centres / totals[:, None])
    order = morton_order(middles.astype(np.float32))
    dealt: list[list[int]] = []
    together = np.zeros(len(counts), bool)
    for number in order[totals[order] <= most].tolist():
        more = together | seen[number]
        if dealt and more @ counts <= most:
            dealt[-1].append(number)
            together = more
        else:
            dealt.append([number])
            together = seen[number]
    dealt.append(order[totals[order] > most].tolist())
    return [
        ViewPart(sorted(numbers), groups.splats(np.logical_or.reduce(seen[numbers]))) for numbers in dealt if numbers
    ]


def work(parts: Sequence[ViewPart]) -> int:
    """Splats that all views project, each those of its part."""
    return sum(len(part.numbers) * len(part.splats) for part in parts)
