"""What a device's buffers take of a file's splats (:class:`DeviceBundles`): the bits that an upload of the scene has.

Bundles become values on the host while they are in a cache; of these it packs what is not 0
(:mod:`potr_cl.ondevice.staged_bundles`).
"""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec.dequantizer import BundleTaker
from potr_cl.codec.native.values import PackedValues
from potr_cl.ondevice.staged_bundles import StagedBundles, pinned_rooms
from potr_cl.raster.activation import activated_scales, log2_opacities, unit_quaternions
from potr_cl.raster.scene_buffers import SceneBuffers

F32 = NDArray[np.float32]

#: Splats of which the upload is what decoding waits for, unless the driver can copy from where they are.
_WORTH_PINNING = 1 << 18


class Activated:
    """Values as the projection takes them (:class:`potr_cl.codec.dequantizer.Activation`)."""

    def scales(self, log_scales: F32) -> F32:
        return activated_scales(log_scales).astype(np.float32)

    def opacities(self, logits: F32) -> F32:
        return log2_opacities(logits).astype(np.float32)

    def rotations(self, quaternions: F32) -> F32:
        return unit_quaternions(quaternions).astype(np.float32)


class DeviceBundles(BundleTaker):
    """Takes a block's splats into a device's buffers.

    Args:
        buffers: to be filled.
    """

    def __init__(self, buffers: SceneBuffers) -> None:
        self._buffers = buffers
        # Threads decode; one after the other tells the device what to do with it.
        self._lock = threading.Lock()
        self._activated = Activated()
        # Copies that the device has not made yet; while it makes them, threads go on decoding.
        self._pending: list[cl.Event] = []
        self._staged: StagedBundles | None = None

    def finish(self) -> None:
        """Wait until everything that was taken is there.

        Raises:
            DeviceError: the device failed.
        """
        device = self._buffers.device
        try:
            with device.errors("failed while decoding"):
                device.queue.finish()
        finally:
            self._pending.clear()
            if self._staged is not None:
                self._staged.close()
                self._staged = None

    def take_means(self, means: F32) -> None:
        with self._lock:
            self._buffers.write_rows(self._buffers.means, means, "the centres", self._pending)

    @property
    def activation(self) -> Activated:
        """Standard deviations and logarithms of opacities, as the projection takes them."""
        return self._activated

    def expect_bundles(self) -> None:
        self._staged = StagedBundles(self._buffers, self._lock)

    def rooms(self, number: int) -> AbstractContextManager[list[PackedValues]]:
        if self._buffers.splats < _WORTH_PINNING:
            return super().rooms(number)
        return pinned_rooms(self._buffers.device, number)

    def take_bundle(self, first: int, packed: PackedValues, items: int) -> None:
        assert self._staged is not None
        self._staged.take(first, packed, items)
