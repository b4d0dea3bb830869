"""Vectors of a scene's SH coefficients, and which of these may change: :class:`Coefficients`."""

from __future__ import annotations

from concurrent.futures import Future
from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host import mapped
from potr_cl.host.threads import in_background
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.stages.refitting.layout import Layout, Ridge
from potr_cl.stages.refitting.sliced_arrays import DOT_ITEMS, Array, HostArray, SlicedArrays

_SOURCE = "refit/coefficients.cl"
#: Work-items of a work-group, and where they do nothing but load and store, of which there are many.
_GROUP, _MANY = 64, 256
#: Splats whose coefficients are uploaded at a time.
_TURNED = 1 << 18
#: Columns whose flags share a word.
_FLAGS = 24
#: The rank of vectors that are used rarely.
_RARELY = 100

#: (3 M, stride) float32.
Vector: TypeAlias = Array


class Coefficients(SlicedArrays):
    """The vectors of one scene's coefficients in Y, Co, Cg, and the flags of those that may change.

    Args:
        device: to compute on.
        layout: of the vectors.
        splats: of a slice; None: all, and all vectors lie on the device.
        resident: with slices, vectors of a lower rank than this lie on the device even so.

    Attributes:
        device, layout: as given.
        active: device buffer of the flags, (2, stride) uint32, a bit a coefficient; all are set at first.

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
    """

    def __init__(self, device: Device, layout: Layout, splats: int | None = None, resident: int = 0) -> None:
        super().__init__(device, layout, splats)
        self._resident = resident
        self._regularise, self._combine, self._dot_parts, self._to_ycocg, self._to_rgb = (
            device.shared_kernel(_SOURCE, name, **layout.macros)
            for name in ("regularise", "combine", "dot_parts", "to_ycocg", "to_rgb")
        )
        self._made: Future[FloatArray] | None = None
        #: Where vectors of the host lie on the device to be read, and which they are, as often changed.
        self._operands: dict[int, cl.Buffer] = {}
        self._held: dict[int, tuple[HostArray, int]] = {}
        try:
            self.active = self._memory.allocate(8 * layout.stride, "the active coefficients")
            self._parts = self._memory.allocate(12 * DOT_ITEMS, "a dot product")
            self.activate(None)
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------------------------------ vectors

    def vector(self, rank: int = _RARELY) -> Vector:
        """A new vector, not set; it is given back with the others by :meth:`close`.

        Args:
            rank: the lower, the more often it is used: where there is no room for all on the device, it comes first.
        """
        return self.array(self.layout.columns, "SH coefficients", on_device=rank < self._resident)

    def combine(self, a: float, y: Vector, b: float, x: Vector) -> None:
        """y = a y + b x."""
        for _, count, (one, other) in self.pieces(y, x, written=True):
            self._combine.bind(a=np.float32(a), y=one, b=np.float32(b), x=other).launch(
                (count,), (_GROUP if count % _MANY else _MANY,)
            )

    def dot(self, x: Vector, y: Vector) -> float:
        """x · y; waits for the device. Not finite where single precision overflows."""
        return self._dot(x, y)[0]

    def largest(self, x: Vector) -> float:
        """The largest |x_i|; waits for the device."""
        return self._dot(x, x)[1]

    def _dot(self, x: Vector, y: Vector) -> tuple[float, float]:
        for first, count, (one, other) in self.pieces(x, y):
            self._dot_parts.bind(x=one, y=other, count=count, more=first > 0, parts=self._parts)
            self._dot_parts.launch((DOT_ITEMS,), (_GROUP,))
        parts = self.device.download(self._parts, (2, DOT_ITEMS), np.float32)
        with np.errstate(invalid="ignore"):  # infinities of both signs: the callers look at the result
            return float(parts[0].sum(dtype=np.float64)), float(parts[1].max())

    def add_ridge(self, sums: Vector, x: Vector, ridge: Ridge) -> None:
        """sums += (lam on AC + prior) x on the active coefficients; the others' sums become 0."""
        for part in self.slices((sums, x, self.active), (sums,)):
            self._regularise.bind(
                sums=part[sums], coefficients=part[x], active=part[self.active], stride=part.stride, **ridge.scalars
            )
            part.run(self._regularise)

    def on_device(self, x: Vector, place: int = 0) -> cl.Buffer:
        """A vector in the device's memory, (3 M, stride) float32, to be read; valid until the next call for the place.

        Args:
            x: the vector. What is there already is not taken there again.
            place: 0 or 1: so many vectors can be there at a time.
        """
        if not isinstance(x, HostArray):
            return x
        # The direction is on the device itself: the other vector may have its place.
        place = 0 if self._resident else place
        if place not in self._operands:
            self._operands[place] = self._memory.allocate(4 * self.length, "the SH coefficients")
        if self._held.get(place) != (x, x.changes):
            self.copy(self._operands[place], x)
            self._held[place] = (x, x.changes)
        return self._operands[place]

    # ------------------------------------------------------------------------------------------ R, G, B on the host

    def write_sh(self, x: Vector, sh: FloatArray) -> None:
        """Set a vector.

        Args:
            x: the vector.
            sh: (N, M, 3) R, G, B; of fewer splats, the others' coefficients become 0.
        """
        planar = sh.transpose(1, 2, 0)
        # As a re-fit or a decoder leaves them.
        columns = planar.flags.c_contiguous and planar.dtype == np.float32
        for part in self.slices(written=(x,)):
            some = range(part.splats.start, min(part.splats.stop, len(sh)))
            self.zero(part[x])
            if some and columns:
                self.to_device(part[x], part.stride, planar.reshape(self.layout.columns, -1), some)
            elif some:
                self._turn(part[x], part.stride, sh[some.start : some.stop])
            self._to_ycocg.bind(columns=part[x], stride=part.stride)
            part.run(self._to_ycocg)

    def _turn(self, columns: cl.Buffer, stride: int, sh: FloatArray) -> None:
        """Rows of a scene to columns on the device."""
        device, width = self.device, self.layout.columns
        turn = device.shared_kernel("raster/columns.cl", "columns")
        with Memory(device) as memory:
            # Drivers may wait for all that a device does before they give memory back.
            some = memory.allocate(4 * width * min(len(sh), _TURNED), "the SH coefficients")
            for first in range(0, len(sh), _TURNED):
                rows = np.ascontiguousarray(sh[first : first + _TURNED], np.float32).reshape(-1, width)
                device.copy(some, rows)
                turn.bind(rows=some, first=first, width=width, stride=stride, result=columns).launch((len(rows),))

    def read_sh(self, x: Vector) -> FloatArray:
        """(N, M, 3) float32, a vector in R, G, B; each coefficient contiguous in memory, which may be a file's."""
        layout = self.layout
        made, self._made = self._made, None
        sh = self._room() if made is None else made.result()
        with Memory(self.device) as memory:
            rgb = memory.allocate(4 * layout.columns * self._splats, "the SH coefficients")
            for part in self.slices((x,)):
                self._to_rgb.bind(columns=part[x], stride=part.stride, result=rgb)
                part.run(self._to_rgb)
                some = range(part.splats.start, min(part.splats.stop, layout.splats))
                if some:
                    self.to_host(sh, some, rgb, part.stride)
        return sh.reshape(layout.sh_count, 3, layout.splats).transpose(2, 0, 1)

    def make_room(self) -> None:
        """Begin to take the host's memory for the next :meth:`read_sh`: that can take longer than to fill it."""
        if self.whole and self._made is None and not (self.device.info.kind == "cpu" or self.device.info.integrated):
            self._made = in_background(np.full, (self.layout.columns, self.layout.splats), np.float32(0))

    def _room(self) -> FloatArray:
        shape = (self.layout.columns, self.layout.splats)
        return np.empty(shape, np.float32) if self.whole else mapped.array(shape, np.float32, "SH coefficients")

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

    def save_flags(self) -> NDArray[np.uint32]:
        """The flags, (2, stride) words as the kernels have them, for :meth:`restore_flags`."""
        words: NDArray[np.uint32] = self.device.download(self.active, (2, self.layout.stride), np.uint32)
        return words

    def restore_flags(self, words: NDArray[np.uint32]) -> None:
        """Set the flags to what they were."""
        self.device.copy(self.active, words)

    def close(self) -> None:
        """Give all device memory back, that of the vectors included."""
        self._made, self._held, self._operands = None, {}, {}
        super().close()
