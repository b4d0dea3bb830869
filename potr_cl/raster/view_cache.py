"""Prepared views that are kept for more than one sweep, within a budget of device memory: :class:`ViewCache`.

Tile lists and depth orders take longer to make again than projections. So the lists of as many views as possible are
kept first, and then the projections of as many of these as there is room for. The other views share room for one
projection, which is made again whenever it is needed.
"""

from __future__ import annotations

import pyopencl as cl

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.view_set import ViewSet

#: A launch's views should take at most a sixteenth of the budget: it is filled launch by launch, and what is left over
#: at the end is not used.
LEAST_SETS = 16
#: Bytes of a projected splat of a view: shape and colour.
_SHAPE, _COLOUR = 32, 16
GEOMETRY = _SHAPE + _COLOUR


class ViewCache(Owner):
    """What is kept of views.

    Args:
        device: that they are prepared on.
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

        Raises:
            DeviceMemoryError: the device has no room for what views share.
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
