"""Some splats of a scene on a device, which are drawn from there without a copy: :class:`IndexSubset`."""

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
#: Among splats' numbers: there is none (cl/include/splat.clh).
NO_SPLAT = 0xFFFFFFFF


class IndexSubset(SceneBuffers):
    """Some splats of a scene that lies on a device, in an order of their own, for GPU kernels.

    They have no parameters of their own: the projection reads those of the whole scene. What it finds lies in the order
    of the numbers.

    Args:
        whole: the scene; it must outlive this object.
        numbers: (count,) uint32 in the device's memory, the numbers of these splats in it; the caller's.
        count: how many they are, at least one.
        apart: so far behind the numbers for one view those for the next begin; 0: all views have the same. Then the
            numbers may be :data:`NO_SPLAT`, for none.
    """

    def __init__(self, whole: SceneBuffers, numbers: cl.Buffer, count: int, apart: int = 0) -> None:
        self.device = whole.device
        self.splats = count
        self.stride = -(-count // SPLAT_GROUP) * SPLAT_GROUP
        self.sh_count = whole.sh_count
        self.antialiased, self.low_pass = whole.antialiased, whole.low_pass
        self._memory = Memory(whole.device)
        self._whole, self._numbers, self._apart = whole, numbers, apart
        self.means, self.scales, self.quaternions = whole.means, whole.scales, whole.quaternions
        self.log2_opacities, self.sh = whole.log2_opacities, whole.sh

    @property
    def pick_macros(self) -> dict[str, int]:
        return {"PICKED": 1}

    @property
    def picks(self) -> dict[str, Any]:
        return {
            "whole_stride": self._whole.stride,
            "numbers": self._numbers,
            "picked": self.splats,
            "apart": self._apart,
        }


class Picker(Owner):
    """Finds the numbers of the splats of some groups on a device.

    Args:
        device: that finds them.
        groups: (N,) the group of each splat.

    Attributes:
        device: as given. splats: N.
        groups: as given, in the device's memory. count, write: the kernels.
    """

    def __init__(self, device: Device, groups: NDArray[np.uint32]) -> None:
        self.device = device
        self.splats = len(groups)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self.groups = self._memory.upload(groups, "the splats' groups")
            self.count, self.write = (device.kernel(_SOURCE, name) for name in ("count_wanted", "write_wanted"))

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
        """
        with Memory(self.device) as own:
            picks = IndexSubsets(own, self, wanted[None], states, state)
            numbers = picks.numbers(memory, 0)
            with self.device.errors("failed while computing"):
                self.device.queue.finish()
        return numbers, picks.counts[0]


class IndexSubsets:
    """The numbers of the splats of several choices of groups, which are found without waiting for the device.

    Args:
        memory: to take what is needed for that from; the choices can be made as long as it is there.
        picker: of the scene.
        wanted: (choices, G) the groups of each.
        states, state: as of :meth:`Picker.pick`.

    Attributes:
        counts: of each choice's splats.
    """

    def __init__(
        self, memory: Memory, picker: Picker, wanted: NDArray[np.bool_], states: cl.Buffer | None = None, state: int = 0
    ) -> None:
        choices, groups = wanted.shape
        chunks = max(-(-picker.splats // _CHUNK), 1)
        self._write, self._items = picker.write, chunks * _GROUP
        flags = memory.upload(wanted.view(np.uint8), "the groups that are wanted")
        counts = memory.allocate(4 * chunks * choices, "the numbers of splats that are wanted")
        self._arguments = {
            "groups": picker.groups,
            "wanted": flags,
            "states": flags if states is None else states,
            "by_state": states is not None,
            "state": state,
            "splats": picker.splats,
            "group_count": groups,
        }
        picker.count.bind(**self._arguments, counts=counts).launch((self._items, choices), (_GROUP, 1))
        found = picker.device.download(counts, (choices, chunks), np.uint32)
        ends = np.cumsum(found, axis=1, dtype=np.uint32)
        self.counts: list[int] = ends[:, -1].tolist()
        self._starts = memory.upload(ends - found, "where they begin")

    def numbers(self, memory: Memory, choice: int) -> cl.Buffer:
        """The numbers of a choice's splats, uint32, ascending, once the device's queue has found them.

        Args:
            memory: that owns them.
            choice: its number.
        """
        found = memory.allocate(4 * self.counts[choice], "the numbers of a view's splats")
        self.numbers_into(found, 0, choice)
        return found

    def numbers_into(self, buffer: cl.Buffer, first: int, choice: int) -> None:
        """Enqueue the same, from a place in a buffer on."""
        write = self._write.bind(**self._arguments, choice=choice, starts=self._starts, first=first, numbers=buffer)
        write.launch((self._items,), (_GROUP,))
