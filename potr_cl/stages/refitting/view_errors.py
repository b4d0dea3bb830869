"""The squared errors that sweeps find in views, on the device until somebody asks for them: :class:`ViewErrors`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.views.budget import tiles_of


class ViewErrors(Owner):
    """Each tile's error, of all launches of a gradient.

    They are asked for once, when all is enqueued: while one thread waits for what it downloads, some drivers let no
    other one use that device, and others may want to read from it what they need to begin with their views.

    Args:
        device: that computes.
        cameras: all views. weights: what a pixel of each counts.
        launches: numbers of the views that each launch does.

    Attributes:
        latest: (tiles,) float32 on the device, where a sweep writes what it finds.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(
        self, device: Device, cameras: Sequence[Camera], weights: Sequence[float], launches: Sequence[Sequence[int]]
    ) -> None:
        self._device, self._weights = device, list(weights)
        self._numbers = [number for each in launches for number in each]
        self._ends = [0, *itertools.accumulate(tiles_of(cameras[number]) for number in self._numbers)]
        most = max((sum(tiles_of(cameras[number]) for number in each) for each in launches), default=0)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.latest = self._memory.allocate(4 * most, "the tiles' errors")
            self._all = self._memory.allocate(4 * self._ends[-1], "the tiles' errors")

    def keep(self, views: range) -> None:
        """Enqueue that what the last sweep has found is kept until :meth:`found`; views by their place in launches."""
        first, end = self._ends[views.start], self._ends[views.stop]
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(
                self._device.queue, self._all, self.latest, byte_count=4 * (end - first), dst_offset=4 * first
            )

    def found(self) -> dict[int, float]:
        """The squared error by W of each view, by its number among all; waits for the device."""
        tiles = self._device.download(self._all, (self._ends[-1],), np.float32)
        return {
            number: self._weights[number] * float(tiles[first:end].sum(dtype=np.float64))
            for number, (first, end) in zip(self._numbers, itertools.pairwise(self._ends), strict=True)
        }

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()
