"""Removal effects and importances of all splats over all views (paper sections "Splat importance", "Effect of a
splat's removal").

A view's projection, tile lists and depth order are made once: pruning never changes them, it only takes entries out.
Each measurement is one sweep over the tiles of every view (cl/removal_*.cl), whose sums go to exact integer totals a
splat; a tile in which little has changed since its last sweep keeps its sums.

What does not fit the memory budget is made again when it is needed: first the projections, then whole views.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.cameras import Camera
from potr_cl.device import Device
from potr_cl.errors import UsageError
from potr_cl.rasterizer import TILE, Rasterizer, View, camera_struct
from potr_cl.scene import FloatArray

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Views that a GPU sweeps at a time.
_QUEUES = 16
#: Where the removal kernel's argument stands that has it store the target, behind the buffers of the lists.
_FIRST_TIME = 9
#: Below it transmittances lose digits in float32, and the sweep divides by them.
_LEAST_STOP = 1e-30
#: Part of the device's memory that the views may take unless the caller sets a budget. A CPU's is that of the host: the
#: scene, its new colours and everybody else live there too.
_SHARE, _SHARE_OF_HOST = 0.5, 0.3


def default_memory(device: Device) -> int:
    """Bytes that the views may take: half of the device's memory, three tenths where that is the host's."""
    of_host = device.info.kind == "cpu" or device.info.integrated
    return int(device.info.memory * (_SHARE_OF_HOST if of_host else _SHARE))


@dataclass(frozen=True)
class SweepOptions:
    """What a measurement may skip.

    Attributes:
        tolerance: a tile is swept again once the importance removed from it, as a part of its area, exceeds this.
            0: whenever anything was removed from it; negative: always.
        turns: a view is swept in every so many-th measurement only (all of them in the first). Views that do not fit
            the memory budget are swept in each.
        memory: bytes of device memory that the views may take; None: :func:`default_memory`.
        tighten: drop a tile's entries that reach alpha 1/255 in none of its pixels. Changes no result.
        stop: a pixel ends before its transmittance falls below this; None: where the rasterizer's rules end it. When a
            removal lets a pixel go on one splat longer, its colour jumps by up to the hundredfold of this.
        sample: part of the tiles to be swept that are, drawn at random; the others keep their sums until another time.
        sampled: measurements, after the first, in which only a sample is swept.
        seed: of the sample.

    Raises:
        UsageError: a value is out of range.
    """

    tolerance: float = 0.01
    turns: int = 1
    memory: int | None = None
    tighten: bool = False
    stop: float | None = 1e-8
    sample: float = 1.0
    sampled: int = 24
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.tolerance < np.inf:
            raise UsageError(f"the tile tolerance is {self.tolerance:g}, it must be a number")
        if self.turns < 1:
            raise UsageError(f"views cannot be swept every {self.turns} measurements: at least 1 is needed")
        if self.memory is not None and self.memory < 0:
            raise UsageError(f"a memory budget of {self.memory} bytes is less than nothing")
        if self.stop is not None and not _LEAST_STOP <= self.stop < 1:
            raise UsageError(
                f"a pixel cannot end at a transmittance of {self.stop:g}: at least {_LEAST_STOP:g}, below 1"
            )
        if not 0 < self.sample <= 1:
            raise UsageError(f"a sample of {self.sample:g} of the tiles: it must be above 0 and at most 1")
        if self.sampled < 0:
            raise UsageError(f"{self.sampled} sampled measurements are less than none")


@dataclass
class _Swept:
    """A view and what is kept of it from sweep to sweep.

    The kernels have all their arguments but the place of the tiles to sweep in the list of tiles.
    """

    view: View
    begins: cl.Buffer
    lengths: cl.Buffer
    sums: cl.Buffer
    target: cl.Buffer
    first_tile: int
    sweep: cl.Kernel = None
    staleness: cl.Kernel = None

    def free(self, device: Device) -> None:
        self.view.free()
        for buffer in (self.begins, self.lengths, self.sums, self.target):
            device.free(buffer)


class RemovalSweep:
    """Measures removal effects and importances while splats are taken out.

    Args:
        rasterizer: holds the uncompressed scene, its rules and its background.
        cameras: the views that count.
        options: what may be skipped.
        progress: called with the views prepared and their number.

    Attributes:
        sweeps: work done so far, as a multiple of sweeping every tile of every view once.
        kept_views: views whose lists fit the memory budget; the others are made again for every measurement.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        options: SweepOptions | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("removal effects need at least one view")
        self._rasterizer = rasterizer
        self._device = device = rasterizer.device
        self._options = options or SweepOptions()
        self._random = np.random.default_rng(self._options.seed)
        self._measured = 0
        self._original_sh: cl.Buffer | None = None
        self.sweeps = 0.0
        self._build()

        self.splats = rasterizer.splats
        self._alive = np.ones(rasterizer.stride, np.uint8)
        self._alive_buffer = device.upload(self._alive, "the splats that are left")
        # Views of different sizes count the same: each is scaled to the size of the largest.
        self._cameras = list(cameras)
        self._views = len(cameras)
        self._pixels = max(c.width * c.height for c in cameras)
        # Fixed point: an effect of 16 a pixel and channel in every tile of every view still fits 62 bits.
        area = max((c.width + TILE - 1) * (c.height + TILE - 1) for c in cameras)
        self._scale = 2.0 ** np.floor(60 - np.log2(12.0 * area * self._views))
        self._bound = 48.0 * TILE * TILE
        self._totals = self._zero_totals()

        memory = self._options.memory
        self._budget = default_memory(device) if memory is None else memory
        self._queues = [device.queue]
        self._kept: dict[int, _Swept] = {}  # by the number of the view
        self._shared: tuple[cl.Buffer, cl.Buffer] | None = None
        self._tile_count = 0
        kept_tiles, most = 0, 1
        for number, camera in enumerate(cameras):
            swept = self._prepare(camera, kept_tiles)
            most = max(most, swept.view.tiles)
            self._tile_count += swept.view.tiles
            if self._keep(number, swept):
                kept_tiles += swept.view.tiles
            if progress is not None:
                progress(number + 1, len(cameras))
        # The kept views' tiles are numbered through: importance removed from each since its last sweep.
        self._stale = np.full(kept_tiles, np.inf, np.float32)
        self._stale_buffer = device.allocate(4 * kept_tiles, "the tiles' staleness")
        self._tiles = device.allocate(4 * max(kept_tiles, most), "the tiles to sweep")
        for swept in self._kept.values():
            self._bind(swept, True, self._totals)
        if device.family == "gpu" and not self._shared:
            # A view's longest tile list keeps one work-group busy when all others are done: other views fill the gap.
            self._queues = [
                cl.CommandQueue(device.context, device.info.handle, device.queue.properties) for _ in range(_QUEUES)
            ]

    @property
    def kept_views(self) -> int:
        return len(self._kept)

    def _build(self) -> None:
        device, rules = self._device, self._rasterizer.rules
        stop = rules.stop if self._options.stop is None else self._options.stop
        limits: dict[str, float | int] = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "STOP": stop,
            "TIGHTEN": int(self._options.tighten),
        }
        if device.family == "gpu":
            limits["NATIVE_EXP2"] = int(device.native_exp2)
        else:
            limits["LANES"] = max(device.vector_width, 8)
        self._limits = limits
        self._source = f"removal_{device.family}.cl"
        self._group = 64 if device.family == "gpu" else 1

    def _zero_totals(self) -> cl.Buffer:
        return self._device.upload(np.zeros((self._rasterizer.stride, 4), np.uint32), "the removal effects")

    def _prepare(self, camera: Camera, first_tile: int = 0) -> _Swept:
        device = self._device
        view = self._rasterizer.prepare(camera)
        offsets = device.download(view.offsets, (view.tiles + 1,), np.uint32)
        return _Swept(
            view=view,
            begins=device.upload(offsets[:-1], "the tile lists"),
            lengths=device.upload(np.diff(offsets), "the tile lists"),
            sums=device.upload(np.zeros((view.entry_count, 2), np.float32), "the tiles' removal effects"),
            target=device.allocate(12 * camera.width * camera.height, "the target image"),
            first_tile=first_tile,
        )

    def _keep(self, number: int, swept: _Swept) -> bool:
        """Keep a prepared view as far as the budget allows; whether it does."""
        view = swept.view
        geometry = 48 * self._rasterizer.stride
        an_entry = 8 + 4 * len(view.lists)
        lists = an_entry * view.entry_count + 12 * view.tiles + 12 * view.camera.width * view.camera.height
        # The first view stands for the others: geometry is kept for all of them or for none.
        if number == 0 and self._views * (lists + geometry) > self._budget:
            self._shared = (
                self._device.allocate(32 * self._rasterizer.stride, "the projected splats"),
                self._device.allocate(16 * self._rasterizer.stride, "the projected splats' colours"),
            )
        self._budget -= lists + (0 if self._shared else geometry)
        if self._budget < 0:
            self._budget = 0
            swept.free(self._device)
            return False
        if self._shared:
            view.free_geometry()
        self._kept[number] = swept
        return True

    def _bind(self, swept: _Swept, first: bool, totals: cl.Buffer) -> None:
        """Kernels of its own for a view: setting their arguments takes longer than launching them."""
        device, view = self._device, swept.view
        shapes, colours = self._shared if view.shapes is None and self._shared else (view.shapes, view.colours)
        weight = self._pixels / (view.camera.width * view.camera.height)
        lists = (swept.begins, swept.lengths, *view.lists)
        swept.sweep = device.kernel(self._source, "removal", **self._limits)
        swept.sweep.set_args(
            np.uint32(0),
            self._tiles,
            shapes,
            colours,
            self._alive_buffer,
            *lists,
            camera_struct(view.camera),
            *(np.float32(channel) for channel in self._rasterizer.background),
            np.int32(first),
            np.float32(self._scale * weight),
            np.float32(self._bound / weight),
            swept.target,
            swept.sums,
            totals,
        )
        swept.staleness = device.kernel(self._source, "staleness", **self._limits)
        swept.staleness.set_args(
            self._alive_buffer, *lists[:3], swept.sums, np.uint32(swept.first_tile), self._stale_buffer
        )

    def _sweep(self, swept: _Swept, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        """Sweep ``count`` of a view's tiles, listed in the tile buffer from ``start`` on."""
        if swept.view.shapes is None:
            assert self._shared is not None
            self._rasterizer.project(swept.view.camera, *self._shared)
        swept.sweep.set_arg(0, np.uint32(start))
        self._device.launch(swept.sweep, (count * self._group,), (self._group,), queue)
        self.sweeps += count / self._tile_count

    def _list_tiles(self, tiles: NDArray[np.int64]) -> None:
        if len(tiles):
            cl.enqueue_copy(self._device.queue, self._tiles, tiles.astype(np.uint32), is_blocking=True)

    def _sweep_stale(self, tolerance: float, turns: int = 1, sample: float = 1) -> None:
        """Sweep the kept views' tiles that have lost more than ``tolerance``, of every so many-th view only, and of
        those only a random part."""
        wanted = self._stale > tolerance
        firsts = np.array([swept.first_tile for swept in self._kept.values()] + [len(wanted)], np.int64)
        for number, (start, stop) in zip(self._kept, itertools.pairwise(firsts), strict=True):
            if (self._measured + number) % turns:
                wanted[start:stop] = False
        if sample < 1:
            wanted &= self._random.random(len(wanted)) < sample
        numbers = np.flatnonzero(wanted)
        bounds = np.searchsorted(numbers, firsts)
        self._list_tiles(numbers - np.repeat(firsts[:-1], np.diff(bounds)))
        self._device.queue.finish()
        queues = itertools.cycle(self._queues)
        for swept, (start, stop) in zip(self._kept.values(), itertools.pairwise(bounds), strict=True):
            if stop > start:
                self._sweep(swept, int(start), int(stop - start), next(queues))
        for queue in self._queues:
            queue.finish()
        self._stale[numbers] = 0 if self._options.tolerance >= 0 else np.inf

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; of removed splats they mean nothing.

        ΔMSE is the change of the mean squared error over all views, pixels and channels against the uncompressed
        scene's renders if that splat alone went; I the mean over views and pixels of T α.
        """
        options = self._options
        sampled = 0 < self._measured <= options.sampled
        self._sweep_stale(options.tolerance, options.turns if self._measured else 1, options.sample if sampled else 1)
        if self._measured == 0:
            for swept in self._kept.values():
                swept.sweep.set_arg(_FIRST_TIME + 2 + len(swept.view.lists), np.int32(0))
        words = self._device.download(self._totals, (self.splats, 2), np.int64)
        if len(self._kept) < self._views:
            words += self._measure_transient()
        self._measured += 1
        values = words / (self._scale * self._pixels * self._views)
        return values[:, 0] / 3, values[:, 1]

    def _measure_transient(self) -> NDArray[np.int64]:
        """The views that nothing is kept of: lists, target and sums anew."""
        device = self._device
        totals, unused = self._zero_totals(), self._zero_totals()
        everything = np.ones_like(self._alive)
        for number, camera in enumerate(self._cameras):
            if number in self._kept:
                continue
            swept = self._prepare(camera)
            view = swept.view
            self._list_tiles(np.arange(view.tiles))
            if self._measured:
                cl.enqueue_copy(device.queue, self._alive_buffer, everything, is_blocking=True)
                if self._original_sh is not None:
                    self._rasterizer.project(camera, view.shapes, view.colours, self._original_sh)
                self._bind(swept, True, unused)
                self._sweep(swept, 0, view.tiles)
                if self._original_sh is not None:
                    self._rasterizer.project(camera, view.shapes, view.colours)
                cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)
                device.free(swept.sums)
                swept.sums = device.upload(np.zeros((view.entry_count, 2), np.float32), "the removal effects")
            self._bind(swept, self._measured == 0, totals)
            self._sweep(swept, 0, view.tiles)
            device.queue.finish()
            swept.free(device)
        words = device.download(totals, (self.splats, 2), np.int64)
        device.free(totals)
        device.free(unused)
        return words

    def remove(self, splats: Indices) -> None:
        """Take splats out of all lists; note how much each tile loses."""
        device = self._device
        self._alive[splats] = 2  # just gone
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)
        for swept in self._kept.values():
            device.launch(swept.staleness, (swept.view.tiles * self._group,), (self._group,))
        self._stale += device.download(self._stale_buffer, self._stale.shape, np.float32)
        self._alive[splats] = 0
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours: (N, M, 3) float32 of the same degree. The targets stay as they are."""
        former = self._rasterizer.replace_sh(sh)
        if self._original_sh is None:
            self._original_sh = former
        else:
            self._device.free(former)
        for swept in self._kept.values():
            if swept.view.shapes is not None:
                self._rasterizer.project(swept.view.camera, swept.view.shapes, swept.view.colours)
        self.sweep_everything()

    def view_importances(self) -> Iterator[tuple[int, Indices, F64]]:
        """I_k(s) of the splats that are left, view by view.

        Yields:
            The number of the view among the cameras, the splats that it sees, ascending, and the mean of T α of each
            over the view's pixels.

        Raises:
            UsageError: nothing has been measured yet.
        """
        if not self._measured:
            raise UsageError("importances are known after a measurement")
        self._sweep_stale(0)
        for number, camera in enumerate(self._cameras):
            kept = self._kept.get(number)
            swept = kept or self._prepare(camera)
            if kept is None:
                unused = self._zero_totals()
                self._list_tiles(np.arange(swept.view.tiles))
                self._bind(swept, True, unused)
                self._sweep(swept, 0, swept.view.tiles)
            view = swept.view
            entries = self._device.download(view.entries, (view.entry_count,), np.uint32)
            sums = self._device.download(swept.sums, (view.entry_count, 2), np.float32)
            if kept is None:
                self._device.free(unused)
                swept.free(self._device)
            weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
            total = np.bincount(entries, weights=weights, minlength=self.splats)[: self.splats]
            splats = np.flatnonzero((total > 0) & (self._alive[: self.splats] == 1))
            yield number, splats, total[splats] / (camera.width * camera.height)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._stale[:] = np.inf

    def free(self) -> None:
        """Give all device memory back."""
        for swept in self._kept.values():
            swept.free(self._device)
        self._kept = {}
        for buffer in (self._alive_buffer, self._totals, self._tiles, self._stale_buffer, *(self._shared or ())):
            self._device.free(buffer)
        if self._original_sh is not None:
            self._device.free(self._original_sh)
