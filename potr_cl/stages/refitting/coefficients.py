"""Vectors of a scene's SH coefficients, and which of these may change: :class:`Coefficients`; where they lie:
:func:`residency_of`.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host import mapped
from potr_cl.host.threads import in_background
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.stages.refitting.sliced_arrays import DOT_ITEMS, Array, HostArray, Layout, Ridge, SlicedArrays
from potr_cl.views.reached import Reach

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
        with device.all_or_nothing():
            self.active = self._memory.allocate(8 * layout.stride, "the active coefficients")
            self._parts = self._memory.allocate(12 * DOT_ITEMS, "a dot product")
            self.activate(None)

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


#: Vectors of a solution: six of the solver and what it was before it was rounded.
_VECTORS = 7
#: Vectors that lie on the device in any case, and at most: beyond, the blocks are most of what travels.
_FEWEST, _MOST = 1, 6
#: With the sums they take no more than this part of a GPU's memory: to take one there again and again costs more than
#: to prepare views that it leaves no room for; and of the host's, where a CPU computes: there it is the other way.
_OF_VECTORS, _OF_HOST = 0.8, 0.5
#: What a sweep has besides for each splat: geometry, the splats of a view as they are projected, and its sums.
_SWEEP = 68 + 32 + 16 + 16 + 32 + 8 + 8
#: The vectors lie on the device if they take no more than this part of what is free, or of the memory that is given.
_OF_FREE, _OF_GIVEN = 0.75, 0.5
#: Of less nobody needs to be careful.
_ANYWAY = 256e6
#: Of the memory, what a slice may take, and the integers of blocks that are on the device at a time.
_SLICE, _BLOCKS = 1 / 32, 1 / 5
_LEAST_SLICE, _MOST_SLICE = 1 << 14, 1 << 18
#: For the blocks, all views are looked at so many times at most.
_MOST_RANGES = 8
#: Where views have splats of their own: what lies on the device of each splat; what those take of which a launch has as
#: many as a view at most; and, of the memory, what is left for views in any case.
_LYING, _LAUNCHED, _LEAST_VIEWS = 76, 160, 1 / 20
#: With the coefficients on the device too, which have this rank, no other place is needed to look at views with them.
_COEFFICIENTS = 3


@dataclass(frozen=True)
class Residency:
    """How a re-fit does with the device's memory.

    Attributes:
        views: bytes that prepared views and targets may take; None: a part of what is free.
        slice: splats whose coefficients go through the device together; None: all, and vectors and blocks lie there.
        blocks: splats whose blocks are added up together.
        resident: with slices, vectors that lie on the device even so.
    """

    views: int | None
    slice: int | None = None
    blocks: int | None = None
    resident: int = 0


def in_one_piece(splats: int, sh_count: int) -> int:
    """Bytes of a re-fit's vectors, sums and blocks where all of them lie on the device."""
    vector, triangle = 12 * sh_count, sh_count * (sh_count + 1) // 2
    return splats * (_VECTORS * vector + 2 * vector + 12 * triangle)


def fits_in_one_piece(nbytes: float, free: float, memory: int | None) -> bool:
    """Whether so many bytes are to lie on a device of which so many are free.

    Args:
        memory: bytes of it that the user would have taken; None: as much as there is.
    """
    return nbytes <= max(_OF_FREE * free if memory is None else min(_OF_GIVEN * memory, _OF_FREE * free), _ANYWAY)


def residency_of(
    device: Device,
    splats: int,
    sh_count: int,
    memory: int | None,
    slices: int | None = None,
    reach: Reach | None = None,
    shared: bool = False,
) -> Residency:
    """Where a re-fit's vectors lie.

    A splat takes about 3,400 bytes in one piece at SH degree 3: seven vectors of 48 values, the sums over views, the
    blocks of the normal equations and what they are added up in. With the blocks and all vectors but one on the host it
    takes about 950: the direction that views are looked along, a place for the other vectors that they are looked at
    with, and the sums. Further vectors stay on the device as far as there is room, those that are used most often
    first.

    Args:
        device: to compute on.
        splats: N.
        sh_count: M, coefficients of a channel.
        memory: bytes of the device's memory that the user would have taken; None: as much as there is.
        slices: splats of a slice, if the vectors are to lie on the host in any case.
        reach: of the views, if each has splats of its own.
        shared: whether other devices do some of the views: packed coefficients and sums of theirs take three vectors.
    """
    vector, triangle = 12 * sh_count, sh_count * (sh_count + 1) // 2
    one_piece, free = in_one_piece(splats, sh_count), max(device.info.memory - device.allocated, 0)
    if slices is None and fits_in_one_piece(one_piece, free, memory):
        return Residency(memory if memory is None or one_piece <= _ANYWAY else max(memory - one_piece, 0))
    total = free if memory is None else min(memory, free)
    of_slice = 2 * vector + 4 * triangle + 8
    some = slices or min(max(int(_SLICE * total / of_slice), _LEAST_SLICE), _MOST_SLICE)
    # To look at views with splats of their own once more is cheap.
    of_blocks = _BLOCKS if reach is None else _BLOCKS / 2
    blocks = slices or max(int(of_blocks * total / (8 * triangle)), -(-splats // _MOST_RANGES))
    # A place for a vector that views are looked at with, the sums, and some vectors.
    of_host = device.info.kind == "cpu" or device.info.integrated
    if slices is None and reach is not None:
        own = splats * ((5 if shared else 2) * vector + _LYING) + _LAUNCHED * reach.most + reach.total
        left = total - own - some * of_slice - 8 * triangle * min(blocks, splats)
        share = _OF_HOST * total - own if of_host else left - _LEAST_VIEWS * total
        resident = min(int(max(share, 0) / max(splats * vector, 1)), _MOST)
        others = 0
        if resident <= _COEFFICIENTS:
            resident, others = max(resident - 1, _FEWEST), 1
        return Residency(max(int(left - (resident + others) * splats * vector), 0), some, blocks, resident)
    room = int(((_OF_HOST if of_host else _OF_VECTORS) * total / max(splats, 1) - _SWEEP) / vector) - 3
    if shared:
        room -= 3
    besides = splats * ((6 if shared else 3) * vector + _SWEEP) + some * of_slice + 8 * triangle * min(blocks, splats)
    # Of few splats a slice, which has so many at least, takes more than its share.
    room = min(room, int((total - besides) / max(splats * vector, 1)))
    resident = min(max(room, _FEWEST), _MOST) if slices is None else _FEWEST
    return Residency(max(int(total - besides - splats * resident * vector), 0), some, blocks, resident)
