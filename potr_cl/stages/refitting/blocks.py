"""The splats' own blocks of the normal equations: the preconditioner, and what tells which coefficients to give up.

A splat's block is the sum over views s and pixels of w_s (T alpha)^2 B Bᵀ, B the SH basis towards the splat, for a
channel of unit length in R, G, B; Y, Co and Cg have the squared lengths 3, 2 and 3 and do not mix.
"""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.vector_space import Ridge

_SOURCE = "refit/blocks.cl"


class SplatBlocks(Owner):
    """A symmetric block a splat, cl/refit/blocks.cl.

    Args:
        coefficients: whose vectors and flags they go with.

    Attributes:
        buffer: (M (M + 1) / 2, stride) float32, packed upper triangles; a sweep adds to it.

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients) -> None:
        self._coefficients = coefficients
        device, layout = coefficients.device, coefficients.layout
        self._precondition, self._select_active = (
            device.shared_kernel(_SOURCE, name, **layout.macros) for name in ("precondition", "select_active")
        )
        self._triangle = layout.sh_count * (layout.sh_count + 1) // 2
        self._memory = Memory(device)
        self.buffer = self._memory.allocate(4 * self._triangle * layout.stride, "the splats' normal equations")

    @property
    def ranges(self) -> list[range]:
        """The splats whose blocks a sweep adds up together: all."""
        return [range(self._coefficients.layout.stride)]

    def add_fixed(self, splats: range, sums: cl.Buffer, unit: float) -> None:
        """Enqueue: blocks += unit times integers, which become 0.

        Args:
            splats: whose blocks, one of :attr:`ranges`.
            sums: (M (M + 1) / 2, len(splats)) int64.
            unit: in single precision.
        """
        self._coefficients.add_fixed_some(self.buffer, sums, 0, self._triangle * len(splats), unit)

    def zero(self) -> None:
        """Have all blocks 0."""
        self._coefficients.zero(self.buffer)

    def read(self) -> FloatArray:
        """(N, M, M) float32, symmetric."""
        layout = self._coefficients.layout
        packed = self._coefficients.device.download(self.buffer, (self._triangle, layout.stride), np.float32)
        blocks = np.empty((layout.splats, layout.sh_count, layout.sh_count), np.float32)
        rows, columns = np.triu_indices(layout.sh_count)
        blocks[:, rows, columns] = blocks[:, columns, rows] = packed[:, : layout.splats].T
        return blocks

    def packed(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32, the upper triangles row by row."""
        layout = self._coefficients.layout
        return self._coefficients.device.download(self.buffer, (self._triangle, layout.stride), np.float32)[
            :, : layout.splats
        ]

    def diagonals(self) -> FloatArray:
        """(N, M) float32, what stands on the blocks' diagonals."""
        layout = self._coefficients.layout
        rows, columns = np.triu_indices(layout.sh_count)
        diagonals = np.empty((layout.splats, layout.sh_count), np.float32)
        for m, place in enumerate(np.flatnonzero(rows == columns)):
            diagonals[:, m] = self._element(int(place))
        return diagonals

    def constants(self) -> FloatArray:
        """(N,) float32, what stands on the blocks' diagonals for the constant coefficient."""
        return self._element(0)

    def _element(self, place: int) -> FloatArray:
        layout = self._coefficients.layout
        column: FloatArray = self._coefficients.device.download(
            self.buffer, (layout.splats,), np.float32, 4 * layout.stride * place
        )
        return column

    def precondition(self, residual: cl.Buffer, ridge: Ridge, result: cl.Buffer) -> None:
        """result = (block + ridge)⁻¹ residual on each splat's active coefficients, 0 on the others."""
        layout = self._coefficients.layout
        self._precondition.bind(
            residual=residual,
            blocks=self.buffer,
            active=self._coefficients.active,
            stride=layout.stride,
            result=result,
            **ridge.scalars,
        )
        layout.over_splats(self._precondition)

    def give_up(self, x: cl.Buffer, prior: float, least: float) -> None:
        """Set AC coefficients that cost less than ``least`` to 0 and make them inactive.

        In each channel, the coefficient whose loss costs least goes first, and the others make up for it; then the next
        one, as long as one is cheap enough. The loss of x_m costs x_m² / P_mm, where P is the inverse of the block.

        Args:
            x: the coefficients.
            prior: added to the blocks' diagonals.
            least: weighted squared error.
        """
        layout = self._coefficients.layout
        self._select_active.bind(
            coefficients=x,
            blocks=self.buffer,
            active=self._coefficients.active,
            stride=layout.stride,
            prior=np.float32(prior),
            least=np.float32(least),
        )
        layout.over_splats(self._select_active)

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()
