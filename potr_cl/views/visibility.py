"""What views may draw of a scene (:class:`Visibility`), and whether it pays to ask. Pure NumPy.

Splats lie in groups, and a view may draw a group if it reaches into the picture: too many rather than too few. One
question has one threshold here, whoever asks it: how large must a scene be (:data:`LEAST_SPLATS`), and how little of it
must a view see (:data:`MOST_SEEN`), for a view to be looked at with what it may draw rather than with the whole scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model import splat_groups
from potr_cl.model.camera import Camera
from potr_cl.model.order import morton_order
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import Indices, SplatGroups
from potr_cl.raster.rules import INRIA


@dataclass(frozen=True, eq=False)
class ViewGroup:
    """Views, and the splats that they are looked at with: all, those of some cells, or those of some bits.

    Attributes:
        numbers: of the views among all.
        cells: (G,) the groups of the scene's splats (:class:`potr_cl.model.splat_groups.SplatGroups`); None: not so.
        among, bits: a bit for each of the splats of these numbers, ascending, packed; no bits: all of them. None: not
            so.
        nbytes: what the views are known to take if they stay on the device.
        most: how many of them are prepared together at most, as a plan has it; 0: as many as one launch does.
    """

    numbers: tuple[int, ...]
    count: int
    cells: NDArray[np.bool_] | None = None
    among: Indices | None = field(default=None, repr=False)
    bits: NDArray[np.uint8] | None = field(default=None, repr=False)
    nbytes: int = 0
    most: int = 0

    @property
    def splats(self) -> Indices:
        """(count,) their numbers in the scene, ascending."""
        assert self.among is not None, "the splats are known on the device alone"
        return self.among if self.bits is None else self.among[self.mask]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Which of :attr:`among` they are."""
        assert self.among is not None
        if self.bits is None:
            return np.ones(len(self.among), bool)
        return np.unpackbits(self.bits, count=len(self.among)).view(bool)


def work(groups: Sequence[ViewGroup]) -> int:
    """Splats that all views project, each those of its group."""
    return sum(len(group.numbers) * group.count for group in groups)


#: A cluster's views see so many times as many splats together as three quarters of the views each at most, or this part
#: of the scene. The others, which see more alone, are one cluster.
_SPREAD, _QUANTILE, _LEAST_PART = 1.25, 0.75, 1 / 16
#: A device projects a smaller scene whole, in less time than the host takes to find its groups and what views may draw.
LEAST_SPLATS = 1 << 21
#: Where a view sees more than this part of the scene, its own splats, copied or named by their numbers, take about as
#: much memory and time as all.
MOST_SEEN = 1 / 2
#: Few of the splats, one in so many, and so many views tell about which part of a scene views see.
_SAMPLED, _VIEWS = 64, 48


@dataclass(frozen=True)
class Visibility:
    """What views may draw of a scene.

    Attributes:
        groups: the scene's splats in groups.
        seen: (views, G) the groups of which a view may draw a splat.
    """

    groups: SplatGroups
    seen: NDArray[np.bool_]

    @staticmethod
    def of(
        scene: Scene,
        cameras: Sequence[Camera],
        near: float = INRIA.near,
        groups: SplatGroups | None = None,
        run: Run = map,
    ) -> Visibility:
        """What some views may draw.

        Args:
            scene: clean.
            cameras: the views, at least one.
            groups: of the scene, where they are known.
        """
        groups = groups or SplatGroups.of(scene, run=run)
        return Visibility(groups, groups.visible_by(cameras, near, run))

    def lasting(self) -> Visibility:
        """The same without the groups' order, four bytes a splat, which nobody asks for but who shares groups out."""
        return replace(self, groups=replace(self.groups, order=self.groups.order[:0].copy()))

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

    def dealt(self, speeds: Sequence[float]) -> list[list[int]]:
        """The views for each of several workers, ascending, so that each sees little of the scene.

        One worker after the other takes the view that adds least to what it sees, until it has its part of the work.

        Args:
            speeds: of the workers, above 0; their parts of the work are in proportion.
        """
        counts, totals = self.groups.counts, self.totals
        wanted = np.cumsum(speeds) / np.sum(speeds) * float((totals + 1).sum())
        left = np.ones(len(totals), bool)
        dealt: list[list[int]] = []
        done = 0
        for place, end in enumerate(wanted):
            own: list[int] = []
            together = np.zeros(len(counts), bool)
            more = totals.copy()  # what each view sees that is not there yet
            while left.any() and (done < end or place == len(wanted) - 1):
                # The narrowest first; then those that add little, beside what they see at all.
                rank = more / (totals + 1) if own else totals
                best = int(np.argmin(np.where(left, rank, np.inf)))
                new = np.flatnonzero(self.seen[best] & ~together)
                more -= self.seen[:, new] @ counts[new]
                together[new] = True
                own.append(best)
                left[best] = False
                done += int(totals[best]) + 1
            dealt.append(sorted(own))
        return dealt

    def of_views(self, numbers: Sequence[int]) -> tuple[Indices, Visibility]:
        """What some views may draw, as a scene of its own.

        Returns:
            The numbers of the splats that these views may draw, ascending, and what all views may draw of these.
        """
        own = self._seen_by(numbers)
        splats, groups = self.groups.only(own)
        return splats, Visibility(groups, self.seen[:, own])

    def clusters(self, numbers: Sequence[int] | None = None) -> list[ViewGroup]:
        """All views, dealt out to parts that see much of the same, so that the splats of all parts are few.

        Args:
            numbers: of the views that are meant; None: all.
        """
        groups, seen = self.groups, self.seen
        counts = groups.counts.astype(np.float64)
        totals = seen @ counts
        most = max(_SPREAD * float(np.quantile(totals, _QUANTILE)), _LEAST_PART * len(groups.group_of))
        order = self.order()
        if numbers is not None:
            order = order[np.isin(order, list(numbers))]
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
        return [self._cluster(sorted(own)) for own in dealt if own]

    def _cluster(self, numbers: Sequence[int]) -> ViewGroup:
        splats = self.groups.splats(self._seen_by(numbers))
        return ViewGroup(tuple(numbers), len(splats), among=splats)

    def _seen_by(self, numbers: Sequence[int]) -> NDArray[np.bool_]:
        """(G,) the groups that some views see together, at least one: a scene has splats."""
        seen: NDArray[np.bool_] = np.logical_or.reduce(self.seen[list(numbers)])
        if not seen.any():
            seen[0] = True
        return seen


def seen_part(scene: Scene, cameras: Sequence[Camera], near: float = INRIA.near) -> float:
    """Which part of a scene a view may draw on the average, told from few of both; 1 for a small scene.

    The boxes of few splats are smaller, so views seem to see a little less than they do.

    Args:
        scene: clean, at least one splat.
    """
    if len(scene) < LEAST_SPLATS or not cameras:
        return 1.0
    some = [cameras[number] for number in range(0, len(cameras), -(-len(cameras) // _VIEWS))]
    few = scene.uncoloured().subset(np.arange(0, len(scene), _SAMPLED))
    groups = SplatGroups.of(few, max(splat_groups.LARGEST // _SAMPLED, 1))
    return float((groups.visible_by(some, near) @ groups.counts).mean() / len(few))


def groups_of_large(scene: Scene, run: Run = map) -> SplatGroups | None:
    """The groups of a scene's splats, if it is so large that they are worth their time; ``run`` shares the work out."""
    return SplatGroups.of(scene, run=run) if len(scene) >= LEAST_SPLATS else None


def visibility_of_large(
    scene: Scene, cameras: Sequence[Camera], groups: SplatGroups | None = None, run: Run = map
) -> Visibility | None:
    """What the views may draw; None where they had better share one scene.

    Args:
        scene: clean.
        groups: of the scene, where they are known.
    """
    if len(scene) < LEAST_SPLATS or not cameras:
        return None
    visibility = Visibility.of(scene, cameras, INRIA.near, groups, run)
    return visibility if visibility.totals.sum() <= MOST_SEEN * len(scene) * len(cameras) else None
