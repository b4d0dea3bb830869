"""Which views are looked at with which splats, and what becomes of those that do not fit: :class:`ViewPlan`.

A plan is made once a stage. Five ways to group views make all there are; to add one, write a function here:

- :func:`whole`: all views with all splats. For scenes that are small, or of which views see much.
- :func:`by_view`: each view with the splats that it may draw, by their numbers, where a GPU has the whole scene.
- :func:`by_cluster`: views that see much of the same with a copy of that, on a GPU that has no room for the scene.
- :func:`in_launches`: launch by launch, with all splats or those that each view is known to need, one budget for all.
- :func:`as_drawn`: each view with a copy of the splats that it does draw, on a CPU, whose memory is the host's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.views.budget import (
    COPIED_SPLAT,
    GEOMETRY,
    Budget,
    CacheBudget,
    ClusterBudget,
    KnownBudget,
    NamedBudget,
    ViewCache,
    drawn_bytes,
    target_bytes,
)
from potr_cl.views.subsets import CopiedSplats
from potr_cl.views.visibility import ViewGroup, Visibility

#: Streamed views may lose so many times as much as a tile may, on the average, before they are looked at again: some
#: tiles lose far more than the average. With ten million splats and 300 views, all of them streamed, 2 and 0.5 cost 1.4
#: and 0.2 dB against resident views; 0.5 took 2.7 times as long as 2.
_PATIENCE = 0.5
#: Bytes that streamed views with named splats take: of each one's splats, and of those of all together.
_OWN, _TOGETHER = 70, 56
#: How many they are at most, and how many times as many splats as one of them (on the average) they see together at
#: most.
_MOST, _SPREAD = 16, 4.0
#: Splats that are projected at a time to find which of them views draw.
_PIECE = 1 << 20


@dataclass(frozen=True)
class ViewPlan:
    """Groups of views, in the order in which they are brought in.

    Attributes:
        groups: they. idle: numbers of views that draw nothing.
        budget: says which of them stay.
        together: makes groups that are streamed of those that do not stay.
        singly: whether each group is one view, which stays as it is or not at all. Others are prepared as many as one
            launch does, and give up their geometry before they are streamed.
        copies_rest: whether copies of splats are on the device only while they are projected.
    """

    groups: Sequence[ViewGroup]
    budget: Budget
    idle: Sequence[int] = ()
    together: Callable[[Sequence[ViewGroup]], list[ViewGroup]] = list
    singly: bool = False
    copies_rest: bool = False

    @property
    def patience(self) -> float:
        """How much streamed views may have lost before they are looked at again, in tolerances of a tile; 0: they are
        looked at each time."""
        return _PATIENCE if self.singly else 0.0

    @property
    def numbers(self) -> list[int]:
        """The views, ascending."""
        return sorted([*self.idle, *(number for group in self.groups for number in group.numbers)])


def none() -> ViewPlan:
    """No view: others look at all."""
    return ViewPlan((), KnownBudget(0))


def whole(numbers: Sequence[int], splats: int, memory: int) -> ViewPlan:
    """All views with all splats."""
    group = ViewGroup(tuple(numbers), splats)
    return ViewPlan([group], ClusterBudget(memory, [group]))


def in_launches(
    numbers: Sequence[int], strides: Mapping[int, int], cache: ViewCache, most_views: int, splat: int, picture: int
) -> ViewPlan:
    """Views that a launch does together, each with room for as many splats as the first of them.

    Args:
        numbers: of views, which have fewer and fewer splats.
        strides: room that each view's splats need.
        cache: keeps them.
        most_views: how many views a launch can do.
        splat: bytes that a splat of a view takes in buffers of a launch's own.
        picture: bytes of a view's picture, at most.
    """
    groups: list[ViewGroup] = []
    left = tuple(numbers)
    while left:
        stride = strides[left[0]]
        most = cache.most_views(most_views, (GEOMETRY + splat) * stride + picture)
        groups.append(ViewGroup(left[:most], stride, most=most))
        left = left[most:]
    cache.largest = max((len(group.numbers) * group.count for group in groups), default=0)
    return ViewPlan(groups, CacheBudget(cache))


def by_view(
    visibility: Visibility, cameras: Sequence[Camera], numbers: Sequence[int], memory: int, totals: int
) -> ViewPlan:
    """Each view with the splats that it may draw, named by their numbers.

    Args:
        visibility: of all views.
        numbers: of those that are meant.
        memory: bytes of the device's that they may take.
        totals: bytes of what is summed up beside that.
    """
    counts, meant = visibility.totals, set(numbers)
    order = [number for number in visibility.order().tolist() if number in meant]
    groups = [ViewGroup((number,), int(counts[number]), visibility.seen[number]) for number in order if counts[number]]
    budget = NamedBudget(memory, groups, cameras, totals)

    def together(others: Sequence[ViewGroup]) -> list[ViewGroup]:
        return neighbours(others, visibility.groups.counts, cameras, budget.streamed)

    idle = [number for number in order if not counts[number]]
    return ViewPlan(groups, budget, idle, together, singly=True)


def neighbours(
    others: Sequence[ViewGroup], counts: NDArray[np.int64], cameras: Sequence[Camera], passing: int
) -> list[ViewGroup]:
    """Views in groups of neighbours, each of which takes no more bytes than may pass, if that can be.

    Args:
        others: single views, in an order in which neighbours see much of the same.
        counts: (G,) splats of each cell.
        passing: bytes that a group may take while it is there.
    """
    found: list[ViewGroup] = []
    own = 0
    for view in others:
        assert view.cells is not None
        if found and found[-1].cells is not None:
            numbers, cells = found[-1].numbers + view.numbers, found[-1].cells | view.cells
            count = int(counts[cells].sum())
            seen, theirs = len(numbers) * count, own + view.count
            nbytes = _TOGETHER * seen + _OWN * theirs + sum(target_bytes(cameras[number]) for number in numbers)
            if len(numbers) <= _MOST and nbytes <= passing and seen <= _SPREAD * theirs:
                found[-1], own = ViewGroup(numbers, count, cells), theirs
                continue
        found.append(view)
        own = view.count
    return found


def by_cluster(clusters: Sequence[ViewGroup], memory: int, splat: int) -> ViewPlan:
    """Views that see much of the same with a copy of that.

    Args:
        clusters: of the views (:meth:`Visibility.clusters`).
        memory: bytes of the device's that they may take, copies included.
        splat: bytes of a splat in a scene.
    """
    budget = ClusterBudget(memory, clusters, splat)
    return ViewPlan(clusters, budget, copies_rest=budget.scenes_rest)


def as_drawn(
    source: CopiedSplats, cameras: Sequence[Camera], clusters: Sequence[ViewGroup], memory: int,
    progress: Callable[[int, int], None] | None = None,
) -> ViewPlan:  # fmt: skip
    """Each view with a copy of the splats of which it has an intersection with any tile.

    Args:
        source: fills what is projected to find these.
        clusters: of those that are meant.
        memory: bytes of the device's that they may take.
        progress: called with the views whose splats are found, and their number.
    """
    found: list[ViewGroup] = []
    for cluster in clusters:
        found += _drawn(source, cameras, cluster)
        if progress is not None:
            progress(len(found), sum(len(each.numbers) for each in clusters))
    budget = KnownBudget(memory)

    def together(others: Sequence[ViewGroup]) -> list[ViewGroup]:
        return [group for each in clusters for group in _few_splats(each, others, budget.streamed)]

    widest_first = sorted((each for each in found if each.count), key=lambda each: (-each.nbytes, each.numbers))
    idle = [number for each in found if not each.count for number in each.numbers]
    return ViewPlan(widest_first, budget, idle, together, singly=True, copies_rest=True)


def _drawn(source: CopiedSplats, cameras: Sequence[Camera], cluster: ViewGroup) -> list[ViewGroup]:
    """What the views of a cluster draw, each by itself."""
    device, splats = source.device, cluster.splats
    drawn = [np.zeros(len(splats), bool) for _ in cluster.numbers]
    counts = [0] * len(drawn)
    with PreparingMemory(device) as preparing:
        for first in range(0, len(splats), _PIECE):
            some = splats[first : first + _PIECE]
            with source.empty(len(some)) as piece, Rasterizer(device, piece, preparing=preparing) as rasterizer:
                source.fill(piece, some)
                for place, number in enumerate(cluster.numbers):
                    with rasterizer.prepare_set([cameras[number]]) as views:
                        count = views.views[0].intersection_count
                        found = device.download(views.intersections, (count,), np.uint32)
                    drawn[place][first : first + _PIECE][found] = True
                    counts[place] += count
    return [
        _of_bits((number,), cluster, own, drawn_bytes(int(np.count_nonzero(own)), count, cameras[number]))
        for number, own, count in zip(cluster.numbers, drawn, counts, strict=True)
    ]


def _of_bits(numbers: tuple[int, ...], cluster: ViewGroup, drawn: NDArray[np.bool_], nbytes: int = 0) -> ViewGroup:
    return ViewGroup(numbers, int(np.count_nonzero(drawn)), None, cluster.splats, np.packbits(drawn), nbytes)


def _few_splats(cluster: ViewGroup, others: Sequence[ViewGroup], passing: int) -> list[ViewGroup]:
    """Views of a cluster, as many together as see few enough splats."""
    found: list[ViewGroup] = []
    own = sorted((view for view in others if view.among is cluster.among), key=lambda each: each.numbers)
    for view in own:
        if found:
            both = found[-1].mask | view.mask
            if COPIED_SPLAT * int(np.count_nonzero(both)) <= passing:
                found[-1] = _of_bits(found[-1].numbers + view.numbers, cluster, both)
                continue
        found.append(view)
    return found
