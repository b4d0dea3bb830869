"""Vectors of SH coefficients in the device's memory: :class:`Coefficients`."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host.threads import in_background
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.stages.refitting.vector_space import RARELY, Layout, Ridge, VectorSpace

_SOURCE = "refit/coefficients.cl"
#: Work-items that share a dot product.
DOT_ITEMS = 16384
#: Work-items of a work-group, and where they do nothing but load and store, of which there are many.
_GROUP, _MANY = 64, 256
#: Splats whose coefficients are uploaded at a time.
_TURNED = 1 << 18


class Coefficients(VectorSpace):
    """A :class:`potr_cl.stages.refitting.vector_space.VectorSpace` whose vectors are device buffers.

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
        super().__init__(device, layout)
        self._regularise, self._combine, self._dot_parts, self._to_ycocg, self._to_rgb = (
            device.shared_kernel(_SOURCE, name, **layout.macros)
            for name in ("regularise", "combine", "dot_parts", "to_ycocg", "to_rgb")
        )
        self._from_fixed = device.shared_kernel(
            "refit/gather.cl", "from_fixed", WEIGHTS=0, SOME_BLOCKS=0, **layout.macros
        )
        self._made: Future[FloatArray] | None = None
        self._memory = Memory(device)
        try:
            self.active = self._memory.allocate(8 * layout.stride, "the active coefficients")
            self._parts = self._memory.allocate(12 * DOT_ITEMS, "a dot product")
            self.activate(None)
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------------------ vectors

    def vector(self, rank: int = RARELY) -> cl.Buffer:
        """See :meth:`VectorSpace.vector`."""
        return self._memory.allocate(4 * self.length, "the SH coefficients")

    def zero(self, x: cl.Buffer) -> None:
        """x = 0."""
        self.clear(x)

    def copy(self, y: cl.Buffer, x: cl.Buffer) -> None:
        """y = x."""
        cl.enqueue_copy(self.device.queue, y, x, byte_count=4 * self.length)

    def combine(self, a: float, y: cl.Buffer, b: float, x: cl.Buffer) -> None:
        """y = a y + b x."""
        self.combine_some(a, y, b, x, self.length)

    def combine_some(self, a: float, y: cl.Buffer, b: float, x: cl.Buffer, count: int) -> None:
        """The same of the first ``count`` values of two buffers, a multiple of 64."""
        self._combine.bind(a=np.float32(a), y=y, b=np.float32(b), x=x).launch(
            (count,), (_GROUP if count % _MANY else _MANY,)
        )  # fmt: skip

    def dot(self, x: cl.Buffer, y: cl.Buffer) -> float:
        """x · y; waits for the device. Not finite where single precision overflows."""
        self.begin_dot(x, y, self.length)
        return self.found_dot()[0]

    def largest(self, x: cl.Buffer) -> float:
        """The largest |x_i|; waits for the device."""
        self.begin_dot(x, x, self.length)
        return self.found_dot()[1]

    def begin_dot(self, x: cl.Buffer, y: cl.Buffer, count: int, more: bool = False) -> None:
        """Enqueue the dot product of the first ``count`` values of two buffers.

        Args:
            x, y: the buffers.
            count: of the values.
            more: these are the next ones of longer vectors, whose pieces before, each a multiple of :data:`DOT_ITEMS`,
                it was called with last.
        """
        self._dot_parts.bind(x=x, y=y, count=count, more=more, parts=self._parts).launch((DOT_ITEMS,), (_GROUP,))

    def found_dot(self) -> tuple[float, float]:
        """The dot product of what :meth:`begin_dot` was called with, and the largest |x_i|; waits for the device."""
        parts = self.device.download(self._parts, (2, DOT_ITEMS), np.float32)
        with np.errstate(invalid="ignore"):  # infinities of both signs: the callers look at the result
            return float(parts[0].sum(dtype=np.float64)), float(parts[1].max())

    def add_fixed(self, x: cl.Buffer, sums: cl.Buffer, unit: float, constant: bool = False) -> None:
        """See :meth:`VectorSpace.add_fixed`."""
        # The constant coefficients' columns come first.
        self.add_fixed_some(x, sums, 0, 3 * self.layout.stride if constant else self.length, unit)

    def add_fixed_some(self, result: cl.Buffer, sums: cl.Buffer, first: int, count: int, unit: float) -> None:
        """Enqueue: float32 values += unit times as many integers from number ``first`` on, which become 0."""
        self._from_fixed.bind(sums=sums, first=first, unit=np.float32(unit), result=result).launch((count,))

    def on_device(self, x: cl.Buffer, place: int = 0) -> cl.Buffer:
        """The vector itself."""
        return x

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
            sh: (N, M, 3) R, G, B; of fewer splats, the others' coefficients become 0.
        """
        layout, device = self.layout, self.device
        self.zero(x)
        planar = sh.transpose(1, 2, 0)
        # As a re-fit or a decoder leaves them.
        if planar.flags.c_contiguous and planar.dtype == np.float32 and len(sh) == layout.splats:
            cl.enqueue_copy(device.queue, x, planar, is_blocking=True, **self._as_columns(planar))
        else:
            turn = device.shared_kernel("raster/columns.cl", "columns")
            with Memory(device) as memory:
                # Drivers may wait for all that a device does before they give memory back.
                some = memory.allocate(4 * layout.columns * min(len(sh), _TURNED), "the SH coefficients")
                for first in range(0, len(sh), _TURNED):
                    rows = np.ascontiguousarray(sh[first : first + _TURNED], np.float32).reshape(-1, layout.columns)
                    with device.errors("cannot hold the SH coefficients"):
                        cl.enqueue_copy(device.queue, some, rows, is_blocking=True)
                    turn.bind(rows=some, first=first, width=layout.columns, stride=layout.stride, result=x)
                    turn.launch((len(rows),))
        self._to_ycocg.bind(columns=x, stride=layout.stride)
        layout.over_splats(self._to_ycocg)

    def read_sh(self, x: cl.Buffer) -> FloatArray:
        """(N, M, 3) float32, a vector in R, G, B; each coefficient contiguous in memory."""
        layout, device = self.layout, self.device
        made, self._made = self._made, None
        sh = np.empty((layout.sh_count, 3, layout.splats), np.float32) if made is None else made.result()
        with Memory(device) as memory:
            rgb = memory.allocate(4 * self.length, "the SH coefficients")
            self.to_rgb(x, rgb)
            with device.errors("failed while computing"):
                cl.enqueue_copy(device.queue, sh, rgb, is_blocking=True, **self._as_columns(sh))
        return sh.transpose(2, 0, 1)

    def make_room(self) -> None:
        """See :meth:`VectorSpace.make_room`."""
        if self._made is None and not (self.device.info.kind == "cpu" or self.device.info.integrated):
            self._made = in_background(np.full, (self.layout.sh_count, 3, self.layout.splats), np.float32(0))

    def to_rgb(self, x: cl.Buffer, result: cl.Buffer) -> None:
        """Enqueue: result = x in R, G, B."""
        self._to_rgb.bind(columns=x, stride=self.layout.stride, result=result)
        self.layout.over_splats(self._to_rgb)

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

    def save_flags(self) -> NDArray[np.uint32]:
        """The flags as they lie on the device, for :meth:`restore_flags`."""
        words: NDArray[np.uint32] = self.device.download(self.active, (2, self.layout.stride), np.uint32)
        return words

    def restore_flags(self, words: NDArray[np.uint32]) -> None:
        """Set the flags to what they were."""
        cl.enqueue_copy(self.device.queue, self.active, words, is_blocking=True)

    def close(self) -> None:
        """Give all device memory back, that of the vectors included."""
        self._made = None
        self._memory.close()
