"""What lies on a device while splats are removed: which are left (:class:`Survivors`), prepared views
(:class:`PreparedSet`), and who numbers splats how (:class:`Ledger`).

A view's projection, tile lists and depth order do not depend on which splats are left: pruning only takes intersections
out.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.sweep import totals_limits
from potr_cl.raster.view_set import View, ViewSet
from potr_cl.views.subsets import Subset

Bits = NDArray[np.uint8]

#: Work-items of a work-group of the kernels that turn marks to bits and back; each has eight splats.
_GROUP = 64


class SplatState(IntEnum):
    """What a splat's byte in the device's memory says; the kernels know the names with SPLAT_ before them
    (cl/prune/removal.clh)."""

    REMOVED = 0
    ALIVE = 1
    #: Removed, but the tile lists still have it, and the tiles that lose it have not noted so.
    JUST_REMOVED = 2


class Survivors(Owner):
    """The state of each splat, on the device; the host has a copy, which :meth:`settle` brings up to date.

    Args:
        splats: N.
        stride: N padded; the buffer holds so many, and all are alive at first.
        wait: sees to it that what is enqueued from now on comes after all that was.

    Attributes:
        buffer: (stride,) uint8 in the device's memory, :class:`SplatState`.
    """

    def __init__(self, device: Device, splats: int, stride: int, wait: Callable[[], None]) -> None:
        self.device = device
        self._splats, self._wait, self._are_marked = splats, wait, False
        self._states = np.full(stride, SplatState.ALIVE, np.uint8)
        self._memory = Memory(device)
        self.buffer = self._memory.upload(self._states, "the splats that are left")

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        self.settle()
        alive: NDArray[np.bool_] = self._states[: self._splats] == SplatState.ALIVE
        return alive

    def mark(self, splats: Bits) -> None:
        """Mark splats as JUST_REMOVED, as a controller on the device does; :meth:`are_marked` follows.

        Args:
            splats: as :meth:`just_marked` gives them.
        """
        with Memory(self.device) as memory:
            bits = memory.upload(splats, "the splats that go")
            self._launch("mark_bits", bits)
            self.device.finish()  # before the memory is given back

    def just_marked(self) -> Bits:
        """(N / 8, rounded up) uint8: the splats that are JUST_REMOVED on the device, a bit each, the lowest first."""
        nbytes = -(-self._splats // 8)
        with Memory(self.device) as memory:
            bits = memory.allocate(nbytes, "the splats that go")
            self._launch("marked_bits", bits)
            return self.device.download(bits, (nbytes,), np.uint8)

    def _launch(self, name: str, bits: cl.Buffer) -> None:
        kernel = self.device.shared_kernel("prune/marks.cl", name)
        kernel.bind(states=self.buffer, splats=self._splats, bits=bits)
        kernel.launch((-(-self._splats // (8 * _GROUP)) * _GROUP,), (_GROUP,))

    def are_marked(self) -> None:
        """Note that splats have been marked, and that the host does not know which."""
        self._are_marked = True

    def settle(self) -> None:
        """Make host and device agree on the splats that are left; none is JUST_REMOVED afterwards."""
        if not self._are_marked:
            return
        self._are_marked = False
        self._wait()
        self._states = self.device.download(self.buffer, self._states.shape, np.uint8)
        self._states[self._states == SplatState.JUST_REMOVED] = SplatState.REMOVED
        self.device.copy(self.buffer, self._states)


class PreparedSet(Owner):
    """Views that are swept in one launch, and what is kept of them from sweep to sweep.

    Args:
        rasterizer: that prepared them.
        views: projection and lists, as they were prepared for the first time; this object's from now on.
        memory: to take the rest from, which is closed with this object; None: memory of its own.
        target: the pictures before any removal, which stay the caller's; None: memory for them.
        pending: as of :meth:`potr_cl.opencl.device.Device.upload`.
        picture: as the rasterizer draws it, (pixels, 3) float32, which the first sweep leaves there on CPUs; it stays
            the caller's.

    Attributes:
        lengths: (tiles,) uint32, intersections that a tile has left.
        sums: (intersections, 2) float32, ΔMSE and I of an intersection, summed over its tile's pixels.
        target: (pixels, 3) float32, the pictures before any removal.
        counts: (tiles,) float32, what removed pixels of a tile count for its staleness; on CPUs.
        first_tile: where the tiles begin among those of all resident views.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        views: ViewSet,
        memory: Memory | None = None,
        target: cl.Buffer | None = None,
        pending: list[cl.Event] | None = None,
        picture: cl.Buffer | None = None,
    ) -> None:
        self.picture = picture
        self._device = device = rasterizer.device
        self._memory = memory or Memory(device)
        self.views = views
        self.first_tile = 0
        try:
            lengths = np.concatenate([np.diff(offsets) for offsets in views.found_offsets])
            views.found_offsets = []
            self.lengths = self._memory.upload(lengths, "the tile lists", pending)
            self.sums = self._memory.allocate(8 * views.capacity, "the tiles' removal effects")
            if device.family == "cpu":
                self.counts = self._memory.allocate(4 * views.tiles, "what counts for the tiles' staleness")
            self.target = target or self._memory.allocate(12 * views.pixels, "the target images")
        except BaseException:
            self.close()
            raise
        self.zero_sums()

    @property
    def nbytes(self) -> int:
        """Bytes of what is kept besides projection and lists."""
        return self._memory.nbytes

    def zero_sums(self) -> None:
        """Enqueue that all sums become 0, as before the first sweep."""
        self._device.fill(self.sums, np.float32(0))

    def read_sums(self, place: int) -> tuple[View, NDArray[np.uint32], NDArray[np.float32]]:
        """What the last sweep left of one of the views.

        Returns:
            The view, the splat of each of its intersections, (intersections,) uint32, and their sums, (intersections,
            2) float32.
        """
        view, start = self.views.views[place], self.views.intersection_starts[place]
        intersections = np.empty(view.intersection_count, np.uint32)
        sums = np.empty((view.intersection_count, 2), np.float32)
        if view.intersection_count:
            self._device.copy(intersections, self.views.intersections, of=start * intersections.itemsize)
            self._device.copy(sums, self.sums, of=start * sums[0].nbytes)
        return view, intersections, sums

    def close(self) -> None:
        """Give the memory back, including that of the views."""
        self.views.close()
        self._memory.close()


_PARTS, _PARTS_GROUP = "prune/parts.cl", 64


class Ledger(Owner):
    """The scene's own marks and totals, or, for CPU kernels of some of the splats, some that are numbered as these.

    GPU kernels are told the splats' numbers in the scene; CPU kernels know places only.

    Args:
        survivors: the scene's marks.
        totals: (N, 2) int64 that the kernels add to, by the splats' numbers; None: nobody asks for what they add.
        subset: the splats of the views, n of N.

    Attributes:
        marks, totals: for the kernels: (N,) :class:`SplatState`, (N, 2) int64.
        numbers: for GPU kernels, (n,) uint32, the splats' numbers among those N; None: they are numbered as these.
        is_local: whether :meth:`add_to` has anything to do.
    """

    def __init__(self, survivors: Survivors, totals: cl.Buffer | None, subset: Subset) -> None:
        self._survivors, self._device, self._count = survivors, survivors.device, subset.count
        self._own_numbers = subset.numbers
        self._memory = Memory(self._device)
        self.is_local = subset.numbers is not None and (self._device.family == "cpu" or totals is None)
        self.marks, self.totals, self.numbers = survivors.buffer, totals, subset.numbers
        stride = subset.rasterizer.stride
        with self._device.all_or_nothing():
            if self.is_local:
                alive = np.full(stride, SplatState.ALIVE, np.uint8)
                self.marks, self.numbers = self._memory.upload(alive, "the splats that are left"), None
            if self.is_local or totals is None:
                self.totals = self._memory.allocate(16 * stride, "the removal effects")
                self._device.fill(self.totals, np.int64(0))

    def take_marks(self) -> None:
        """Enqueue that the marks are those of the scene."""
        if self.is_local:
            self._launch("mark_part", states=self._survivors.buffer, part=self.marks)

    def add_to(self, totals: cl.Buffer) -> None:
        """Enqueue that what the kernels have added is added to the scene's totals, (N, 2) int64."""
        if self.is_local:
            self._launch("add_part", totals=totals, part=self.totals)

    def _launch(self, name: str, **given: cl.Buffer) -> None:
        kernel = shared_kernel(self._device, name)
        kernel.bind(**given, numbers=self._own_numbers, count=self._count)
        kernel.launch((-(-self._count // _PARTS_GROUP) * _PARTS_GROUP,), (_PARTS_GROUP,))


def shared_kernel(device: Device, name: str) -> Kernel:
    """A kernel of cl/prune/parts.cl."""
    return device.shared_kernel(_PARTS, name, **totals_limits(device))
