"""The linear map A from a scene's SH coefficients to its pictures in all views, and its transpose.

For given geometry and opacities the pictures are linear in the coefficients, pictures = A x + a constant, as long as no
colour is cut at 0. Colours that are cut at some x count as constant: :meth:`ColourMap.gradient` settles at its x which
are, and :meth:`ColourMap.normal` goes by that.

A product with Aᵀ W A is one sweep over the tiles of every view (cl/refit/refit_cpu.cl, refit_gpu.cl): from the splats'
colours (cl/refit/view_colours.cl) to the pixels' values, and from those back to sums for each splat, which are gathered
into coefficients (cl/refit/gather.cl). W weighs pixels so that all views count the same whatever their size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import TILE, ViewSet
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.launcher import Launcher
from potr_cl.stages.refitting.prepared_views import PreparedViews
from potr_cl.stages.refitting.targets import TargetCache, Targets

#: Bytes a splat and view of a sweep's own buffers: the colours' change and the sums.
_CHANGE, _TOTALS = 16, 32
#: Views that a work-item of ``view_colours`` does one after the other, the coefficients in its registers.
_COLOURED = 8


class ColourMap(Owner):
    """A of one scene and some views, with pixels weighed by W.

    Args:
        launcher: runs the sweeps.
        rasterizer: of the scene's geometry and opacities; its colours are never looked at. It stays the caller's.
        coefficients: whose vectors the map takes and gives.
        means: (N, 3) float32, the splats' centres.
        cameras: the views that count, all the same whatever their size.
        background: R, G, B behind the splats.
        memory: bytes of device memory that prepared views and targets may take; None: a quarter of what is free.

    Attributes:
        total_weight: the sum over all pixels and channels of their weights: a squared error over it is a mean one.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device, or the kernels cannot be built.
    """

    def __init__(
        self,
        launcher: Launcher,
        rasterizer: Rasterizer,
        coefficients: Coefficients,
        means: FloatArray,
        cameras: Sequence[Camera],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("a re-fit needs at least one view")
        self._device = device = coefficients.device
        self._layout = layout = coefficients.layout
        self._coefficients = coefficients
        self._background = background
        self._launcher = launcher
        self._view_colours = {
            constant: device.shared_kernel("refit/view_colours.cl", "view_colours", **layout.some(constant))
            for constant in (False, True)
        }
        self._gathers = {
            (constant, weights): device.shared_kernel(
                "refit/gather.cl", "gather", WEIGHTS=int(weights), **layout.some(constant)
            )
            for constant, weights in ((False, False), (False, True), (True, False))
        }
        self.total_weight = 3 * REFERENCE_PIXELS * len(cameras)
        self._weights = [_weight(camera) for camera in cameras]
        self._fixed_points = self._launcher.fixed_point_scales(cameras)
        self._memory = Memory(device)
        self._owned: list[Owner] = [self._memory]
        try:
            columns = np.zeros((3, layout.stride), np.float32)
            columns[:, : layout.splats] = means.T
            self._means = self._memory.upload(columns, "the centres")
            own = (_CHANGE + _TOTALS) * layout.stride
            self._views = PreparedViews(rasterizer, cameras, self._launcher.most_views, own, memory)
            self._owned.append(self._views)
            launches = self._views.launches
            most = max(len(numbers) for numbers in launches)
            self._change = self._memory.allocate(_CHANGE * layout.stride * most, "the colours' change")
            self._totals = self._memory.allocate(_TOTALS * layout.stride * most, "the re-fit's sums")
            coefficients.zero(self._totals)
            tiles = max(sum(_tiles(cameras[number]) for number in numbers) for numbers in launches)
            self._errors = self._memory.allocate(4 * tiles, "the tiles' errors")
            self._scales = self._memory.allocate(4 * len(cameras), "the views' scales")
            self._targets = TargetCache(device, cameras, launches, self._views.budget)
            self._owned.append(self._targets)
        except BaseException:
            self.close()
            raise

    @property
    def room(self) -> float:
        """Bytes of the memory for prepared views and targets that are left."""
        return self._views.budget.room

    # ------------------------------------------------------------------------------------------ products

    def gradient(
        self,
        x: cl.Buffer,
        targets: Targets,
        result: cl.Buffer,
        blocks: SplatBlocks | None = None,
        constant: bool = False,
    ) -> float:
        """result += Aᵀ W (pictures(x) - targets), half the gradient of the squared error at x.

        Colours that are cut at 0 at x are settled: they have no part in it.

        Args:
            x: the coefficients.
            targets: what the pictures should show.
            result: a vector.
            blocks: the splats' own blocks of Aᵀ W A are added to them; cuts are left out of account there.
            constant: leave the result's AC coefficients alone. Not together with blocks.

        Returns:
            The squared error |pictures(x) - targets|² by W.

        Raises:
            DeviceError: the device failed. What the targets raise.
        """
        error = 0.0
        self._upload_scales(1.0)
        for numbers in self._views.launches:
            with self._views.ready(numbers) as (views, _):
                self._enqueue_colours(views, x, views.colours, None)
                pictures = self._targets.pictures(targets, numbers)
                self._enqueue_sweep(numbers, views, views.colours, pictures, blocks is not None)
                self._enqueue_gather(numbers, views, result, blocks, constant)
                error += self._error(numbers, views)
        return error

    def normal(self, direction: cl.Buffer, at: cl.Buffer, result: cl.Buffer, constant: bool = False) -> None:
        """result += Aᵀ W A direction, nothing if the direction is 0 or not finite.

        Args:
            direction: a vector. It may be of any length: it is scaled so that the fixed point of the sums fits.
            at: the vector that :meth:`gradient` was given last, with the same content.
            result: another vector.
            constant: the direction's AC coefficients are all 0, and those of the result are left alone.

        Raises:
            DeviceError: the device failed.
        """
        largest = self._coefficients.largest(direction)
        if not 0 < largest < math.inf:
            return
        unit = 1 / largest
        self._upload_scales(unit)
        for numbers in self._views.launches:
            with self._views.ready(numbers) as (views, anew):
                if anew:  # which colours are cut is not known any more
                    self._enqueue_colours(views, at, views.colours, None)
                self._enqueue_colours(views, direction, self._change, unit, constant)
                self._enqueue_sweep(numbers, views, self._change, None, False)
                self._enqueue_gather(numbers, views, result, None, constant)

    # ------------------------------------------------------------------------------------------ their parts

    def _upload_scales(self, unit: float) -> None:
        """By what each view's sums are multiplied on their way to the coefficients."""
        pairs = zip(self._weights, self._fixed_points, strict=True)
        scales = np.array([weight / (fixed_point * unit) for weight, fixed_point in pairs], np.float32)
        cl.enqueue_copy(self._device.queue, self._scales, scales, is_blocking=True)

    def _enqueue_colours(
        self, views: ViewSet, x: cl.Buffer, result: cl.Buffer, unit: float | None, constant: bool = False
    ) -> None:
        """Enqueue the views' colours, or what ``unit`` times a direction adds to them where none is cut at 0."""
        kernel = self._view_colours[constant]
        kernel.bind(
            coefficients=x,
            means=self._means,
            stride=self._layout.stride,
            views=views.table,
            view_count=len(views.views),
            direction=unit is not None,
            unit=np.float32(1.0 if unit is None else unit),
            free=views.colours,
            colours=result,
        )
        self._layout.over_splats(kernel, -(-len(views.views) // _COLOURED))

    def _enqueue_sweep(
        self, numbers: range, views: ViewSet, colours: cl.Buffer, target: cl.Buffer | None, weights: bool
    ) -> None:
        """Enqueue the sweep of a launch's views; without a target colours are a change, and black is behind them."""
        self._launcher.sweep(
            views,
            self._layout.stride,
            colours,
            (0.0, 0.0, 0.0) if target is None else self._background,
            target,
            self._fixed_points[numbers[0]],
            self._errors,
            self._totals,
            weights,
        )

    def _enqueue_gather(
        self, numbers: range, views: ViewSet, result: cl.Buffer, blocks: SplatBlocks | None, constant: bool
    ) -> None:
        """Enqueue the way from the views' sums to the coefficients, and to the blocks if the sums have their part."""
        gather = self._gathers[constant, blocks is not None]
        gather.bind(
            totals=self._totals,
            means=self._means,
            stride=self._layout.stride,
            views=views.table,
            view_count=len(numbers),
            scales=self._scales,
            first_scale=numbers[0],
            free=views.colours,
            result=result,
            blocks=result if blocks is None else blocks.buffer,
        )
        self._layout.over_splats(gather)

    def _error(self, numbers: range, views: ViewSet) -> float:
        """The squared error by W that the last sweep found in these views."""
        tiles = self._device.download(self._errors, (views.tiles,), np.float32)
        ends = np.cumsum([view.tiles for view in views.views])
        parts = np.split(tiles, ends[:-1])
        return sum(
            self._weights[number] * float(part.sum(dtype=np.float64))
            for number, part in zip(numbers, parts, strict=True)
        )

    def close(self) -> None:
        """Give all device memory back."""
        for owner in reversed(self._owned):
            owner.close()


def _weight(camera: Camera) -> float:
    """What a pixel of a view counts."""
    return REFERENCE_PIXELS / (camera.width * camera.height)


def _tiles(camera: Camera) -> int:
    """Tiles that cover a view."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)
