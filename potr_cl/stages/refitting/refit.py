"""Joint re-fit of the colours: what pruning and compaction lost, won back in closed form.

For fixed geometry and opacity the picture is linear in the SH coefficients, image = A x (where no colour is cut at
0). So the coefficients of all splats are solved for together, against given pictures in all views: linear least squares
with the compaction's ridge on the AC coefficients,

    minimise over x: sum over views s of w_s |A_s x - target_s|^2 + lambda |x_AC|^2 + prior |x - start|^2
    (lambda threefold on chroma),

by conjugate gradients on the normal equations, preconditioned by each splat's own block. A product with the normal
matrix is one sweep over the tiles of every view (cl/refit/refit_*.cl). Colours that are cut at 0 stay so while a
solution is sought; the true error of the result is measured, and the start is kept if it was better.

Which AC coefficients are worth their bytes is seen here too: after a few steps those are given up whose loss would cost
less than a given mean squared error, and the rest is solved again.

Not in the paper, which solves for each splat alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec.quantize import quantize_sh, to_ycocg
from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.macros import gpu_limits, totals_limits
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.view_cache import ViewCache
from potr_cl.raster.view_set import TILE, ViewSet, camera_struct
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS

#: Gives the picture that view number i should show: a device buffer that begins with (H, W, 3) float32, valid until the
#: next call.
Targets = Callable[[int], cl.Buffer]

#: Views that a GPU does in one launch.
_MOST_VIEWS = 32
#: Bytes a splat and view of a sweep's own buffers: the colours' change and the sums.
_SWEEP_BYTES = 48
#: Work-items of a sweep's work-group.
_SWEEP_GROUP = {"cpu": 1, "gpu": 128}
#: Views that a work-item of ``view_colours`` does one after the other, the coefficients in its registers.
_COLOURED = 8
#: Splats whose coefficients the host turns from rows into columns at a time.
_TURNED = 4096
#: Work-items of a work-group of the stages on splats.
_GROUP = 64
#: Work-items that share a dot product.
_DOT_ITEMS = 16384
#: Part of the device's memory not yet taken that views and targets may take unless the caller sets a budget.
_SHARE = 0.25
#: Pixel values beyond this are cut in the kernels (LARGEST_VALUE).
_LARGEST_VALUE = 64.0
#: Steps end where the residual's square, as the preconditioner measures it, has shrunk by this: single precision has no
#: more digits, and what is left of them leads astray.
_CONVERGED = 1e-14
#: Half steps tried when a solution is worse than its start because colours were cut at 0 on the way.
_HALVINGS = 4


@dataclass(frozen=True)
class RefitOptions:
    """How to re-fit.

    Attributes:
        steps: conjugate-gradient steps at the most.
        drop: mean squared error for which an AC coefficient is given up; with it, ``selection_steps`` come first, then
            the coefficients that cost less than this are set to 0 for good.
        selection_steps, selection_lam: steps and lambda before that choice.
        gain: stop when a step takes less than this part off the squared error.
        lam: lambda on the AC coefficients of Y, in pixels of an image of :data:`REFERENCE_PIXELS`.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: the same on every coefficient's distance to its start: what the views do not tell stays as it was.
        memory: bytes of device memory that prepared views and targets may take; None: a quarter of what is free.

    Raises:
        UsageError: a value is out of range.
    """

    steps: int = 8
    drop: float = 0.0
    selection_steps: int = 2
    selection_lam: float = 0.0
    gain: float = 0.01
    lam: float = 0.0
    chroma_factor: float = 3.0
    prior: float = 0.1
    memory: int | None = None

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise UsageError(f"{self.steps} re-fit steps: it must be 0 or more")
        if not 0 <= self.gain < 1:
            raise UsageError(f"the re-fit's least gain a step is {self.gain:g}, it must be 0 or more and below 1")
        if self.selection_steps < 0:
            raise UsageError(f"{self.selection_steps} re-fit steps: it must be 0 or more")
        for name in ("lam", "chroma_factor", "prior", "drop", "selection_lam"):
            if not 0 <= getattr(self, name) <= 1e12:
                raise UsageError(f"the re-fit's {name} is {getattr(self, name):g}, it must lie between 0 and 1e12")


@dataclass(frozen=True)
class Refitted:
    """What a re-fit did.

    Attributes:
        sh: (N, M, 3) float32 coefficients, R, G, B.
        errors: mean squared error over views, pixels and channels before, and after.
        steps: conjugate-gradient steps that were taken.
    """

    sh: FloatArray
    errors: tuple[float, float]
    steps: int


def active_coefficients(sh: FloatArray, sf_sh: float) -> NDArray[np.bool_]:
    """(N, M, 3) the coefficients in Y, Co, Cg that the quantiser would not round to 0; DC always.

    Args:
        sh: (N, M, 3) R, G, B.
        sf_sh: the quantiser's scale factor.
    """
    active = np.ones(sh.shape, bool)
    for m in range(1, sh.shape[1]):
        for c, channel in enumerate(to_ycocg(sh[:, m].astype(np.float64))):
            active[:, m, c] = quantize_sh(channel, sf_sh) != 0
    return active


@dataclass(frozen=True)
class _State:
    """Weighted squared error at some coefficients, and with the regularisers."""

    error: float
    objective: float


class RenderedTargets:
    """The pictures that another scene gives: the uncompressed one's.

    Args:
        rasterizer: of that scene.
        cameras: the views.
    """

    def __init__(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> None:
        self._rasterizer = rasterizer
        self._cameras = list(cameras)

    def __call__(self, number: int) -> cl.Buffer:
        return self._rasterizer.render_device(self._cameras[number])[0]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """The pictures of several views, one behind the other into a buffer of the caller's."""
        self._rasterizer.render_into([self._cameras[number] for number in numbers], buffer)


class ColourRefit:
    """The linear map from SH coefficients to pictures of one scene, its transpose, and the solver.

    Args:
        device: to compute on.
        scene: whose geometry and opacities are used; its colours are the start.
        cameras: the views that count, all the same whatever their size.
        options: of the solver.
        rules, background: of the rasterizer.
        progress: called with the views prepared and their number.
        active: as :meth:`set_coefficients` takes it.

    Raises:
        UsageError: no camera.
        DeviceError: the scene or a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        cameras: Sequence[Camera],
        options: RefitOptions | None = None,
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        progress: Callable[[int, int], None] | None = None,
        active: NDArray[np.bool_] | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("a re-fit needs at least one view")
        self.device = device
        self.options = options or RefitOptions()
        self._cameras = list(cameras)
        self._largest_size = max(c.width for c in cameras), max(c.height for c in cameras)
        self._background = background
        self._sh_count = scene.sh.shape[1]
        self._columns = 3 * self._sh_count
        # The rasterizer's own colours are never looked at.
        self._rasterizer = Rasterizer(device, replace(scene, sh=scene.sh[:, :1]), rules)
        self._splats, self._stride = len(scene), self._rasterizer.stride
        self._build(rules)
        means = np.zeros((3, self._stride), np.float32)
        means[:, : self._splats] = scene.means.T
        nbytes = 4 * self._columns * self._stride
        self._vectors: list[cl.Buffer] = []
        self._sets: list[tuple[range, ViewSet | None]] = []
        self._kept: dict[int, cl.Buffer] = {}  # by the number of a set's first view
        self._kept_of: Targets | None = None
        try:
            self._means = device.upload(means, "the centres")
            self._vectors.append(self._means)
            self._x, self._start, self._residual, self._direction, self._product, self._preconditioned = (
                self._allocate(nbytes, "the SH coefficients") for _ in range(6)
            )
            self._gram = self._allocate(4 * self._triangle * self._stride, "the splats' normal equations")
            self._active = self._allocate(8 * self._stride, "the active coefficients")
            self._parts = self._allocate(8 * _DOT_ITEMS, "a dot product")
            self.set_coefficients(scene.sh, active)
            self._prepare_views(progress)
        except BaseException:
            self.free()
            raise

    # ------------------------------------------------------------------------------------------ set-up

    def _allocate(self, nbytes: int, what: str) -> cl.Buffer:
        self._vectors.append(self.device.allocate(nbytes, what))
        return self._vectors[-1]

    def _build(self, rules: RasterRules) -> None:
        device, count = self.device, self._sh_count
        self._triangle = count * (count + 1) // 2
        self._lanes = 1 if device.family == "gpu" else device.vector_width
        limits: dict[str, float | int] = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold,
        }
        if device.family == "gpu":
            limits |= gpu_limits(device)
        else:
            limits |= {"LANES": max(device.vector_width, 8)} | totals_limits(device)
        source = f"refit/refit_{device.family}.cl"
        self._sweeps = [device.kernel(source, "refit_sweep", WEIGHTS=weights, **limits) for weights in (0, 1)]

        def stage(name: str, weights: int = 0) -> cl.Kernel:
            return device.kernel("refit/refit.cl", name, LANES=self._lanes, SH_COUNT=count, WEIGHTS=weights)

        self._view_colours = stage("view_colours")
        self._gathers = [stage("gather", weights) for weights in (0, 1)]
        self._regularise = stage("regularise")
        self._precondition = stage("precondition")
        self._select_active = stage("select_active")
        self._combine = stage("combine")
        self._dot_parts = stage("dot_parts")

    def _prepare_views(self, progress: Callable[[int, int], None] | None) -> None:
        """Prepare every view, keep as many as the budget allows, and make room for a sweep over some at a time."""
        device = self.device
        memory = self.options.memory
        free = device.info.memory - device.allocated
        self._cache = ViewCache(self._rasterizer, free * _SHARE if memory is None else memory)
        # A sweep's own buffers take as much as geometry does, the sums included.
        own = _SWEEP_BYTES * self._stride
        most = 1 if device.family == "cpu" else self._cache.most_views(_MOST_VIEWS, own)
        number = 0
        while number < len(self._cameras):
            numbers = range(number, min(number + most, len(self._cameras)))
            try:
                views = self._prepare(numbers)
            except DeviceMemoryError:
                if most == 1:
                    raise
                most //= 2
                continue
            if self._cache.keep(views):
                self._sets.append((numbers, views))
            else:
                views.free()
                self._sets.append((numbers, None))
            number += len(numbers)
            if progress is not None:
                progress(number, len(self._cameras))
        largest = max(len(numbers) for numbers, _ in self._sets)
        sets = [[self._cameras[number] for number in numbers] for numbers, _ in self._sets]
        tiles = max(sum(-(-c.width // TILE) * -(-c.height // TILE) for c in cameras) for cameras in sets)
        self._change = self._allocate(16 * self._stride * largest, "the colours' change")
        self._totals = self._allocate(32 * self._stride * largest, "the re-fit's sums")
        self._zero(self._totals)
        self._errors = self._allocate(4 * tiles, "the tiles' errors")
        self._scales = self._allocate(4 * len(self._cameras), "the views' scales")
        largest = max(self._target_bytes(numbers) for numbers, _ in self._sets)
        self._target = self._allocate(largest, "the target images")

    def _prepare(self, numbers: range) -> ViewSet:
        return self._rasterizer.prepare_set([self._cameras[number] for number in numbers])

    def _target_bytes(self, numbers: range) -> int:
        return 12 * sum(self._cameras[number].width * self._cameras[number].height for number in numbers)

    def set_coefficients(self, sh: FloatArray, active: NDArray[np.bool_] | None = None, hold: bool = False) -> None:
        """Where to start.

        Args:
            sh: (N, M, 3) R, G, B.
            active: (N, M, 3) in Y, Co, Cg: the coefficients that may change; all by default.
            hold: the others keep their values; without, they are 0.
        """
        columns = np.zeros((self._columns, self._stride), np.float32)
        for some in self._slices():
            rows = sh[some].astype(np.float64)
            for c, channel in enumerate(to_ycocg(rows.reshape(-1, 3))):
                columns[c::3, some] = channel.reshape(-1, self._sh_count).T
        words = np.zeros((2, self._stride), np.uint32)
        if active is None:
            words[0] = (1 << min(self._columns, 24)) - 1
            words[1] = (1 << max(self._columns - 24, 0)) - 1
        else:
            for column in range(self._columns):
                flags = active[:, column // 3, column % 3]
                if not hold:
                    columns[column, : self._splats] *= flags
                words[column // 24, : self._splats] |= flags.astype(np.uint32) << np.uint32(column % 24)
        cl.enqueue_copy(self.device.queue, self._x, columns, is_blocking=True)
        cl.enqueue_copy(self.device.queue, self._active, words, is_blocking=True)

    def _slices(self) -> Iterator[slice]:
        """The splats, so many at a time that a CPU's cache holds their coefficients while they are turned."""
        for first in range(0, self._splats, _TURNED):
            yield slice(first, min(first + _TURNED, self._splats))

    def _coefficients(self, buffer: cl.Buffer) -> FloatArray:
        """A vector on the device as (N, M, 3) R, G, B."""
        columns = self.device.download(buffer, (self._sh_count, 3, self._stride), np.float32)
        sh = np.empty((self._splats, self._sh_count, 3), np.float32)
        for some in self._slices():
            y, co, cg = columns[:, 0, some], columns[:, 1, some], columns[:, 2, some]
            # In this order nothing overflows that did not in R, G, B.
            rest = y - cg
            for c, channel in enumerate((rest + co, y + cg, rest - co)):
                sh[some, :, c] = channel.T
        return sh

    # ------------------------------------------------------------------------------------------ vectors

    def _over_splats(self, kernel: cl.Kernel, lanes: int) -> None:
        self.device.launch(kernel, (self._stride // lanes,), (max(_GROUP // lanes, 1),))

    def _linear(self, a: float, y: cl.Buffer, b: float, x: cl.Buffer) -> None:
        """y = a y + b x."""
        self._combine.set_args(np.float32(a), y, np.float32(b), x)
        self.device.launch(self._combine, (self._columns * self._stride,), (_GROUP,))

    def _zero(self, buffer: cl.Buffer) -> None:
        cl.enqueue_fill_buffer(self.device.queue, buffer, np.float32(0), 0, buffer.size)

    def _copy(self, target: cl.Buffer, source: cl.Buffer) -> None:
        cl.enqueue_copy(self.device.queue, target, source, byte_count=4 * self._columns * self._stride)

    def _dot(self, x: cl.Buffer, y: cl.Buffer) -> tuple[float, float]:
        """x · y, and the largest |x|."""
        self._dot_parts.set_args(x, y, np.uint64(self._columns * self._stride), self._parts)
        self.device.launch(self._dot_parts, (_DOT_ITEMS,), (_GROUP,))
        parts = self.device.download(self._parts, (2, _DOT_ITEMS), np.float32)
        with np.errstate(invalid="ignore"):  # infinities of both signs: the callers look at the result
            return float(parts[0].sum(dtype=np.float64)), float(parts[1].max())

    def _add_ridge(self, sums: cl.Buffer, coefficients: cl.Buffer, lam: float, prior: float) -> None:
        """sums += Γ coefficients + prior · coefficients, on the active coefficients; the others' sums become 0."""
        self._regularise.set_args(
            sums,
            coefficients,
            self._active,
            np.uint32(self._stride),
            np.float32(lam),
            np.float32(lam * self.options.chroma_factor),
            np.float32(prior),
        )
        self._over_splats(self._regularise, self._lanes)

    # ------------------------------------------------------------------------------------------ sweeps

    def _weight(self, camera: Camera) -> float:
        """What a pixel of a view counts."""
        return REFERENCE_PIXELS / (camera.width * camera.height)

    def _sweep_views(
        self,
        coefficients: cl.Buffer,
        result: cl.Buffer,
        targets: Targets | None,
        unit: float = 1.0,
        weights: bool = False,
    ) -> float:
        """result += Aᵀ W (A coefficients - targets), of the colours themselves; without targets of their change.

        Args:
            unit: factor that keeps the change's colours near 1.
            weights: sum up the splats' own blocks of the normal equations too.

        Returns:
            The weighted squared error of the colours themselves.
        """
        error = 0.0
        self._upload_scales(unit)
        for numbers, kept in self._sets:
            views = kept or self._prepare(numbers)
            with self._cache.geometry(views) as anew:
                if targets is not None:
                    self._enqueue_colours(views, coefficients, views.colours, False, 1.0)
                else:
                    if anew or kept is None:  # which colours are cut at 0 was settled where the way began
                        self._enqueue_colours(views, self._start, views.colours, False, 1.0)
                    self._enqueue_colours(views, coefficients, self._change, True, unit)
                self._enqueue_sweep(numbers, views, targets, weights)
                self._gather(numbers, views, result, weights)
            if targets is not None:
                error += self._error(views)
            if kept is None:
                views.free()
        return error

    def _error(self, views: ViewSet) -> float:
        """The weighted squared error that the last sweep found in these views."""
        tiles = self.device.download(self._errors, (views.tiles,), np.float32)
        ends = np.cumsum([view.tiles for view in views.views])
        parts = zip(views.views, np.split(tiles, ends[:-1]), strict=True)
        return sum(self._weight(view.camera) * float(part.sum(dtype=np.float64)) for view, part in parts)

    def _enqueue_sweep(self, numbers: range, views: ViewSet, targets: Targets | None, weights: bool) -> None:
        """Enqueue the sweep of a set's views."""
        sweep, family = self._sweeps[weights], self.device.family
        colours = views.colours if targets is not None else self._change
        background = (np.float32(channel if targets is not None else 0) for channel in self._background)
        target = self._target if targets is None else self._target_images(numbers, targets)
        rest = (
            *background,
            target,
            np.int32(targets is not None),
            np.float32(self._fixed_scale(self._cameras[numbers[0]])),
            self._errors,
            self._totals,
        )
        group = _SWEEP_GROUP[family]
        if family == "cpu":
            (view,) = views.views
            lists: tuple[cl.Buffer, ...] = (views.offsets, views.intersections, views.subtiles)
            sweep.set_args(views.shapes, colours, *lists, camera_struct(view.camera), *rest)
            self.device.launch(sweep, (views.tiles * group,), (group,))
        else:
            stride = np.uint32(self._stride)
            lists = (views.offsets, views.intersections, views.subtiles)
            sweep.set_args(views.table, stride, views.shapes, colours, *lists, *rest)
            most = max(view.tiles for view in views.views)
            self.device.launch(sweep, (most * group, len(views.views)), (group, 1))

    def _enqueue_colours(
        self, views: ViewSet, coefficients: cl.Buffer, result: cl.Buffer, change: bool, unit: float
    ) -> None:
        """Enqueue the views' colours, or those that a direction adds where none is cut at 0."""
        count = len(views.views)
        self._view_colours.set_args(
            coefficients,
            self._means,
            np.uint32(self._stride),
            views.table,
            np.uint32(count),
            np.int32(change),
            np.float32(unit),
            views.colours,
            result,
        )
        group = max(_GROUP // self._lanes, 1)
        self.device.launch(self._view_colours, (self._stride // self._lanes, -(-count // _COLOURED)), (group, 1))

    def _target_images(self, numbers: range, targets: Targets) -> cl.Buffer:
        """What a set's views should show, kept from the first time on while the memory budget lasts."""
        if targets is not self._kept_of:
            self._forget_targets()
            self._kept_of = targets
        if numbers[0] in self._kept:
            return self._kept[numbers[0]]
        nbytes = self._target_bytes(numbers)
        buffer = self._target
        if nbytes <= self._cache.room:
            self._cache.room -= nbytes
            buffer = self._kept[numbers[0]] = self.device.allocate(nbytes, "the target images")
        if isinstance(targets, RenderedTargets):
            targets.into(numbers, buffer)
            return buffer
        start = 0
        for number in numbers:
            size = self._target_bytes(range(number, number + 1))
            cl.enqueue_copy(self.device.queue, buffer, targets(number), byte_count=size, dst_offset=start)
            self.device.queue.finish()
            start += size
        return buffer

    def _forget_targets(self) -> None:
        for buffer in self._kept.values():
            self._cache.room += buffer.size
            self.device.free(buffer)
        self._kept, self._kept_of = {}, None

    def _upload_scales(self, unit: float) -> None:
        """By what each view's sums are multiplied on their way to the coefficients."""
        scales = [self._weight(c) / (self._fixed_scale(c) * unit) for c in self._cameras]
        cl.enqueue_copy(self.device.queue, self._scales, np.array(scales, np.float32), is_blocking=True)

    def _gather(self, numbers: range, views: ViewSet, result: cl.Buffer, weights: bool) -> None:
        """Enqueue the way from the views' sums to the coefficients."""
        gather = self._gathers[weights]
        gather.set_args(
            self._totals,
            self._means,
            np.uint32(self._stride),
            views.table,
            np.uint32(len(numbers)),
            self._scales,
            np.uint32(numbers[0]),
            views.colours,
            result,
            self._gram,
        )
        self._over_splats(gather, self._lanes)

    def _fixed_scale(self, camera: Camera) -> float:
        """Fixed point of 62 bits for sums over a view's pixels, the largest power of two that cannot overflow; on GPUs,
        which do several views in one launch, in none of them."""
        width, height = self._largest_size if self.device.family == "gpu" else (camera.width, camera.height)
        area = (width + TILE - 1) * (height + TILE - 1)
        return float(2.0 ** np.floor(62 - np.log2(_LARGEST_VALUE * area)))

    # ------------------------------------------------------------------------------------------ the solver

    def _linearise(self, targets: Targets, lam: float, weights: bool) -> _State:
        """Make the residual: minus half the objective's gradient at the present coefficients."""
        prior = self.options.prior
        self._zero(self._residual)
        error = self._sweep_views(self._x, self._residual, targets, weights=weights)
        self._add_ridge(self._residual, self._x, lam, 0.0)
        self._zero(self._product)
        self._add_ridge(self._product, self._x, lam, 0.0)
        ridge = self._dot(self._x, self._product)[0]
        way = self._direction
        self._copy(way, self._x)
        self._linear(1.0, way, -1.0, self._start)
        ridge += prior * self._dot(way, way)[0]
        self._linear(-1.0, self._residual, -prior, way)
        return _State(error, error + ridge)

    def _apply_preconditioner(self, lam: float) -> None:
        self._precondition.set_args(
            self._residual,
            self._gram,
            self._active,
            np.uint32(self._stride),
            np.float32(lam),
            np.float32(lam * self.options.chroma_factor),
            np.float32(self.options.prior),
            self._preconditioned,
        )
        self._over_splats(self._precondition, self._lanes)

    def solve(self, targets: Targets, progress: Callable[[int, int], None] | None = None) -> Refitted:
        """Re-fit the active coefficients, after choosing among them if the options say so.

        Args:
            targets: the pictures to come near to.
            progress: called with the steps done and their greatest number.

        Raises:
            DeviceError: the device failed.
        """
        options = self.options
        values = 3 * REFERENCE_PIXELS * len(self._cameras)
        total = options.steps + (options.selection_steps if options.drop else 0)

        def told(steps: int) -> None:
            if progress is not None:
                progress(steps, total)

        self._zero(self._gram)
        self._copy(self._start, self._x)
        first = state = self._linearise(targets, options.selection_lam if options.drop else options.lam, True)
        steps = 0
        if options.drop:
            chosen_from = self._active_words()
            steps = self._descend(state, options.selection_steps, options.selection_lam, told)
            self._select(options.drop * values)
            self._copy(self._preconditioned, self._start)
            self._copy(self._start, self._x)
            state = self._linearise(targets, options.lam, False)
            given_up = options.drop * values * np.bitwise_count(chosen_from ^ self._active_words()).sum()
            if not state.error <= first.error + given_up:
                # Colours were cut at 0 on the way: choose among the coefficients as they were.
                self._copy(self._x, self._preconditioned)
                cl.enqueue_copy(self.device.queue, self._active, chosen_from, is_blocking=True)
                self._select(options.drop * values)
                self._copy(self._start, self._x)
                state, steps = self._linearise(targets, options.lam, False), 0
        more = self._descend(state, options.steps, options.lam, lambda done: told(steps + done))
        last = self._linearise(targets, options.lam, False)
        for _ in range(_HALVINGS):
            if last.objective <= state.objective:
                break
            self._linear(0.5, self._x, 0.5, self._start)
            last = self._linearise(targets, options.lam, False)
        if not last.objective <= state.objective:
            self._copy(self._x, self._start)
            last, more = state, 0
        return Refitted(self._coefficients(self._x), (first.error / values, last.error / values), steps + more)

    def _active_words(self) -> NDArray[np.uint32]:
        """(2, stride) a bit a coefficient: which are active."""
        words: NDArray[np.uint32] = self.device.download(self._active, (2, self._stride), np.uint32)
        return words

    def _select(self, least: float) -> None:
        """Give up the active coefficients that cost less."""
        self._select_active.set_args(
            self._x,
            self._gram,
            self._active,
            np.uint32(self._stride),
            np.float32(self.options.prior),
            np.float32(least),
        )
        self._over_splats(self._select_active, self._lanes)

    def _descend(self, state: _State, most: int, lam: float, told: Callable[[int], None]) -> int:
        """Conjugate-gradient steps from a linearised state; returns how many paid."""
        remaining, slope, least = state.objective, 0.0, 0.0
        for step in range(most):
            self._apply_preconditioner(lam)
            new_slope = self._dot(self._preconditioned, self._residual)[0]
            least = _CONVERGED * new_slope if step == 0 else least
            if not (new_slope > least and np.isfinite(new_slope)):
                return step
            self._linear(new_slope / slope if step else 0.0, self._direction, 1.0, self._preconditioned)
            slope = new_slope
            largest = self._dot(self._direction, self._direction)[1]
            self._zero(self._product)
            self._sweep_views(self._direction, self._product, None, unit=1 / largest)
            self._add_ridge(self._product, self._direction, lam, self.options.prior)
            curvature = self._dot(self._direction, self._product)[0]
            if not (curvature > 0 and np.isfinite(curvature)):
                return step
            length = slope / curvature
            self._linear(1.0, self._x, length, self._direction)
            self._linear(1.0, self._residual, -length, self._product)
            gained = length * slope
            remaining -= gained
            told(step + 1)
            if gained < self.options.gain * remaining:
                return step + 1
        return most

    def free(self) -> None:
        """Give all device memory back."""
        for _, views in self._sets:
            if views is not None:
                views.free()
        self._cache.free()
        self._forget_targets()
        for buffer in self._vectors:
            self.device.free(buffer)
        self._sets, self._vectors = [], []
        self._rasterizer.free()


def refit_colours(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    targets: Targets,
    options: RefitOptions | None = None,
    active: NDArray[np.bool_] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Callable[[int, int], None] | None = None,
) -> Refitted:
    """Re-fit a scene's colours to pictures of all views together.

    Args:
        device: to compute on.
        scene: its geometry and opacities stay, its colours are the start.
        cameras: the views that count.
        targets: the picture that each of them should show.
        options: of the solver.
        active: (N, M, 3) in Y, Co, Cg: the coefficients that may differ from 0; all by default.
        background: R, G, B behind the scene.
        progress: called with the steps done and their greatest number.

    Raises:
        UsageError: no camera.
        DeviceError: the scene does not fit the device.
    """
    refit = ColourRefit(device, scene, cameras, options, background=background, active=active)
    try:
        return refit.solve(targets, progress)
    finally:
        refit.free()
