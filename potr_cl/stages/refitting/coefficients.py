"""Vectors of SH coefficients on the device: where they lie, what is computed with them, and which may change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner

_SOURCE = "refit/coefficients.cl"
#: Work-items that share a dot product.
_DOT_ITEMS = 16384
#: Work-items of a work-group.
_GROUP = 64
#: Splats whose coefficients are uploaded at a time.
_TURNED = 1 << 18
#: Columns whose flags share a word on the device.
_FLAGS = 24


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

    def over_splats(self, kernel: Kernel, *others: int) -> None:
        """Launch a bound kernel over all splats, and in the second dimension over ``others``."""
        group = max(_GROUP // self.lanes, 1)
        kernel.launch((self.stride // self.lanes, *others), (group, *(1 for _ in others)))


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


class Coefficients(Owner):
    """The vectors of one scene's coefficients in Y, Co, Cg, and the flags of those that may change.

    A vector is a device buffer; only this class and the kernels know its layout.

    Args:
        device: to compute on.
        layout: of the vectors.

    Attributes:
        device, layout: as given.
        active: device buffer of the flags, (2, stride) uint32, a bit a coefficient; all are set at first.

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
    """

    def __init__(self, device: Device, layout: Layout) -> None:
        self.device, self.layout = device, layout
        self._regularise, self._combine, self._dot_parts, self._to_ycocg, self._to_rgb = (
            device.shared_kernel(_SOURCE, name, **layout.macros)
            for name in ("regularise", "combine", "dot_parts", "to_ycocg", "to_rgb")
        )
        self._memory = Memory(device)
        try:
            self.active = self._memory.allocate(8 * layout.stride, "the active coefficients")
            self._parts = self._memory.allocate(8 * _DOT_ITEMS, "a dot product")
            self.activate(None)
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------------------ vectors

    def vector(self) -> cl.Buffer:
        """A new vector, not set; it is given back with the others by :meth:`close`."""
        return self._memory.allocate(4 * self._length, "the SH coefficients")

    @property
    def _length(self) -> int:
        return self.layout.columns * self.layout.stride

    def zero(self, x: cl.Buffer) -> None:
        """x = 0."""
        self.device.fill(x, np.float32(0))

    def copy(self, y: cl.Buffer, x: cl.Buffer) -> None:
        """y = x."""
        cl.enqueue_copy(self.device.queue, y, x, byte_count=4 * self._length)

    def combine(self, a: float, y: cl.Buffer, b: float, x: cl.Buffer) -> None:
        """y = a y + b x."""
        self._combine.bind(a=np.float32(a), y=y, b=np.float32(b), x=x).launch((self._length,), (_GROUP,))

    def dot(self, x: cl.Buffer, y: cl.Buffer) -> float:
        """x · y; waits for the device. Not finite where single precision overflows."""
        return self._dot(x, y)[0]

    def largest(self, x: cl.Buffer) -> float:
        """The largest |x_i|; waits for the device."""
        return self._dot(x, x)[1]

    def _dot(self, x: cl.Buffer, y: cl.Buffer) -> tuple[float, float]:
        self._dot_parts.bind(x=x, y=y, count=self._length, parts=self._parts).launch((_DOT_ITEMS,), (_GROUP,))
        parts = self.device.download(self._parts, (2, _DOT_ITEMS), np.float32)
        with np.errstate(invalid="ignore"):  # infinities of both signs: the callers look at the result
            return float(parts[0].sum(dtype=np.float64)), float(parts[1].max())

    def add_ridge(self, sums: cl.Buffer, x: cl.Buffer, ridge: Ridge) -> None:
        """sums += (lam on AC + prior) x on the active coefficients; the others' sums become 0."""
        self._regularise.bind(sums=sums, coefficients=x, active=self.active, stride=self.layout.stride, **ridge.scalars)
        self.layout.over_splats(self._regularise)

    # ------------------------------------------------------------------------------------------ to and from the host

    def write(self, x: cl.Buffer, values: NDArray[np.floating]) -> None:
        """Set a vector.

        Args:
            x: the vector.
            values: (N, M, 3) in Y, Co, Cg.
        """
        columns = np.zeros((self.layout.sh_count, 3, self.layout.stride), np.float32)
        columns[:, :, : self.layout.splats] = values.transpose(1, 2, 0)
        cl.enqueue_copy(self.device.queue, x, columns, is_blocking=True)

    def read(self, x: cl.Buffer) -> FloatArray:
        """(N, M, 3) float32, a vector in Y, Co, Cg."""
        return np.ascontiguousarray(self._columns_of(x)[:, :, : self.layout.splats].transpose(2, 0, 1))

    def write_columns(self, x: cl.Buffer, values: FloatArray) -> None:
        """Set a vector from its columns, (3 M, N) float32."""
        for column, row in enumerate(values):
            start = 4 * column * self.layout.stride
            cl.enqueue_copy(self.device.queue, x, np.ascontiguousarray(row), dst_offset=start, is_blocking=True)

    def write_sh(self, x: cl.Buffer, sh: FloatArray) -> None:
        """Set a vector.

        Args:
            x: the vector.
            sh: (N, M, 3) R, G, B.
        """
        layout, device = self.layout, self.device
        self.zero(x)
        planar = sh.transpose(1, 2, 0)
        if planar.flags.c_contiguous and planar.dtype == np.float32:  # as a re-fit or a decoder leaves them
            cl.enqueue_copy(device.queue, x, planar, is_blocking=True, **self._as_columns(planar))
        else:
            turn = device.shared_kernel("raster/columns.cl", "columns")
            for first in range(0, layout.splats, _TURNED):
                rows = sh[first : first + _TURNED].reshape(-1, layout.columns)
                with Memory(device) as memory:
                    some = memory.upload(rows.astype(np.float32, copy=False), "the SH coefficients")
                    turn.bind(rows=some, first=first, width=layout.columns, stride=layout.stride, result=x)
                    turn.launch((len(rows),))
        self._to_ycocg.bind(columns=x, stride=layout.stride)
        layout.over_splats(self._to_ycocg)

    def read_sh(self, x: cl.Buffer) -> FloatArray:
        """(N, M, 3) float32, a vector in R, G, B; each coefficient contiguous in memory."""
        layout, device = self.layout, self.device
        sh = np.empty((layout.sh_count, 3, layout.splats), np.float32)
        with Memory(device) as memory:
            rgb = memory.allocate(4 * self._length, "the SH coefficients")
            self._to_rgb.bind(columns=x, stride=layout.stride, result=rgb)
            layout.over_splats(self._to_rgb)
            with device.errors("failed while computing"):
                cl.enqueue_copy(device.queue, sh, rgb, is_blocking=True, **self._as_columns(sh))
        return sh.transpose(2, 0, 1)

    def _as_columns(self, planar: FloatArray) -> dict[str, Any]:
        """How (M, 3, N) lie in a vector, as a copy takes it."""
        return {
            "buffer_origin": (0, 0, 0),
            "host_origin": (0, 0, 0),
            "region": (4 * self.layout.splats, self.layout.columns, 1),
            "buffer_pitches": (4 * self.layout.stride, 0),
            "host_pitches": (4 * self.layout.splats, 0),
        }

    def _columns_of(self, x: cl.Buffer) -> FloatArray:
        """(M, 3, stride)."""
        shape = (self.layout.sh_count, 3, self.layout.stride)
        columns: FloatArray = self.device.download(x, shape, np.float32)
        return columns

    # ------------------------------------------------------------------------------------------ which may change

    def keep_active(self, x: cl.Buffer) -> None:
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

    def save_flags(self) -> NDArray[np.uint32]:
        """The flags as they lie on the device, for :meth:`restore_flags`."""
        words: NDArray[np.uint32] = self.device.download(self.active, (2, self.layout.stride), np.uint32)
        return words

    def restore_flags(self, words: NDArray[np.uint32]) -> None:
        """Set the flags to what they were."""
        cl.enqueue_copy(self.device.queue, self.active, words, is_blocking=True)

    def close(self) -> None:
        """Give all device memory back, that of the vectors included."""
        self._memory.close()
