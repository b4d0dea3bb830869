"""Prepared views that are kept for more than one sweep, within a budget of device memory.

Tile lists and depth orders take longer to make again than projections, so lists of as many views as possible are kept,
and projections of as many of these as there is room for then. The other views share the room of one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pyopencl as cl

from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import ViewSet

#: At least so many launches' views should fill a budget that does not hold all: it is used up launch by launch.
_LEAST_SETS = 16
#: Bytes of a projected splat of a view: shape and colour.
_SHAPE, _COLOUR = 32, 16


class ViewCache(Owner):
    """What is kept of views.

    Args:
        rasterizer: that prepares them.
        budget: bytes that they may take.

    Attributes:
        room: bytes of the budget that are left.
        shared: shapes and colours of whichever views are at work that have none of their own; None: all have.
    """

    def __init__(self, rasterizer: Rasterizer, budget: float) -> None:
        self._rasterizer = rasterizer
        self._memory = Memory(rasterizer.device)
        self._whole: list[ViewSet] = []  # those with their geometry
        self.room = budget
        self.shared: tuple[cl.Buffer, cl.Buffer] | None = None

    def most_views(self, most: int, nbytes: int) -> int:
        """Views to do in one launch: ``most``, or as many as surely are a small part of the budget.

        Args:
            nbytes: that a view takes besides its geometry, at least.
        """
        least = (_SHAPE + _COLOUR) * self._rasterizer.stride + nbytes
        return int(min(max(self.room // (_LEAST_SETS * least), 1), most))

    def keep(self, views: ViewSet, own: int = 0) -> bool:
        """Keep prepared views as far as the budget allows; whether it does. If not, they are the caller's to close.

        Args:
            own: bytes that the caller keeps along with them.

        Raises:
            DeviceMemoryError: the device has no room for what views share.
        """
        to_spare = [*self._whole, views]
        shared = 0 if self.shared else max(map(self._geometry, to_spare))
        needed = views.nbytes_cached + own
        if needed + shared > self.room + sum(map(self._geometry, self._whole)):
            return False
        self.room -= needed + self._geometry(views)
        while self.room < 0:
            other = to_spare.pop()
            self.room += self._geometry(other)
            other.free_geometry()
            if self.shared is None:
                self.room -= shared
                self._share(shared // (_SHAPE + _COLOUR))
        self._whole = to_spare
        return True

    def _geometry(self, views: ViewSet) -> int:
        return (_SHAPE + _COLOUR) * self._rasterizer.stride * len(views.views)

    def _share(self, splats: int) -> None:
        self.shared = (
            self._memory.allocate(_SHAPE * splats, "the projected splats"),
            self._memory.allocate(_COLOUR * splats, "the projected splats' colours"),
        )

    @contextmanager
    def geometry(self, views: ViewSet) -> Iterator[bool]:
        """Have kept views' geometry there for a while; whether it had to be made again."""
        if views.shapes is not None:
            yield False
            return
        assert self.shared is not None
        views.shapes, views.colours = self.shared
        try:
            self._rasterizer.project(views)
            yield True
        finally:
            views.shapes = views.colours = None

    def close(self) -> None:
        """Give back what views share; they themselves are their owners' to close."""
        self._memory.close()
        self.shared, self._whole = None, []
