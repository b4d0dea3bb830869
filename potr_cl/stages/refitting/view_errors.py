"""The squared errors that sweeps find in views, on the device until somebody asks for them: :class:`ViewErrors`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.view_set import TILE


class ViewErrors(Owner):
    """Each tile's error, of all launches of a gradient.

    They are asked for once, when all is enqueued: while one thread waits for what it downloads, some drivers let no
    other one use that device, and others may want to read from it what they need to begin with their views.

    Args:
        device: that computes.
        cameras: the views. weights: what a pixel of each counts. numbers: of each among all views.
        launches: which of these cameras each launch does; they cover all, in their order.

    Attributes:
        latest: (tiles,) float32 on the device, where a sweep writes what it finds.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(
        self,
        device: Device,
        cameras: Sequence[Camera],
        weights: Sequence[float],
        numbers: Sequence[int],
        launches: Sequence[range],
    ) -> None:
        self._device, self._weights, self._numbers = device, list(weights), list(numbers)
        self._ends = [0, *itertools.accumulate(map(_tiles, cameras))]
        most = max((self._ends[each.stop] - self._ends[each.start] for each in launches), default=0)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.latest = self._memory.allocate(4 * most, "the tiles' errors")
            self._all = self._memory.allocate(4 * self._ends[-1], "the tiles' errors")

    def keep(self, launch: range) -> None:
        """Enqueue that what the last sweep, of this launch, has found is kept until :meth:`found`."""
        first, end = self._ends[launch.start], self._ends[launch.stop]
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(
                self._device.queue, self._all, self.latest, byte_count=4 * (end - first), dst_offset=4 * first
            )

    def found(self) -> dict[int, float]:
        """The squared error by W of each view, by its number among all; waits for the device."""
        tiles = self._device.download(self._all, (self._ends[-1],), np.float32)
        return {
            number: weight * float(tiles[first:end].sum(dtype=np.float64))
            for number, weight, (first, end) in zip(
                self._numbers, self._weights, itertools.pairwise(self._ends), strict=True
            )
        }

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()


def _tiles(camera: Camera) -> int:
    """Tiles that cover a view."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)
