"""Some splats of a scene on a device, which are drawn from there without a copy: :class:`PickedSplats`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers

_SOURCE = "raster/pick.cl"
#: Work-items of a work-group there, and splats that it looks at.
_GROUP, _CHUNK = 256, 4096


class PickedSplats(SceneBuffers):
    """Some splats of a scene that lies on a device, in an order of their own, for GPU kernels.

    They have no parameters of their own: the projection reads those of the whole scene. What it finds lies in the order
    of the numbers.

    Args:
        whole: the scene; it must outlive this object.
        numbers: (count,) uint32 in the device's memory, the numbers of these splats in it; the caller's.
        count: how many they are, at least one.
    """

    def __init__(self, whole: SceneBuffers, numbers: cl.Buffer, count: int) -> None:
        self.device = whole.device
        self.splats = count
        self.stride = -(-count // SPLAT_GROUP) * SPLAT_GROUP
        self.sh_count = whole.sh_count
        self.antialiased, self.low_pass = whole.antialiased, whole.low_pass
        self._memory = Memory(whole.device)
        self._whole, self._numbers = whole, numbers
        self.means, self.scales, self.quaternions = whole.means, whole.scales, whole.quaternions
        self.log2_opacities, self.sh = whole.log2_opacities, whole.sh

    @property
    def pick_macros(self) -> dict[str, int]:
        return {"PICKED": 1}

    @property
    def picks(self) -> dict[str, Any]:
        return {"whole_stride": self._whole.stride, "numbers": self._numbers, "picked": self.splats}


class Picker(Owner):
    """Finds the numbers of the splats of some groups on a device.

    Args:
        device: that finds them.
        groups: (N,) the group of each splat.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(self, device: Device, groups: NDArray[np.uint32]) -> None:
        self._device, self._splats = device, len(groups)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self._groups = self._memory.upload(groups, "the splats' groups")
            self._count, self._write = (device.kernel(_SOURCE, name) for name in ("count_wanted", "write_wanted"))

    def pick(
        self, memory: Memory, wanted: NDArray[np.bool_], states: cl.Buffer | None = None, state: int = 0
    ) -> tuple[cl.Buffer, int]:
        """The numbers of the splats of some groups.

        Args:
            memory: that owns them.
            wanted: (G,) the groups.
            states: (N,) uint8 in the device's memory, each splat's state; None: whatever it is.
            state: that the splats must be in.

        Returns:
            The numbers, uint32, ascending, and how many they are.

        Raises:
            DeviceError: the device has no room.
        """
        device, chunks = self._device, -(-self._splats // _CHUNK)
        items = (max(chunks, 1) * _GROUP,)
        with Memory(device) as own:
            flags = own.upload(wanted.astype(np.uint8), "the groups that are wanted")
            counts = own.allocate(4 * chunks, "the numbers of splats that are wanted")
            arguments = {
                "groups": self._groups,
                "wanted": flags,
                "states": flags if states is None else states,
                "by_state": states is not None,
                "state": state,
                "splats": self._splats,
            }
            self._count.bind(**arguments, counts=counts).launch(items, (_GROUP,))
            found = device.download(counts, (chunks,), np.uint32)
            ends = np.cumsum(found, dtype=np.uint32)
            numbers = memory.allocate(4 * int(ends[-1]), "the numbers of a view's splats")
            starts = own.upload(ends - found, "where they begin")
            self._write.bind(**arguments, starts=starts, numbers=numbers).launch(items, (_GROUP,))
            with device.errors("failed while computing"):
                device.queue.finish()
        return numbers, int(ends[-1])

    def close(self) -> None:
        self._memory.close()
