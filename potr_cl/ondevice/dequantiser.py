"""Levels to values on a device (:class:`DeviceDequantiser`), with the same bits as of the host's dequantiser.

Devices need not divide, take roots or logarithms exactly, so nothing is computed there but sums of integers: what a
level, or a sum of three, stands for is looked up in a table that the host has made. Where levels are too large for a
table, and for rotations and colours whose steps differ from splat to splat, the host finds the values and uploads them.
So it does for all of a file whose bundles become values while they are in a cache: of these it packs what is not 0
(:mod:`potr_cl.ondevice.staged_bundles`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec.byte_planes import IntegerStream
from potr_cl.codec.colour_factors import ColourFactors
from potr_cl.codec.container import Header
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.destination import BundleTaker
from potr_cl.codec.native.library import native
from potr_cl.codec.native.values import PackedValues
from potr_cl.codec.versions import FormatVersion
from potr_cl.errors import DataError
from potr_cl.ondevice.staged_bundles import StagedBundles, pinned_rooms
from potr_cl.opencl.memory import Memory
from potr_cl.raster.activation import activated_scales, log2_opacities, unit_quaternions
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

F32 = NDArray[np.float32]

_SOURCE = "ondevice/dequantise.cl"
#: Levels that are as large, or sums that are as far from 0, are left to the host. Tables of them take 2 and 4 MB.
_MOST_LEVELS, _FARTHEST_SUM = 1 << 19, 1 << 19
#: Splats of which the upload is what decoding waits for, unless the driver can copy from where they are.
_WORTH_PINNING = 1 << 18
#: Types of levels on the device, by NumPy's.
_TYPES = {np.uint8: "uchar", np.uint16: "ushort", np.int16: "short", np.int32: "int"}


class Activated:
    """Values as the projection takes them (:class:`potr_cl.codec.destination.Activation`)."""

    def scales(self, log_scales: F32) -> F32:
        return activated_scales(log_scales).astype(np.float32)

    def opacities(self, logits: F32) -> F32:
        return log2_opacities(logits).astype(np.float32)

    def rotations(self, quaternions: F32) -> F32:
        return unit_quaternions(quaternions).astype(np.float32)


class DeviceDequantiser(BundleTaker):
    """Takes a file's splats (:class:`potr_cl.codec.destination.Destination`) into a device's buffers.

    Args:
        header: of the file.
        version: the rules of the file's version.
        buffers: to be filled.
    """

    def __init__(self, header: Header, version: FormatVersion, buffers: SceneBuffers) -> None:
        self._header, self._version, self._buffers = header, version, buffers
        self._on_host = Dequantizer(header, version)
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

    def take_scales(self, streams: Sequence[IntegerStream]) -> None:
        factor = self._header.sf_scale

        def values(levels: NDArray[Any]) -> F32:
            return self.activation.scales(self._version.dequantize_scales(levels, factor))

        self._look_up([stream.joined for stream in streams], values, self._buffers.scales, "the scales")

    def take_opacities(self, stream: IntegerStream) -> None:
        factor = self._header.sf_opacity

        def values(levels: NDArray[Any]) -> F32:
            return self.activation.opacities(self._version.dequantize_opacities(levels, factor))

        self._look_up([stream.joined], values, self._buffers.log2_opacities, "the opacities")

    def take_rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream]) -> None:
        quaternions = np.empty((self._header.splats, 4), np.float32)
        self._on_host.rotations(streams, scales, quaternions)
        units = _units(quaternions)
        with self._lock:
            self._buffers.write_rows(self._buffers.quaternions, units, "the rotations", self._pending)

    @property
    def activation(self) -> Activated:
        """Standard deviations and logarithms of opacities, as the projection takes them."""
        return self._activated

    def expect_bundles(self) -> None:
        self._staged = StagedBundles(self._buffers, self._lock)

    def rooms(self, number: int) -> AbstractContextManager[list[PackedValues]]:
        if self._header.splats < _WORTH_PINNING:
            return super().rooms(number)
        return pinned_rooms(self._buffers.device, number)

    def take_bundle(self, first: int, packed: PackedValues, items: int) -> None:
        assert self._staged is not None
        self._staged.take(first, packed, items)

    def take_colours(
        self, streams: Sequence[IntegerStream], coefficient: int, differences: bool, factors: ColourFactors
    ) -> None:
        own = factors.dc if coefficient == 0 else factors.ac
        on_host = len(own) > 1 or (coefficient == 0 and self._version.colour_steps)
        levels, mapped, reach = (None, False, 0) if on_host else _summed_up(streams, differences)
        if levels is None:
            rgb = np.empty((3, self._header.splats), np.float32)
            self._on_host.colours(streams, coefficient, differences, factors, rgb)
            with self._lock:
                self._buffers.write_columns(self._buffers.sh, 3 * coefficient, rgb, self._pending)
            return
        table = np.arange(-reach, reach + 1).astype(np.float32) / own
        with self._lock, Memory(self._buffers.device) as memory:
            self._launch(
                "colours", levels, mapped, memory, table, "the SH coefficients",
                middle=reach, first=3 * coefficient, sh=self._buffers.sh,
            )  # fmt: skip

    def _look_up(
        self, levels: list[NDArray[Any]], values: Callable[[NDArray[Any]], F32], parameter: cl.Buffer, what: str
    ) -> None:
        """Values of unsigned levels, each array of them into a column of its own."""
        largest = max(int(level.max()) for level in levels)
        if largest >= _MOST_LEVELS or min(int(level.min()) for level in levels) < 0:
            columns = np.stack([values(level) for level in levels])
            with self._lock:
                self._buffers.write_columns(parameter, 0, columns, self._pending)
            return
        narrow = np.stack([level.astype(_unsigned(largest), copy=False) for level in levels])
        table = values(np.arange(largest + 1))
        with self._lock, Memory(self._buffers.device) as memory:
            self._launch(
                "look_up", narrow, False, memory, table, what, columns=len(levels), first=0, values=parameter
            )  # fmt: skip

    def _launch(
        self, name: str, levels: NDArray[Any], mapped: bool, memory: Memory, table: F32, what: str, **arguments: Any
    ) -> None:
        buffers = self._buffers
        if levels.shape[1] != buffers.splats:
            raise DataError(f"{what} are {levels.shape[1]} integers, not one for each of {buffers.splats} splats")
        kind = _TYPES[levels.dtype.type]
        buffers.device.shared_kernel(_SOURCE, name, LEVEL=kind, MAPPED=int(mapped)).bind(
            levels=memory.upload(levels, what, self._pending),
            table=memory.upload(table, what, self._pending),
            splats=buffers.splats,
            stride=buffers.stride,
            **arguments,
        ).launch((buffers.stride,), (SPLAT_GROUP,))


def _units(quaternions: F32) -> NDArray[Any]:
    """Quaternions of unit length."""
    functions = native()
    return unit_quaternions(quaternions) if functions is None else functions.quantising.unit_quaternions(quaternions)


def _summed_up(streams: Sequence[IntegerStream], differences: bool) -> tuple[NDArray[Any] | None, bool, int]:
    """Signed levels of three streams as the kernels take them.

    Returns:
        (3, N) levels, or None: they are too large for a table; whether they are mapped; and how far from 0 a sum of the
        three may be at most.
    """
    joined = [stream.joined for stream in streams]
    if not differences and all(level.dtype == np.uint8 for level in joined):
        return np.stack(joined), True, sum(int(level.max()) // 2 + 1 for level in joined)
    levels: list[NDArray[Any]] = [stream.part(0, len(level)) for stream, level in zip(streams, joined, strict=True)]
    if differences:
        levels = [np.cumsum(level, dtype=np.int64) for level in levels]
    reach = sum(max(int(level.max()), -int(level.min())) for level in levels)
    if reach > _FARTHEST_SUM:
        return None, False, 0
    return np.stack(levels).astype(np.int16 if reach <= np.iinfo(np.int16).max else np.int32), False, reach


def _unsigned(largest: int) -> type[np.generic]:
    return np.uint8 if largest < 1 << 8 else np.uint16 if largest < 1 << 16 else np.int32
