"""Removal effects and importances of all splats over all views (paper sections "Splat importance", "Effect of a
splat's removal").

A view's projection, tile lists and depth order are made once: pruning never changes them, it only takes intersections
out. Each measurement is one sweep over the tiles of every view (cl/prune/removal_*.cl), whose sums go to exact integer
totals a splat; a tile in which little has changed since its last sweep keeps its sums.

What does not fit the memory budget is made again when it is needed: first the projections, then whole views.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.raster.rasterizer import TILE, Rasterizer, ViewSet, camera_struct, gpu_limits, totals_limits
from potr_cl.raster.view_cache import ViewCache

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Views that a GPU does in one launch.
_MOST_VIEWS = 32
#: Launches that a GPU runs at a time.
_QUEUES = 4
#: Where the removal kernels' argument stands that has them store the target.
_FIRST_TIME = {"cpu": 13, "gpu": 14}
#: Where the tolerance stands among the arguments of the GPU kernel that follows a removal.
_TOLERANCE = 10
#: Work-items of a work-group, of the sweep and of what follows a removal.
_SWEEP_GROUP = {"cpu": 1, "gpu": 128}
_STALENESS_GROUP = {"cpu": 1, "gpu": 128}
#: Below it transmittances lose digits in float32, and the sweep divides by them.
_LEAST_THRESHOLD = 1e-30
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
        tighten: drop a tile's intersections that reach alpha 1/255 in none of its pixels. Changes no result.
        transmittance_threshold: a pixel ends before its transmittance falls below this; None: where the rasterizer's
            rules end it. When a removal lets a pixel go on one splat longer, its colour jumps by up to the hundredfold
            of this.
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
    transmittance_threshold: float | None = 1e-8
    sample: float = 1.0
    sampled: int = 24
    seed: int = 0

    def __post_init__(self) -> None:
        if not np.isfinite(self.tolerance):
            raise UsageError(f"the tile tolerance is {self.tolerance:g}, it must be a number")
        if self.turns < 1:
            raise UsageError(f"views cannot be swept every {self.turns} measurements: at least 1 is needed")
        if self.memory is not None and self.memory < 0:
            raise UsageError(f"a memory budget of {self.memory} bytes is less than nothing")
        if self.transmittance_threshold is not None and not _LEAST_THRESHOLD <= self.transmittance_threshold < 1:
            raise UsageError(
                f"a pixel cannot end at a transmittance of {self.transmittance_threshold:g}: at least "
                f"{_LEAST_THRESHOLD:g}, below 1"
            )
        if not 0 < self.sample <= 1:
            raise UsageError(f"a sample of {self.sample:g} of the tiles: it must be above 0 and at most 1")
        if self.sampled < 0:
            raise UsageError(f"{self.sampled} sampled measurements are less than none")


@dataclass
class _Swept:
    """Views that are swept in one launch, and what is kept of them from sweep to sweep.

    Attributes:
        number: of the first view among the cameras; the others follow it.
        views: their lists.
        lengths: (tiles,) uint32, intersections that a tile has left.
        sums: (intersections, 2) float32, see cl/prune/removal_cpu.cl.
        target: (pixels, 3) float32.
        first_tile: where their tiles begin among those of all views that are kept.
        sweep, staleness: kernels with all their arguments but the place of the tiles to sweep in the list of tiles.
    """

    number: int
    views: ViewSet
    lengths: cl.Buffer
    sums: cl.Buffer
    target: cl.Buffer
    first_tile: int
    sweep: cl.Kernel = None
    staleness: cl.Kernel = None

    @property
    def numbers(self) -> range:
        """Of the views among the cameras."""
        return range(self.number, self.number + len(self.views.views))

    def free(self, device: Device) -> None:
        self.views.free()
        for buffer in (self.lengths, self.sums, self.target):
            device.free(buffer)


class RemovalSweep(Owner):
    """Measures removal effects and importances while splats are taken out.

    Args:
        rasterizer: holds the uncompressed scene, its rules and its background.
        cameras: the views that count.
        options: what may be skipped.
        progress: called with the views prepared and their number.

    Attributes:
        sweeps: work done so far, as a multiple of sweeping every tile of every view once.
        cached_views: views whose lists fit the memory budget; the others are made again for every measurement.

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
        self._unsettled = False  # whether a removal is under way
        self._marked = False  # whether splats were removed that the host has not been told of
        self._listed: list[int] | None = None  # tiles of each set that the device has listed to be swept
        self._listed_above = np.inf  # staleness of which it lists them
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
        self._cache = ViewCache(rasterizer, default_memory(device) if memory is None else memory)
        self._queues = [device.queue]
        self._kept: list[_Swept] = []
        self._remade: list[range] = []  # numbers of the views that nothing is kept of, as many as are made at a time
        self._prepare_all(progress)
        # The kept views' tiles are numbered through: importance removed from each since its last sweep.
        self._kept_tiles = sum(swept.views.tiles for swept in self._kept)
        self._tile_count = sum(-(-c.width // TILE) * -(-c.height // TILE) for c in cameras)
        self._stale = device.upload(np.full(self._kept_tiles, np.inf, np.float32), "the tiles' staleness")
        self._unused_stale = device.allocate(4 * self._tile_count if self._remade else 0, "the tiles' staleness")
        self._tiles = device.allocate(4 * self._tile_count, "the tiles to sweep")
        self._listed_buffer = device.allocate(4 * len(self._kept), "the numbers of tiles to sweep")
        for place, swept in enumerate(self._kept):
            self._bind(swept, True, self._totals, place)
        if device.family == "gpu" and device.several_queues and not self._cache.shared:
            # A set's longest tile list keeps one work-group busy when all others are done: other sets fill the gap.
            self._queues = [
                cl.CommandQueue(device.context, device.info.handle, device.queue.properties) for _ in range(_QUEUES)
            ]

    @property
    def cached_views(self) -> int:
        return sum(len(swept.views.views) for swept in self._kept)

    def _build(self) -> None:
        device, rules = self._device, self._rasterizer.rules
        stop = (
            rules.transmittance_threshold
            if self._options.transmittance_threshold is None
            else self._options.transmittance_threshold
        )
        limits: dict[str, float | int] = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": stop,
            "TIGHTEN": int(self._options.tighten),
        }
        if device.family == "gpu":
            limits |= gpu_limits(device)
        else:
            limits |= {"LANES": max(device.vector_width, 8)} | totals_limits(device)
        self._limits = limits
        self._source = f"prune/removal_{device.family}.cl"

    def _zero_totals(self) -> cl.Buffer:
        return self._device.upload(np.zeros((self._rasterizer.stride, 4), np.uint32), "the removal effects")

    def _prepare_all(self, progress: Callable[[int, int], None] | None) -> None:
        """Prepare every view, and keep as many as the budget allows."""
        most = 1 if self._device.family == "cpu" else self._cache.most_views(_MOST_VIEWS, 12 * self._pixels)
        first_tile = number = 0
        while number < self._views:
            try:
                swept = self._prepare(range(number, min(number + most, self._views)), first_tile)
            except DeviceMemoryError:
                if most == 1:
                    raise
                most //= 2
                continue
            if self._keep(swept):
                first_tile += swept.views.tiles
            number += len(swept.numbers)
            if progress is not None:
                progress(number, self._views)

    def _prepare(self, numbers: range, first_tile: int = 0) -> _Swept:
        """Prepare the views of these numbers.

        Raises:
            DeviceMemoryError: they do not fit the device, or not all in buffers of the size that it allows.
        """
        device = self._device
        views = self._rasterizer.prepare_set([self._cameras[number] for number in numbers])
        try:
            lengths = np.concatenate([np.diff(offsets) for offsets in views.read_offsets()])
            with device.all_or_nothing():
                swept = _Swept(
                    number=numbers[0],
                    views=views,
                    lengths=device.upload(lengths, "the tile lists"),
                    sums=device.allocate(8 * views.capacity, "the tiles' removal effects"),
                    target=device.allocate(12 * views.pixels, "the target images"),
                    first_tile=first_tile,
                )
        except BaseException:
            views.free()
            raise
        self._zero_sums(swept)
        return swept

    def _zero_sums(self, swept: _Swept) -> None:
        cl.enqueue_fill_buffer(self._device.queue, swept.sums, np.float32(0), 0, swept.sums.size)

    def _keep(self, swept: _Swept) -> bool:
        """Keep prepared views as far as the budget allows; whether it does."""
        own: int = swept.lengths.size + swept.sums.size + swept.target.size
        if not self._cache.keep(swept.views, own):
            self._remade.append(swept.numbers)
            swept.free(self._device)
            return False
        self._kept.append(swept)
        return True

    def _bind(self, swept: _Swept, first: bool, totals: cl.Buffer, place: int | None = None) -> None:
        """Kernels of its own for a set, kept at this place or not at all: setting their arguments takes longer than
        launching them."""
        device, views, stride = self._device, swept.views, np.uint32(self._rasterizer.stride)
        shared = self._cache.shared
        shapes, colours = shared if views.shapes is None and shared else (views.shapes, views.colours)
        background = (np.float32(channel) for channel in self._rasterizer.background)
        swept.sweep = device.kernel(self._source, "removal", **self._limits)
        swept.staleness = device.kernel(self._source, "staleness", **self._limits)
        gone = (np.uint32(swept.first_tile), self._unused_stale if place is None else self._stale)
        if device.family == "cpu":
            (view,) = views.views
            weight = self._pixels / views.pixels
            lists: tuple[cl.Buffer, ...] = (views.offsets, swept.lengths, views.intersections)
            swept.sweep.set_args(
                np.uint32(0),
                self._tiles,
                shapes,
                colours,
                self._alive_buffer,
                *lists,
                views.subtiles,
                camera_struct(view.camera),
                *background,
                np.int32(first),
                np.float32(self._scale * weight),
                np.float32(self._bound / weight),
                swept.target,
                swept.sums,
                totals,
            )
            swept.staleness.set_args(self._alive_buffer, *lists, swept.sums, *gone)
            return
        table = (views.table, np.uint32(len(views.views)))
        lists = (views.offsets, swept.lengths, views.intersections, views.subtiles)
        swept.sweep.set_args(
            np.uint32(0),
            self._tiles,
            *table,
            stride,
            shapes,
            colours,
            *lists,
            *background,
            np.int32(first),
            np.float32(self._scale),
            np.float32(self._pixels),
            np.float32(self._bound),
            swept.target,
            swept.sums,
            totals,
        )
        listing = (np.float32(np.inf), self._tiles, np.uint32(place or 0), self._listed_buffer)
        swept.staleness.set_args(self._alive_buffer, *table, *lists, swept.sums, *gone, *listing)

    def _sweep(self, swept: _Swept, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        """Sweep ``count`` tiles of a set, listed in the tile buffer from ``start`` on."""
        if swept.views.shapes is None:
            assert self._cache.shared is not None
            self._rasterizer.project(swept.views, None, *self._cache.shared)
        swept.sweep.set_arg(0, np.uint32(start))
        group = _SWEEP_GROUP[self._device.family]
        self._device.launch(swept.sweep, (count * group,), (group,), queue)
        self.sweeps += count / self._tile_count

    def _sweep_all(self, swept: _Swept) -> None:
        """Sweep every tile of a set that is not kept."""
        self._list_tiles(np.arange(swept.views.tiles))
        if self._device.family == "gpu":  # there the sweep itself takes nothing out of the lists
            self._after_removal(swept)
        self._sweep(swept, 0, swept.views.tiles)

    def _after_removal(self, swept: _Swept, queue: cl.CommandQueue | None = None) -> None:
        """Enqueue what follows a removal: how much each tile has lost."""
        group = _STALENESS_GROUP[self._device.family]
        self._device.launch(swept.staleness, (swept.views.tiles * group,), (group,), queue)

    def _enqueue(self, work: Sequence[Callable[[cl.CommandQueue], None]]) -> None:
        """Enqueue pieces of work that do not depend on each other; :meth:`_wait` for them."""
        self._device.queue.finish()
        for piece, queue in zip(work, itertools.cycle(self._queues)):
            piece(queue)
            queue.flush()

    def _wait(self) -> None:
        with self._device.errors("failed while computing"):
            for queue in self._queues:
                queue.finish()

    def _list_tiles(self, tiles: NDArray[np.int64]) -> None:
        if len(tiles):
            cl.enqueue_copy(self._device.queue, self._tiles, tiles.astype(np.uint32), is_blocking=True)

    def _sweep_stale(self, tolerance: float, turns: int = 1, sample: float = 1) -> None:
        """Sweep the kept views' tiles that have lost more than ``tolerance``, of every so many-th view only, and of
        those only a random part."""
        self._settle()
        stale = self._device.download(self._stale, (self._kept_tiles,), np.float32)
        wanted = stale > tolerance
        starts = np.array([swept.first_tile for swept in self._kept] + [len(wanted)], np.int64)
        if turns > 1:
            tile = 0
            for swept in self._kept:
                for number, view in zip(swept.numbers, swept.views.views, strict=True):
                    if (self._measured + number) % turns:
                        wanted[tile : tile + view.tiles] = False
                    tile += view.tiles
        if sample < 1:
            wanted &= self._random.random(len(wanted)) < sample
        numbers = np.flatnonzero(wanted)
        bounds = np.searchsorted(numbers, starts)
        self._list_tiles(numbers - np.repeat(starts[:-1], np.diff(bounds)))
        self._sweep_listed(bounds[:-1].tolist(), np.diff(bounds).tolist())
        stale[numbers] = 0 if self._options.tolerance >= 0 else np.inf
        if len(numbers):
            cl.enqueue_copy(self._device.queue, self._stale, stale, is_blocking=True)
        self._wait()

    def _sweep_listed(self, starts: Sequence[int], counts: Sequence[int]) -> None:
        """Enqueue the sweep of so many tiles of each kept set, listed in the tile buffer from these starts on."""
        self._enqueue(
            [
                functools.partial(self._sweep, swept, start, count)
                for swept, start, count in zip(self._kept, starts, counts, strict=True)
                if count
            ]
        )

    def _sweep_anew(self) -> None:
        """Bring the totals of the kept views up to date."""
        options = self._options
        if self._listed is not None:
            self._sweep_what_is_listed()
        else:
            sampled = 0 < self._measured <= options.sampled
            turns, sample = options.turns if self._measured else 1, options.sample if sampled else 1
            self._sweep_stale(options.tolerance, turns, sample)
        if self._measured == 0:
            for swept in self._kept:
                swept.sweep.set_arg(_FIRST_TIME[self._device.family], np.int32(0))

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; of removed splats they mean nothing.

        ΔMSE is the change of the mean squared error over all views, pixels and channels against the uncompressed
        scene's renders if that splat alone went; I the mean over views and pixels of T α.
        """
        self._sweep_anew()
        words = self._device.download(self._totals, (self.splats, 2), np.int64)
        if self._remade:
            words += self._measure_transient()
        self._measured += 1
        values = self._scale * self._pixels * self._views
        effects = words[:, 0] / values
        effects /= 3
        return effects, words[:, 1] / values

    def _measure_transient(self) -> NDArray[np.int64]:
        """The views that nothing is kept of: lists, target and sums anew."""
        device = self._device
        totals, unused = self._zero_totals(), self._zero_totals()
        everything = np.ones_like(self._alive)
        for numbers in self._remade:
            swept = self._prepare(numbers)
            if self._measured:
                cl.enqueue_copy(device.queue, self._alive_buffer, everything, is_blocking=True)
                self._rasterizer.project(swept.views, self._original_sh)
                self._bind(swept, True, unused)
                self._sweep_all(swept)
                if self._original_sh is not None:
                    self._rasterizer.project(swept.views)
                cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)
                self._zero_sums(swept)
            self._bind(swept, self._measured == 0, totals)
            self._sweep_all(swept)
            device.queue.finish()
            swept.free(device)
        words = device.download(totals, (self.splats, 2), np.int64)
        device.free(totals)
        device.free(unused)
        return words

    def remove(self, splats: Indices) -> None:
        """Take splats out of all lists; note how much each tile loses."""
        self._settle()
        self._have_listed(np.inf)
        device = self._device
        self._alive[splats] = 2  # just gone
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)
        self._enqueue([functools.partial(self._after_removal, swept) for swept in self._kept])
        self._unsettled = True
        self._alive[splats] = 0

    def _settle(self) -> None:
        """Wait for what follows the last removal, and for what the device has listed on its own."""
        if self._listed is not None:
            self._sweep_what_is_listed()
        self._agree_on_marks()

    def _agree_on_marks(self) -> None:
        """Have host and device know the same splats as left, and none as just gone."""
        device = self._device
        if self._unsettled:
            self._unsettled = False
            self._wait()
        elif self._marked:
            self._marked = False
            self._alive = device.download(self._alive_buffer, self._alive.shape, np.uint8)
            self._alive[self._alive == 2] = 0
        else:
            return
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)

    # ------------------------------------------------------------- for a controller that lives on the device itself

    @property
    def steerable(self) -> bool:
        """Whether the device can decide what to remove and to sweep (:mod:`potr_cl.stages.pruning.on_device`)."""
        options = self._options
        skips = options.turns > 1 or options.sample < 1
        return self._device.family == "gpu" and not self._remade and not skips

    @property
    def device(self) -> Device:
        """Where everything is."""
        return self._device

    @property
    def limits(self) -> dict[str, float | int]:
        """Macros that the sweep's kernels are built with."""
        return self._limits

    @property
    def units(self) -> tuple[float, float]:
        """ΔMSE and I of 1 in the totals."""
        importance = 1 / (self._scale * self._pixels * self._views)
        return importance / 3, importance

    @property
    def totals(self) -> cl.Buffer:
        """(N, 2) int64 in the device's memory: ΔMSE_k and I_k in :attr:`units`."""
        return self._totals

    @property
    def marks(self) -> cl.Buffer:
        """(N,) uint8 in the device's memory: 1 for splats that are left, 2 for those that :meth:`remove_marked` shall
        take out; whoever marks next makes 0 of 2."""
        return self._alive_buffer

    def measure_on_device(self) -> None:
        """Bring :attr:`totals` up to date."""
        if self._listed is None:  # nothing is marked: what is stale is listed
            self._agree_on_marks()
            self.remove_marked()
        self._sweep_anew()
        self._measured += 1

    def remove_marked(self) -> None:
        """Take the splats out that are marked 2; the device lists the tiles that the next measurement sweeps."""
        device = self._device
        cl.enqueue_fill_buffer(device.queue, self._listed_buffer, np.uint32(0), 0, 4 * len(self._kept))
        self._have_listed(self._options.tolerance)
        for swept in self._kept:
            self._after_removal(swept)
        self._marked = True
        self._listed = device.download(self._listed_buffer, (len(self._kept),), np.uint32).tolist()

    def _have_listed(self, tolerance: float) -> None:
        """Have the device list the tiles that are staler than this from now on, on its own."""
        if tolerance != self._listed_above:
            self._listed_above = tolerance
            for swept in self._kept:
                swept.staleness.set_arg(_TOLERANCE, np.float32(tolerance))

    def _sweep_what_is_listed(self) -> None:
        assert self._listed is not None
        counts, self._listed = self._listed, None
        self._sweep_listed([swept.first_tile for swept in self._kept], counts)
        self._wait()

    # ---------------------------------------------------------------------------------------------------------------

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        self._agree_on_marks()
        alive: NDArray[np.bool_] = self._alive[: self.splats] == 1
        return alive

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours: (N, M, 3) float32 of the same degree. The targets stay as they are."""
        self._settle()
        former = self._rasterizer.replace_sh(sh)
        if self._original_sh is None:
            self._original_sh = former
        else:
            self._device.free(former)
        for swept in self._kept:
            if swept.views.shapes is not None:
                self._rasterizer.project(swept.views)
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
        places = [*((swept.number, swept) for swept in self._kept), *((numbers[0], None) for numbers in self._remade)]
        again = {numbers[0]: numbers for numbers in self._remade}
        for number, kept in sorted(places, key=lambda place: place[0]):
            swept = kept or self._sweep_once(again[number])
            yield from self._importances(swept)
            if kept is None:
                swept.free(self._device)

    def _sweep_once(self, numbers: range) -> _Swept:
        """Views that nothing is kept of, prepared and swept for the sake of their sums."""
        swept = self._prepare(numbers)
        unused = self._zero_totals()
        self._bind(swept, True, unused)
        self._sweep_all(swept)
        self._device.queue.finish()
        self._device.free(unused)
        return swept

    def _importances(self, swept: _Swept) -> Iterator[tuple[int, Indices, F64]]:
        """:meth:`view_importances` of the views of a set."""
        views, device = swept.views, self._device
        for number, view, start in zip(swept.numbers, views.views, views.intersection_starts, strict=False):
            intersections, sums = (
                np.empty(view.intersection_count, np.uint32),
                np.empty((view.intersection_count, 2), np.float32),
            )
            with device.errors("failed while computing"):
                for array, buffer in ((intersections, views.intersections), (sums, swept.sums)):
                    if view.intersection_count:
                        offset = start * array.nbytes // view.intersection_count
                        cl.enqueue_copy(device.queue, array, buffer, src_offset=offset, is_blocking=True)
            weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
            total = np.bincount(intersections, weights=weights, minlength=self.splats)[: self.splats]
            splats = np.flatnonzero((total > 0) & (self._alive[: self.splats] == 1))
            yield number, splats, total[splats] / (view.camera.width * view.camera.height)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        self._settle()
        if self._kept_tiles:
            cl.enqueue_fill_buffer(self._device.queue, self._stale, np.float32(np.inf), 0, 4 * self._kept_tiles)

    def close(self) -> None:
        self.free()

    def free(self) -> None:
        """Give all device memory back."""
        for swept in self._kept:
            swept.free(self._device)
        self._kept = []
        self._cache.free()
        for buffer in (
            self._alive_buffer,
            self._totals,
            self._tiles,
            self._stale,
            self._unused_stale,
            self._listed_buffer,
        ):
            self._device.free(buffer)
        if self._original_sh is not None:
            self._device.free(self._original_sh)
