"""Bundles of a file on their way to a device: :class:`StagedBundles`.

On the device a kernel spreads the packed values of a bundle over the scene's columns, while the host decodes others. So
neither the host nor the bus handles the AC coefficients that are 0, which most are.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from potr_cl.codec.native.values import BUNDLE, PACKED, PackedValues
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Staging
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

_SOURCE = "ondevice/spread.cl"


class StagedBundles(Owner):
    """Uploads the packed values of bundles into a scene's buffers.

    Args:
        buffers: to be filled; their SH coefficients are 0.
        lock: held by whoever tells the device what to do.

    Raises:
        DeviceError: the device has no room for a bundle beside the scene.
    """

    def __init__(self, buffers: SceneBuffers, lock: threading.Lock) -> None:
        device = buffers.device
        self._buffers, self._lock = buffers, lock
        self._memory = Memory(device)
        self._spread = device.shared_kernel(_SOURCE, "spread", BUNDLE=BUNDLE)
        self._packed = self._memory.allocate(4 * PACKED, "a bundle of splats")
        self._spread.bind(
            packed=self._packed,
            splats=0,
            items=0,
            first=0,
            stride=buffers.stride,
            scales=buffers.scales,
            quaternions=buffers.quaternions,
            log2_opacities=buffers.log2_opacities,
            sh=buffers.sh,
        )

    def take(self, first: int, packed: PackedValues, items: int) -> None:
        """Upload a bundle and have it spread.

        Args:
            first: the number of its first splat.
            packed: its values, of which the device has a copy when this returns.
            items: how many it has.

        Raises:
            DeviceError: the device failed.
        """
        buffers, device = self._buffers, self._buffers.device
        splats = min(buffers.splats - first, BUNDLE)
        with self._lock:
            with device.errors("cannot take a scene"):
                cl.enqueue_copy(device.queue, self._packed, packed.memory[: packed.used(items)])
            self._spread.set(splats=splats, items=items, first=first)
            groups = -(-max(splats, items) // SPLAT_GROUP)
            self._spread.launch((groups * SPLAT_GROUP,), (SPLAT_GROUP,))

    def close(self) -> None:
        self._memory.close()


@contextmanager
def pinned_rooms(device: Device, number: int) -> Iterator[list[PackedValues]]:
    """Memory for so many bundles, which the driver copies from without a detour.

    To take it takes longer than to decode a small file, so it stays with the device.
    """
    with _guard:
        kept = _pinned.pop(device, [])
    rooms = kept[:number]
    try:
        rooms += [PackedValues(Staging(device).array((PACKED,), np.float32)) for _ in range(number - len(rooms))]
        yield rooms
    finally:
        rooms += kept[number:]
        with _guard:
            if len(rooms) > len(_pinned.get(device, [])):
                _pinned[device] = rooms


#: Memory that no file is decoded in now, by device.
_pinned: WeakKeyDictionary[Device, list[PackedValues]] = WeakKeyDictionary()
_guard = threading.Lock()
