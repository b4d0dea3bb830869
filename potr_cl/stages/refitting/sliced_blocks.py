"""The splats' own blocks of the normal equations in the host's memory: :class:`SlicedBlocks`."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.ferry import Cargo
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.sliced_coefficients import AnyVector, HostColumns, SlicedCoefficients
from potr_cl.stages.refitting.vector_space import Ridge

#: Bytes of rows that are added up before they go to the host, about.
_ROWS = 1 << 26


class SlicedBlocks(Owner):
    """What :class:`potr_cl.stages.refitting.blocks.SplatBlocks` is, slice by slice.

    Args:
        coefficients: whose vectors and flags they go with.
        splats: whose integers are on the device at a time.

    Attributes:
        own: a slice's blocks on the device.

    Raises:
        PotrError: there is no room for them.
        DeviceError: the device has no room for a slice, or the kernels cannot be built.
    """

    def __init__(self, coefficients: SlicedCoefficients, splats: int) -> None:
        self._coefficients = coefficients
        layout = coefficients.layout
        self._splats = min(max(splats // SPLAT_GROUP, 1) * SPLAT_GROUP, layout.stride)
        self._triangle = layout.sh_count * (layout.sh_count + 1) // 2
        self._columns: HostColumns = coefficients.columns(self._triangle, "the splats' normal equations")
        self._columns.changed()
        #: Where ranges begin whose blocks are 0, whatever is written there.
        self._unset: set[int] = set()
        self.zero()
        self.own = SplatBlocks(coefficients.own)

    @property
    def ranges(self) -> list[range]:
        """The splats whose blocks a sweep adds up together."""
        stride = self._coefficients.layout.stride
        return [range(first, min(first + self._splats, stride)) for first in range(0, stride, self._splats)]

    def zero(self) -> None:
        """Have all blocks 0."""
        self._unset = {splats.start for splats in self.ranges}

    def add_fixed(self, splats: range, sums: cl.Buffer, unit: float) -> None:
        """See :meth:`potr_cl.stages.refitting.blocks.SplatBlocks.add_fixed`."""
        device, values = self._coefficients.device, self._columns.values
        first = splats.start in self._unset
        some = max(_ROWS // (4 * len(splats)), 1)
        with Memory(device) as memory:
            columns = memory.allocate(4 * len(splats) * min(some, self._triangle), "the splats' normal equations")
            for row in range(0, self._triangle, some):
                rows = values[row : row + some]
                own = [Cargo(rows, columns=splats)]
                if first:
                    self._coefficients.clear(columns)
                else:
                    self._coefficients.ferry.to_device(columns, own)
                count = len(rows) * len(splats)
                self._coefficients.own.add_fixed_some(columns, sums, row * len(splats), count, unit)
                self._coefficients.ferry.to_host(own, columns)
        self._unset.discard(splats.start)

    def _values(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32, the blocks, where they lie."""
        for splats in self.ranges:
            if splats.start in self._unset:
                self._columns.values[:, splats.start : splats.stop] = 0
        self._unset.clear()
        return self._columns.values[:, : self._coefficients.layout.splats]

    def give(self, part: range) -> SplatBlocks:
        """A slice's blocks, on the device: valid until the next call."""
        if self._unset:
            self._values()
        self._coefficients.copy_part(self._columns, part, self.own.buffer)
        return self.own

    def precondition(self, residual: AnyVector, ridge: Ridge, result: AnyVector) -> None:
        """See :meth:`potr_cl.stages.refitting.blocks.SplatBlocks.precondition`."""
        vectors = self._coefficients
        for part in vectors.parts():
            vectors.give_flags(part)
            some, found = vectors.give(residual, part, 0), vectors.place(1)
            self.give(part).precondition(some, ridge, found)
            vectors.take(result, part, found)
        if isinstance(result, HostColumns):
            result.changed()

    def give_up(self, x: AnyVector, prior: float, least: float) -> None:
        """See :meth:`potr_cl.stages.refitting.blocks.SplatBlocks.give_up`."""
        self._coefficients.each(x, lambda part, some: self.give(part).give_up(some, prior, least))

    def packed(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32, the upper triangles row by row."""
        packed: FloatArray = self._values().copy()
        return packed

    def read(self) -> FloatArray:
        """(N, M, M) float32, symmetric."""
        layout = self._coefficients.layout
        blocks = np.empty((layout.splats, layout.sh_count, layout.sh_count), np.float32)
        rows, columns = np.triu_indices(layout.sh_count)
        blocks[:, rows, columns] = blocks[:, columns, rows] = self.packed().T
        return blocks

    def diagonals(self) -> FloatArray:
        """(N, M) float32, what stands on the blocks' diagonals."""
        rows, columns = np.triu_indices(self._coefficients.layout.sh_count)
        places = np.flatnonzero(rows == columns)
        return np.ascontiguousarray(self._values()[places].T)

    def constants(self) -> FloatArray:
        """(N,) float32, what stands on the blocks' diagonals for the constant coefficient."""
        constants: FloatArray = self._values()[0].copy()
        return constants

    def close(self) -> None:
        """Give the device's memory back."""
        self.own.close()
