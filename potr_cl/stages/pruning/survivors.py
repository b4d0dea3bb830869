"""Which splats are left, as host and device know it: :class:`Survivors`."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner

Indices = NDArray[np.int64]
Bits = NDArray[np.uint8]

#: Work-items of a work-group of the kernels that turn marks to bits and back; each has eight splats.
_GROUP = 64


class SplatState(IntEnum):
    """What a splat's byte in the device's memory says; the kernels know the names with SPLAT_ before them
    (cl/prune/removal.clh)."""

    REMOVED = 0
    ALIVE = 1
    #: Removed, but the tile lists still have it, and the tiles that lose it have not noted so.
    JUST_REMOVED = 2


class Survivors(Owner):
    """The state of each splat. Host and device have one copy each, and :meth:`settle` makes them agree.

    The host is ahead after :meth:`remove`, until the kernels that look for JUST_REMOVED are done. The device is ahead
    after it has marked splats itself (:meth:`marked_by_device`).

    Args:
        device: that has the copy.
        splats: N.
        stride: N padded; the buffer holds so many, and all are alive at first.
        wait: returns once the device has finished what was enqueued.

    Attributes:
        buffer: (stride,) uint8 in the device's memory, :class:`SplatState`.

    Raises:
        DeviceMemoryError: the device has no room.
    """

    def __init__(self, device: Device, splats: int, stride: int, wait: Callable[[], None]) -> None:
        self.device = device
        self._splats = splats
        self._wait = wait
        self._states = np.full(stride, SplatState.ALIVE, np.uint8)
        self._host_is_ahead = self.device_is_ahead = False
        self._memory = Memory(device)
        self.buffer = self._memory.upload(self._states, "the splats that are left")

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        self.settle()
        alive: NDArray[np.bool_] = self._states[: self._splats] == SplatState.ALIVE
        return alive

    def remove(self, splats: Indices) -> None:
        """Remove splats. On the device they are JUST_REMOVED until the next :meth:`settle`."""
        self.settle()
        self._states[splats] = SplatState.JUST_REMOVED
        self.device.copy(self.buffer, self._states)
        self._states[splats] = SplatState.REMOVED
        self._host_is_ahead = True

    def mark(self, splats: Bits) -> None:
        """Mark splats on the device as JUST_REMOVED, as a controller there does; :meth:`marked_by_device` follows.

        Args:
            splats: as :meth:`just_marked` gives them.
        """
        if self._host_is_ahead:
            self.settle()
        with Memory(self.device) as memory:
            bits = memory.upload(splats, "the splats that go")
            self._launch("mark_bits", bits)
            self.device.finish()  # before the memory is given back

    def just_marked(self) -> Bits:
        """(N / 8, rounded up) uint8: the splats that are JUST_REMOVED on the device, a bit each, the lowest first."""
        nbytes = -(-self._splats // 8)
        with Memory(self.device) as memory:
            bits = memory.allocate(nbytes, "the splats that go")
            self._launch("marked_bits", bits)
            return self.device.download(bits, (nbytes,), np.uint8)

    def _launch(self, name: str, bits: cl.Buffer) -> None:
        kernel = self.device.shared_kernel("prune/marks.cl", name)
        kernel.bind(states=self.buffer, splats=self._splats, bits=bits)
        kernel.launch((-(-self._splats // (8 * _GROUP)) * _GROUP,), (_GROUP,))

    def marked_by_device(self) -> None:
        """Note that the device has changed states from ALIVE to JUST_REMOVED, and that the host does not know which."""
        self.device_is_ahead = True

    def settle(self) -> None:
        """Make host and device agree on the splats that are left; none is JUST_REMOVED afterwards."""
        if self._host_is_ahead:
            self._host_is_ahead = False
            self._wait()
        elif self.device_is_ahead:
            self.device_is_ahead = False
            self._states = self.device.download(self.buffer, self._states.shape, np.uint8)
            self._states[self._states == SplatState.JUST_REMOVED] = SplatState.REMOVED
        else:
            return
        self.device.copy(self.buffer, self._states)

    def close(self) -> None:
        """Give the device's copy back."""
        self._memory.close()
