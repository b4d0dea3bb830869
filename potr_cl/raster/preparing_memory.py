"""Memory in which views are prepared: :class:`PreparingMemory`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.raster.long_lists import LongLists


class PreparingMemory(Owner):
    """What preparing views takes besides what is left of them: rasterizers that take turns may share it.

    Args:
        device: whose memory it is.

    Attributes:
        bounds, counts, keys: the tiles that splats touch, the tiles' counters, and the lists while they are sorted.
        long_lists: sorts those that one work-group would be long with.
        image, transmittance: of pictures.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self.bounds = Scratch(device, "the projected splats' bounds")
        self.counts = Scratch(device, "the tile counts")
        self.keys = Scratch(device, "the tile lists' sort keys")
        self.long_lists = LongLists(device)
        self.image = Scratch(device, "the image")
        self.transmittance = Scratch(device, "the transmittance")

    def zeroed_counts(self, nbytes: int) -> cl.Buffer:
        """Counters for all tiles. They are zero, and the kernels that use them leave them zero."""
        if self.counts.reserve(nbytes):
            self._device.fill(self.counts.buffer, np.uint32(0), self.counts.nbytes)
        return self.counts.buffer

    def rest(self) -> None:
        """Give all back but the pictures."""
        for owner in (self.bounds, self.counts, self.keys, self.long_lists):
            owner.close()

    def close(self) -> None:
        self.rest()
        for scratch in (self.image, self.transmittance):
            scratch.close()
