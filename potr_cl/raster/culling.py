"""Views in parts that see much of the same of a scene: :func:`parts_of_views`. Pure NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.morton import morton_order
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import Indices, SplatGroups

#: A part's views see so many times as many splats together as three quarters of the views each at most, or this part of
#: the scene. The others, which see more alone, are one part.
_SPREAD, _QUANTILE, _LEAST_PART = 1.25, 0.75, 1 / 16


@dataclass(frozen=True)
class ViewPart:
    """Some views and what they may draw.

    Attributes:
        numbers: of the views, ascending.
        splats: their numbers in the scene, ascending.
    """

    numbers: list[int]
    splats: Indices


@dataclass(frozen=True)
class Sights:
    """What views may draw of a scene.

    Attributes:
        groups: the scene's splats in groups.
        seen: (views, G) the groups of which a view may draw a splat.
    """

    groups: SplatGroups
    seen: NDArray[np.bool_]

    @staticmethod
    def of(
        scene: Scene, cameras: Sequence[Camera], near: float, groups: SplatGroups | None = None, run: Run = map
    ) -> Sights:
        """What some views may draw.

        Args:
            scene: clean.
            cameras: the views, at least one.
            near: as in the rasterizer's rules.
            groups: of the scene, where they are known.
            run: shares the work out.
        """
        groups = groups or SplatGroups.of(scene, run=run)
        return Sights(groups, groups.visible_by(cameras, near, run))

    @property
    def totals(self) -> NDArray[np.int64]:
        """(views,) the splats that each view may draw."""
        return np.array([int(self.groups.counts[row].sum()) for row in self.seen])

    def order(self) -> NDArray[np.int64]:
        """(views,) the views along a curve through the middles of what they see: neighbours see much of the same."""
        counts = self.groups.counts.astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            middles = np.nan_to_num((self.seen * counts) @ self.groups.centres / (self.seen @ counts)[:, None])
        return morton_order(middles.astype(np.float32))

    def parts(self) -> list[ViewPart]:
        """All views, dealt out to parts that see much of the same, so that the splats of all parts are few."""
        groups, seen = self.groups, self.seen
        counts = groups.counts.astype(np.float64)
        totals = seen @ counts
        most = max(_SPREAD * float(np.quantile(totals, _QUANTILE)), _LEAST_PART * len(groups.order))
        order = self.order()
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
            ViewPart(sorted(numbers), groups.splats(np.logical_or.reduce(seen[numbers])))
            for numbers in dealt
            if numbers
        ]


def parts_of_views(scene: Scene, cameras: Sequence[Camera], near: float) -> list[ViewPart]:
    """The :meth:`Sights.parts` of some views of a scene, with :meth:`Sights.of`'s arguments."""
    return Sights.of(scene, cameras, near).parts()


def work(parts: Sequence[ViewPart]) -> int:
    """Splats that all views project, each those of its part."""
    return sum(len(part.numbers) * len(part.splats) for part in parts)
