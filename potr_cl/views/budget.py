"""Who decides which views stay on the device: the memory that they may fill, and which groups of a plan get it.

Other things than views have their own places: the uncompressed scene :mod:`potr_cl.raster.resident`, pictures
:mod:`potr_cl.views.targets` (but what pruning compares streamed views with is :meth:`Budget.of_pictures`' matter).
How much of what a user allows is the views' at all, :func:`potr_cl.pipeline.fallback.for_views` says.

A :class:`Budget` is asked for each group, in the plan's order, how many bytes it may take (:meth:`Budget.room`), and is
told what it has taken (:meth:`Budget.took`). A group with less room than it takes is streamed: made again whenever it
is looked at. Views of which only a part fits (:class:`ClusterBudget`) keep their lists first, in a
:class:`ViewCache`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.view_set import ViewSet, tile_grid
from potr_cl.views.visibility import ViewGroup, work

#: A launch's views should take at most a sixteenth of the budget: it is filled launch by launch, and what is left over
#: at the end is not used.
LEAST_SETS = 16
#: Bytes of a projected splat of a view: shape and colour.
_SHAPE, _COLOUR = 32, 16
GEOMETRY = _SHAPE + _COLOUR


class ViewCache(Owner):
    """Prepared views that are kept for more than one sweep, within a budget of device memory.

    Tile lists and depth orders take longer to make again than projections. So the lists of as many views as possible
    are kept first, and then the projections of as many of these as there is room for. The other views share room for
    one projection, which is made again whenever it is needed.

    Args:
        budget: bytes that they may take.
        others: bytes of the budget for which others have more use than views have for geometry of their own.

    Attributes:
        room: bytes of the budget that are left.
        largest: projected splats of the largest set of views that will be kept, where later ones are larger than the
            first ones.
        shared: shapes and colours for views that have none of their own, one set of views at a time; None: all views
            have their own.
    """

    def __init__(self, device: Device, budget: float, others: float = 0) -> None:
        self._memory = Memory(device)
        self._whole: list[ViewSet] = []  # those that keep their geometry
        self.room, self._others = budget, others
        self.largest = 0
        self.shared: tuple[cl.Buffer, cl.Buffer] | None = None

    def most_views(self, most: int, nbytes: int) -> int:
        """Views to do in one launch: ``most``, or as many as surely are a small part of the budget.

        Args:
            nbytes: that a view takes, at least.
        """
        return int(min(max(self.room // (LEAST_SETS * nbytes), 1), most))

    def keep(self, views: ViewSet, own: int = 0) -> bool:
        """Keep prepared views if the budget allows it.

        Args:
            views: may lose their geometry now, or later, when other views need the room.
            own: bytes that the caller keeps along with them.

        Returns:
            Whether they are kept. If not, the caller closes them.
        """
        to_spare = [*self._whole, views]
        shared = 0 if self.shared else max(GEOMETRY * self.largest, *map(self._geometry, to_spare))
        needed = views.nbytes_cached + own
        if needed + shared > self.room + sum(map(self._geometry, self._whole)):
            return False
        left = self.room - needed - self._geometry(views)
        if self.shared is None and left < max(self._others, 0):
            self._share(shared // GEOMETRY)
            left -= shared
        self.room = left
        while self.room < 0 or (self.room < self._others and to_spare):
            other = to_spare.pop()
            self.room += self._geometry(other)
            other.free_geometry()
        self._whole = to_spare
        return True

    def _geometry(self, views: ViewSet) -> int:
        return GEOMETRY * views.stride * len(views.views)

    def _share(self, splats: int) -> None:
        try:
            self.shared = (
                self._memory.allocate(_SHAPE * splats, "the projected splats"),
                self._memory.allocate(_COLOUR * splats, "the projected splats' colours"),
            )
        except DeviceError:
            self._memory.close()
            raise

    def close(self) -> None:
        """Give back the memory that views share; the views themselves are closed by their owners."""
        self._memory.close()
        self.shared, self._whole = None, []


#: Part of the device's memory that the views may take unless the caller sets a budget. A CPU's is that of the host: the
#: scene, its new colours and all other programs live there too.
_SHARE_OF_ALL, _SHARE_OF_HOST = 0.5, 0.3
#: The same of what is free, of views that share the device with other large things: a re-fit's vectors.
_SHARE_OF_FREE, _SHARE_OF_FREE_HOST = 0.4, 0.25
#: What others take later is known within this.
_SPARE = 1.1
#: Bytes that a view whose splats are named by their numbers is expected to take, for each splat: shape, colour, number,
#: and two and a half tile intersections. A third of the views has fewer intersections.
_NAMED, _LEAST = 87, 2 / 3
#: Of the memory, what streamed views may take while they are there, where splats are named by numbers.
STREAMED_NAMED = 1 / 5
#: Bytes of a resident view with a copy of what it draws: of each splat (shape, colour, totals, states, two numbers) and
#: of each intersection (splat, sub-tiles, sums). While it is made, of each splat: its scene, and lists to be sorted.
_COPIED, _INTERSECTION, _MAKING = 84, 16, 320
#: Of the memory, what streamed views may take where splats are copied; and bytes of each of their splats.
STREAMED_COPIED, COPIED_SPLAT = 1 / 4, 460
#: The clusters' scenes stay on the device if they take no more than this part of the memory.
SCENES = 1 / 2
#: Bytes that a view takes for each splat of its cluster while it is measured, or prepared to be kept: room for one is
#: set aside, and no more than this part of the memory.
_IN_HAND, _MOST_IN_HAND = 120, 1 / 4


def default_memory(device: Device) -> int:
    """Bytes that the views may take: half of a GPU's memory, 0.3 of a CPU's, which is the host's memory."""
    return int(device.info.memory * (_SHARE_OF_HOST if device.info.shares_host_memory else _SHARE_OF_ALL))


def free_memory(device: Device, later: int = 0) -> float:
    """Bytes that the views may take beside what is there: two fifths of what is free, or a quarter of the host's.

    Args:
        later: bytes that others will take, which the views leave free.
    """
    free = device.info.memory - device.allocated
    share = _SHARE_OF_FREE_HOST if device.info.shares_host_memory else _SHARE_OF_FREE
    return max(min(free * share, free - _SPARE * later), 0)


def target_bytes(camera: Camera) -> int:
    """What a view's picture takes."""
    return 12 * camera.width * camera.height


def tiles_of(camera: Camera) -> int:
    """How many tiles a view has."""
    return math.prod(tile_grid(camera))


def drawn_bytes(splats: int, intersections: int, camera: Camera) -> int:
    """What a view takes that has a copy of what it draws."""
    return _COPIED * splats + _INTERSECTION * intersections + target_bytes(camera)


class Budget(Protocol):
    """What groups may take, one after the other.

    Attributes:
        cache: keeps the views of all groups; None: each group has one of its own, of its room.
    """

    cache: ViewCache | None = None

    def room(self, group: ViewGroup) -> float:
        """Bytes that the next group may take; negative: it need not be tried."""
        ...

    def took(self, group: ViewGroup, nbytes: int) -> None:
        """Note what it has taken, on the device; 0: nothing of it stays."""

    def of_pictures(self, groups: Sequence[ViewGroup]) -> int:
        """Bytes that the pictures of streamed views may take which they are compared with."""
        return 0


class ClusterBudget(Budget):
    """One room for clusters of views, whose own scenes count too; each gets its part of what is left.

    Args:
        memory: in all.
        clusters: of the views, in their order; one that has all splats: it has no scene of its own.
        splat: bytes of a splat in a scene.

    Attributes:
        scenes_rest: whether the clusters' scenes are on the device only where they are needed.
    """

    def __init__(self, memory: int, clusters: Sequence[ViewGroup], splat: int = 0) -> None:
        sizes = [each.count * splat for each in clusters]
        self.scenes_rest = sum(sizes) > SCENES * memory
        self._left = max(memory - (max(sizes) if self.scenes_rest else sum(sizes)), 0)
        if splat:
            most = max(each.count for each in clusters)
            self._left -= min(_IN_HAND * most, int(_MOST_IN_HAND * self._left))
        self._to_come = list(clusters)

    def room(self, group: ViewGroup) -> float:
        return int(self._left * work([group]) / max(work(self._to_come), 1)) if len(self._to_come) > 1 else self._left

    def took(self, group: ViewGroup, nbytes: int) -> None:
        self._to_come.remove(group)
        self._left = max(self._left - nbytes, 0)


class CacheBudget(Budget):
    """One cache for all groups: lists of as many as possible first, then what others want, then geometry.

    Args:
        cache: whose room it is; the caller's.
    """

    def __init__(self, cache: ViewCache) -> None:
        self.cache: ViewCache = cache

    def room(self, group: ViewGroup) -> float:
        return self.cache.room

    def took(self, group: ViewGroup, nbytes: int) -> None:
        """The cache knows."""


class NamedBudget(Budget):
    """A room for single views whose splats are named by their numbers; pictures of streamed ones may have the rest.

    Args:
        memory: in all.
        groups: the views, in their order.
        totals: bytes of what they measure together.

    Attributes:
        streamed: bytes that streamed views may take while they are there.
    """

    def __init__(self, memory: int, groups: Sequence[ViewGroup], cameras: Sequence[Camera], totals: int) -> None:
        self._left, self.streamed, self._cameras = memory, int(STREAMED_NAMED * memory), cameras
        targets = sum(map(self._target, groups))
        # For the targets of all views that do not stay room is left, unless all will stay.
        self._reserved = 0
        if _NAMED * sum(each.count for each in groups) + targets > memory:
            self._left -= self.streamed + totals
            self._reserved = targets

    def room(self, group: ViewGroup) -> float:
        target = self._target(group)
        self._reserved = max(self._reserved - target, 0)
        room = self._left - self._reserved
        return -1 if _LEAST * _NAMED * group.count + target > room else room

    def took(self, group: ViewGroup, nbytes: int) -> None:
        self._left -= nbytes or self._target(group)

    def of_pictures(self, groups: Sequence[ViewGroup]) -> int:
        return self._left + sum(map(self._target, groups))

    def _target(self, group: ViewGroup) -> int:
        return sum(target_bytes(self._cameras[number]) for number in group.numbers)


class KnownBudget(Budget):
    """A room for single views that are known to take so much (:attr:`ViewGroup.nbytes`), widest first.

    Args:
        memory: in all.

    Attributes:
        streamed: bytes that streamed views may take while they are there.
    """

    def __init__(self, memory: int) -> None:
        self.streamed = int(STREAMED_COPIED * memory)
        self._left = memory - self.streamed

    def room(self, group: ViewGroup) -> float:
        # They take most while they are made, and most again each time if they are not kept.
        left = self._left - group.nbytes
        return math.inf if left >= 0 and _MAKING * group.count <= left + self.streamed else -1

    def took(self, group: ViewGroup, nbytes: int) -> None:
        if nbytes:
            self._left -= group.nbytes
