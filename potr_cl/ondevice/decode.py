"""From the bytes of a .potr file to a scene on a device: :func:`decode_to_device`.

The host undoes the entropy coding and makes values while they are in a cache, and uploads them without the AC
coefficients that are 0.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec.body import Body
from potr_cl.codec.decoder import PotrFile
from potr_cl.codec.dequantizer import BundleTaker
from potr_cl.codec.native.values import BUNDLE, PACKED, PackedValues
from potr_cl.errors import DataError
from potr_cl.model.scene import LOW_PASS, most_coefficients
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Staging
from potr_cl.raster.activation import activated_scales, log2_opacities, unit_quaternions
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

_SOURCE = "ondevice/spread.cl"


class StagedBundles(Owner):
    """Uploads the packed values of bundles into a scene's buffers.

    On the device a kernel spreads them over the scene's columns, while the host decodes others. So neither the host nor
    the bus handles the AC coefficients that are 0, which most are.

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
    """Takes a block's splats into a device's buffers: the bits that an upload of the scene has.

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


def decode_to_device(
    file: PotrFile, device: Device, sh_degree: int | None = None, antialiased: bool | None = None, threads: int = 0
) -> SceneBuffers:
    """Decode a file into a device's memory: the same bits there as of its scene that was decoded and uploaded.

    Args:
        file: opened. Of several blocks one after the other is decoded, each into buffers of its own first.
        device: to hold the scene.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        antialiased: whether to take it as an antialiased scene; None: as the file says.
        threads: on the host; 0: one a processor.

    Returns:
        The scene, finished; the caller closes it.

    Raises:
        UsageError: there is no such degree.
        DataError: damaged.
        DeviceError: the scene does not fit the device, or the device failed.
    """
    numbers, head = file.numbers(), file.blocks[0]
    asked = head.antialiased if antialiased is None else antialiased
    low_pass = head.low_pass if asked == head.antialiased else LOW_PASS
    count = most_coefficients(head.sh_degree, sh_degree)

    def decoded(number: int) -> SceneBuffers:
        with device.all_or_nothing():
            buffers = SceneBuffers(device, file.blocks[number].splats, count, asked, low_pass)
            file.of(number, lambda body: _decode(body, buffers, threads, sh_degree), sh_degree)
        return buffers

    if len(numbers) == 1:
        return decoded(numbers[0])
    with device.all_or_nothing():
        whole = SceneBuffers(device, file.header.splats, count, asked, low_pass)
        for number in numbers:
            with decoded(number) as part:
                whole.write_part(part, file.blocks[number].first)
    return whole


def _decode(body: Body, buffers: SceneBuffers, threads: int, sh_degree: int | None) -> None:
    destination = DeviceBundles(buffers)
    try:
        body.decode_into(destination, threads, sh_degree)
    except MemoryError:
        raise DataError(f"{buffers.splats} splats need more memory than the host has, to be decoded") from None
    finally:
        destination.finish()
