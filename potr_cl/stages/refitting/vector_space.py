"""Where a re-fit's vectors of SH coefficients lie, and what is computed with them: :class:`VectorSpace`.

They lie in the device's memory (coefficients.py), or, where that has not enough, in the host's
(sliced_coefficients.py). What is computed with them is the same to the last bit.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Owner

#: Work-items of a work-group.
_GROUP = 64
#: Columns whose flags share a word.
_FLAGS = 24

#: A vector: a device buffer, or what else a :class:`VectorSpace` makes; only that knows its layout.
Vector: TypeAlias = Any


@dataclass(frozen=True)
class Layout:
    """Where the coefficients of a scene's splats lie on the device (cl/refit/coefficients.clh).

    Attributes:
        splats: N. stride: N padded; a column has so many values.
        sh_count: M, coefficients of a channel.
        lanes: splats a work-item.
    """

    splats: int
    stride: int
    sh_count: int
    lanes: int

    @property
    def columns(self) -> int:
        """Coefficients of a splat; coefficient m, channel c of Y, Co, Cg is in column 3 m + c."""
        return 3 * self.sh_count

    @property
    def macros(self) -> dict[str, int]:
        """What the kernels must know of it when they are built."""
        return {"LANES": self.lanes, "SH_COUNT": self.sh_count}

    def some(self, constant: bool) -> dict[str, int]:
        """The same for kernels that look at all coefficients, or at the constant ones, whose columns come first."""
        return {**self.macros, "SH_COUNT": 1} if constant else self.macros

    def over_splats(self, kernel: Kernel, *others: int, stride: int | None = None) -> None:
        """Launch a bound kernel over all splats, or so many, and in the second dimension over ``others``."""
        group = max(_GROUP // self.lanes, 1)
        kernel.launch(((stride or self.stride) // self.lanes, *others), (group, *(1 for _ in others)))


@dataclass(frozen=True)
class Ridge:
    """The penalty beside the pictures' error: lam |x_AC|^2 + prior |x - start|^2, with a larger lam on chroma.

    Attributes:
        lam: on the AC coefficients of Y, in pixels of an image of ``REFERENCE_PIXELS``.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: on every coefficient's distance to its start, in the same unit.
    """

    lam: float
    chroma_factor: float
    prior: float

    @property
    def scalars(self) -> dict[str, np.float32]:
        """The arguments of that name of the kernels."""
        return {
            "lambda_luma": np.float32(self.lam),
            "lambda_chroma": np.float32(self.lam * self.chroma_factor),
            "prior": np.float32(self.prior),
        }


#: The rank of vectors that are used rarely.
RARELY = 100


class VectorSpace(Owner):
    """The vectors of one scene's coefficients in Y, Co, Cg, and the flags of those that may change.

    Args:
        device: to compute on.
        layout: of the vectors.

    Attributes:
        device, layout: as given.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.layout = device, layout

    @property
    def length(self) -> int:
        """Values of a vector, padding included."""
        return self.layout.columns * self.layout.stride

    def clear(self, buffer: cl.Buffer) -> None:
        """Enqueue: all bytes of a device buffer become 0."""
        self.device.fill(buffer, np.float32(0))

    # ------------------------------------------------------------------------------------------ vectors

    @abstractmethod
    def vector(self, rank: int = RARELY) -> Vector:
        """A new vector, not set; it is given back with the others by :meth:`close`.

        Args:
            rank: the lower, the more often it is used: where there is no room for all on the device, it comes first.
        """

    @abstractmethod
    def zero(self, x: Vector) -> None:
        """x = 0."""

    @abstractmethod
    def copy(self, y: Vector, x: Vector) -> None:
        """y = x."""

    @abstractmethod
    def combine(self, a: float, y: Vector, b: float, x: Vector) -> None:
        """y = a y + b x."""

    @abstractmethod
    def dot(self, x: Vector, y: Vector) -> float:
        """x · y; waits for the device. Not finite where single precision overflows."""

    @abstractmethod
    def largest(self, x: Vector) -> float:
        """The largest |x_i|; waits for the device."""

    @abstractmethod
    def add_ridge(self, sums: Vector, x: Vector, ridge: Ridge) -> None:
        """sums += (lam on AC + prior) x on the active coefficients; the others' sums become 0."""

    @abstractmethod
    def add_fixed(self, x: Vector, sums: cl.Buffer, unit: float, constant: bool = False) -> None:
        """x += unit times integers, which become 0.

        Args:
            x: the vector.
            sums: (3 M, stride) int64 in the device's memory.
            unit: in single precision.
            constant: only the constant coefficients' columns, where the others' integers are 0.
        """

    # ------------------------------------------------------------------------------------------ to and from elsewhere

    @abstractmethod
    def on_device(self, x: Vector, place: int = 0) -> cl.Buffer:
        """A vector in the device's memory, (3 M, stride) float32, to be read; valid until the next call for the place.

        Args:
            x: the vector.
            place: 0 or 1: so many vectors can be there at a time.
        """

    @abstractmethod
    def write_sh(self, x: Vector, sh: FloatArray) -> None:
        """Set a vector.

        Args:
            x: the vector.
            sh: (N, M, 3) R, G, B.
        """

    @abstractmethod
    def read_sh(self, x: Vector) -> FloatArray:
        """(N, M, 3) float32, a vector in R, G, B; each coefficient contiguous in memory."""

    def make_room(self) -> None:
        """Begin to take the host's memory for the next :meth:`read_sh`: that can take longer than to fill it."""

    # ------------------------------------------------------------------------------------------ which may change

    def keep_active(self, x: Vector) -> None:
        """x = 0 where it may not change."""
        self.add_ridge(x, x, Ridge(0.0, 0.0, 0.0))

    def activate_constant(self) -> None:
        """Say that the constant coefficients may change and no others."""
        words = np.zeros((2, self.layout.stride), np.uint32)
        words[0] = 0b111
        self.restore_flags(words)

    def activate(self, active: NDArray[np.bool_] | None) -> None:
        """Say which coefficients may change.

        Args:
            active: (N, M, 3) in Y, Co, Cg; None: all.
        """
        layout = self.layout
        words = np.zeros((2, layout.stride), np.uint32)
        if active is None:
            words[0] = (1 << min(layout.columns, _FLAGS)) - 1
            words[1] = (1 << max(layout.columns - _FLAGS, 0)) - 1
        else:
            for column in range(layout.columns):
                flags = active[:, column // 3, column % 3].astype(np.uint32)
                words[column // _FLAGS, : layout.splats] |= flags << np.uint32(column % _FLAGS)
        self.restore_flags(words)

    def is_active(self) -> NDArray[np.bool_]:
        """(N, M, 3) in Y, Co, Cg, which coefficients may change."""
        layout, words = self.layout, self.save_flags()[:, : self.layout.splats]
        bits = [words[column // _FLAGS] >> np.uint32(column % _FLAGS) & 1 for column in range(layout.columns)]
        return np.array(bits, bool).T.reshape(layout.splats, layout.sh_count, 3)

    @abstractmethod
    def save_flags(self) -> NDArray[np.uint32]:
        """The flags, (2, stride) words as the kernels have them, for :meth:`restore_flags`."""

    @abstractmethod
    def restore_flags(self, words: NDArray[np.uint32]) -> None:
        """Set the flags to what they were."""
