"""Some of the coefficients of a scene's splats in one row, splat by splat: :class:`PackedRow`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.stages.refitting.coefficients import Coefficients

_SOURCE = "refit/packing.cl"
#: Work-items of a work-group.
GROUP = 64
#: Splats whose coefficients a work-item counts one after the other.
_RUN = 64
_WHAT = "the coefficients' places"


class PackedRow(Owner):
    """Where the coefficients lie in a row whose flags are set.

    Args:
        coefficients: whose vectors are packed.
        flags: (2, stride) uint32 on their device, as :attr:`Coefficients.active`.

    Attributes:
        flags: as given.
        count: coefficients whose flags were set when :meth:`settle` was called last.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients, flags: cl.Buffer) -> None:
        self._device, self._layout, self.flags = coefficients.device, coefficients.layout, flags
        names = (
            "mark_nonzero",
            "count_active",
            "place_active",
            "pack_floats",
            "unpack_floats",
            "pack_sums",
            "add_sums",
        )
        self._kernels = {name: packing_kernel(coefficients, name) for name in names}
        self._places, self._starts = Scratch(self._device, _WHAT), Scratch(self._device, _WHAT)
        self.count = 0

    def settle(self) -> None:
        """Pack by the flags as they are on the device from now on."""
        runs = -(-self._layout.splats // _RUN)
        self._starts.reserve(8 * runs)
        self._places.reserve(8 * self._layout.splats)
        self._launch_runs("count_active", counts=self._starts.buffer)
        counts = self._device.download(self._starts.buffer, (runs,), np.uint64)
        ends = np.cumsum(counts, dtype=np.uint64)
        self.count = int(ends[-1])
        self._device.copy(self._starts.buffer, ends - counts)
        self._launch_runs("place_active", starts=self._starts.buffer, places=self._places.buffer)

    def set_flags(self, flags: NDArray[np.uint32]) -> None:
        """Pack by these, (2, N), from now on."""
        self._device.copy(self.flags, self.padded(flags))
        self.settle()

    def padded(self, flags: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """(2, stride), flags of N splats as they lie on the device."""
        words = np.zeros((2, self._layout.stride), np.uint32)
        words[:, : flags.shape[1]] = flags
        return words

    def mark_nonzero(self, x: cl.Buffer) -> None:
        """Pack by what is not 0 in a vector from now on."""
        kernel, splats = self._kernels["mark_nonzero"], self._layout.splats
        kernel.bind(columns=x, stride=self._layout.stride, splats=splats, flags=self.flags)
        kernel.launch((-(-splats // GROUP) * GROUP,), (GROUP,))
        self.settle()

    def pack_floats(self, x: cl.Buffer, packed: cl.Buffer) -> None:
        """Enqueue: a vector's coefficients to the row, (count,) float32."""
        self._launch("pack_floats", x, packed)

    def unpack_floats(self, x: cl.Buffer, packed: cl.Buffer) -> None:
        """Enqueue: from the row to a vector, in which all others become 0."""
        self._launch("unpack_floats", x, packed)

    def pack_sums(self, columns: cl.Buffer, packed: cl.Buffer) -> None:
        """Enqueue: sums over views to the row, (count,) int64. All sums become 0."""
        self._launch("pack_sums", columns, packed)

    def add_sums(self, columns: cl.Buffer, packed: cl.Buffer) -> None:
        """Enqueue: the row is added to sums over views."""
        self._launch("add_sums", columns, packed)

    def _launch_runs(self, name: str, **buffers: cl.Buffer) -> None:
        kernel, splats = self._kernels[name], self._layout.splats
        kernel.bind(active=self.flags, stride=self._layout.stride, splats=splats, **buffers)
        kernel.launch((-(-splats // (_RUN * GROUP)) * GROUP,), (GROUP,))

    def _launch(self, name: str, columns: cl.Buffer, packed: cl.Buffer) -> None:
        kernel, splats = self._kernels[name], self._layout.splats
        kernel.bind(
            columns=columns,
            active=self.flags,
            stride=self._layout.stride,
            splats=splats,
            places=self._places.buffer,
            packed=packed,
        )
        kernel.launch((-(-splats // GROUP) * GROUP,), (GROUP,))

    def close(self) -> None:
        """Give the device's memory back."""
        self._places.close()
        self._starts.close()


def packing_kernel(coefficients: Coefficients, name: str) -> Kernel:
    """A kernel of the program that packs a scene's coefficients, which is built once.

    Raises:
        DeviceError: it cannot be built.
    """
    return coefficients.device.kernel(_SOURCE, name, LANES=1, SH_COUNT=coefficients.layout.sh_count, RUN=_RUN)
