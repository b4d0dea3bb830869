"""The removal sweep's interface for a controller on the device: it marks splats and reads totals without the host."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.stages.pruning.cached_sweep import CachedSweep
from potr_cl.stages.pruning.survivors import Bits, Survivors


class Steered(Protocol):
    """What :mod:`potr_cl.stages.pruning.on_device` needs.

    Attributes:
        device: where the totals and the marks are.
        totals: (N, 2) int64 in the device's memory.
        marks: (N,) uint8 in the device's memory, :class:`~potr_cl.stages.pruning.survivors.SplatState`. The controller
            marks splats as JUST_REMOVED and calls :meth:`remove_marked`; when it marks the next ones, it changes the
            earlier marks to REMOVED.
        units: ΔMSE and I of 1 in the totals.
        splats: N.
    """

    device: Device
    totals: cl.Buffer
    marks: cl.Buffer
    units: tuple[float, float]
    splats: int

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        ...

    def measure_on_device(self) -> None:
        """Bring the totals up to date."""

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED."""


class Steering:
    """A :class:`Steered` sweep of views that one device does.

    The device lists the tiles that the next measurement sweeps; the host learns only how many they are.

    Args:
        device: where everything is.
        cached: the sweep of the views, all of which are cached.
        survivors: the splats that are left.
        tolerance: staleness above which a tile is swept again.
        totals: that the sweep keeps up to date.
        units: ΔMSE and I of 1 in the totals.
        splats: N.

    Attributes:
        device, totals, units, splats, marks: see :class:`Steered`.
    """

    def __init__(
        self,
        device: Device,
        cached: CachedSweep,
        survivors: Survivors,
        tolerance: float,
        totals: cl.Buffer,
        units: tuple[float, float],
        splats: int,
    ) -> None:
        self._cached, self._survivors, self._tolerance = cached, survivors, tolerance
        self.device, self.totals, self.units, self.splats = device, totals, units, splats
        self.marks = survivors.buffer

    @property
    def alive(self) -> NDArray[np.bool_]:
        return self._survivors.alive

    def mark(self, splats: Bits) -> None:
        """Mark splats that a controller elsewhere has chosen, as its :meth:`just_marked` gives them.

        :meth:`remove_marked` follows.
        """
        self._survivors.mark(splats)

    def just_marked(self) -> Bits:
        """The splats that are marked JUST_REMOVED, see :meth:`Survivors.just_marked`."""
        return self._survivors.just_marked()

    def measure_on_device(self) -> None:
        if not self._cached.device_has_listed:  # nothing is marked, so this only lists the stale tiles
            self._survivors.settle()
            self.remove_marked()
        self._cached.measure()

    def remove_marked(self) -> None:
        self._cached.have_listed(self._tolerance)
        self._survivors.marked_by_device()
