"""Derivatives of a scene's pictures with respect to all its parameters, on a device: :class:`PictureDerivatives`.

With J the derivatives of all pixels of some views, and v a number for each pixel and channel, it finds Jᵀ W v, where W
weighs pixels so that all views count the same whatever their size. Where v is the difference to target pictures, this
is half the gradient of the squared error. A view takes three steps:

1. the rasterizer prepares it (:class:`potr_cl.raster.rasterizer.Rasterizer`);
2. ``derivatives`` goes back from the pixels to nine sums for each splat (cl/fit/derivatives_cpu.cl and its twin);
3. ``chain`` goes back from those to the splat's parameters (cl/fit/chain.cl).

What the rasterizer decides by comparing numbers is taken as constant (:mod:`tests.reference.derivatives` lists it).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.opencl.narrow import Narrowed, Narrowing
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.sweep import TileSweep, fixed_point_scale
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.compaction.view_weights import pixel_weight

#: Pixels' numbers beyond this are cut in the kernels (macros of cl/fit/sums.clh), and so are their products with the
#: difference of a splat's colour to the one behind it: no sum can overflow.
_LARGEST_VALUE, _LARGEST_GAP = 64.0, 256.0
#: U² + V² of sums.clh is less wherever alpha reaches 1/255.
_LARGEST_SQUARE = 8.1
#: Bytes of a splat's sums in a view: nine 64-bit integers.
_SUMS = 72


@dataclass(frozen=True)
class Columns:
    """Where a scene's parameters lie on the device: a column of ``stride`` floats for each.

    Attributes:
        sh: coefficients of all three channels.
    """

    sh: int
    means = slice(0, 3)
    log_scales = slice(3, 6)
    quaternions = slice(6, 10)
    opacity_logits = slice(10, 11)

    @property
    def dc(self) -> slice:
        return slice(11, 14)

    @property
    def ac(self) -> slice:
        return slice(14, self.count)

    @property
    def count(self) -> int:
        return 11 + self.sh


class PictureDerivatives(Owner):
    """Jᵀ W v of one scene, whose parameters may change on the device between two calls.

    Args:
        scene: of N splats.

    Attributes:
        columns: which parameter is in which column of the gradient.
        gradient: (columns, stride) float32, what :meth:`add` adds to; zero at first.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self._device = device
        self._sweep = TileSweep(
            device, rules, "fit/derivatives", "derivatives", LARGEST_VALUE=_LARGEST_VALUE, LARGEST_GAP=_LARGEST_GAP
        )
        self._memory = Memory(device)
        self._totals = Scratch(device, "the derivatives' sums")
        self._factors = Scratch(device, "the views' weights")
        self._written: list[float] | None = None
        self._arrived, self._narrowing = Scratch(device, "sums of views"), Narrowing(device)
        self._views: ViewSet | None = None
        self._shown: ViewSet | None = None
        self.rasterizer = Rasterizer(device, scene, rules, background)
        try:
            parameters = self.rasterizer.parameters
            self.columns = Columns(3 * parameters.sh_count)
            self._chain = device.shared_kernel(
                "fit/chain.cl",
                "chain",
                LANES=self._sweep.lanes,
                SH_COUNT=parameters.sh_count,
                **self.rasterizer.filter_macros,
            )
            self.gradient = self._memory.allocate(4 * self.columns.count * parameters.stride, "the gradient")
            self.forget()
        except BaseException:
            self.close()
            raise

    def forget(self) -> None:
        """Set the gradient to 0."""
        self._device.fill(self.gradient, np.float32(0))

    def add(self, cameras: Sequence[Camera], target: cl.Buffer, given: bool = False, unit: float = 1.0) -> None:
        """Add Jᵀ W v of some views to the gradient.

        Args:
            target: (pixels, 3) float32, the pictures of the views, one behind the other.
            given: whether ``target`` holds v; if not, v is the views' difference to these pictures.
            unit: by what v is multiplied while it is summed up: with large numbers small differences keep their digits,
                but what exceeds ``_LARGEST_VALUE`` then is cut.
        """
        pixels = 0
        at_a_time = self._sweep.most_views
        number = 0
        while number < len(cameras):
            some = cameras[number : number + at_a_time]
            try:
                views = self._prepared(some)
                self._reserve(views)
            except DeviceMemoryError:
                self._release()
                if len(some) == 1:
                    raise
                at_a_time = (len(some) + 1) // 2
                continue
            scale = _scale(some)
            self._sweep_over(views, target, pixels, scale, unit, given)
            self._follow(views, scale * (1.0 if given else unit))
            number += len(some)
            pixels += views.pixels

    def _sweep_over(
        self, views: ViewSet, target: cl.Buffer, first_pixel: int, scale: float, unit: float, given: bool = False
    ) -> None:
        """Enqueue the sums of cl/fit/sums.clh over the pixels of some views, times ``scale``."""
        self._sweep.run(
            views,
            views.shapes,
            views.colours,
            self.rasterizer.background,
            target=target,
            first_pixel=first_pixel,
            given=given,
            unit=unit,
            scale=scale,
            totals=self._totals.buffer,
        )

    def sums(
        self, cameras: Sequence[Camera], places: Sequence[int], target: cl.Buffer, unit: float
    ) -> list[tuple[int, Narrowed]]:
        """The sums of some of the views that :meth:`add` would add, for :meth:`add_sums` on any device of the kind.

        Args:
            cameras: of all the views.
            places: of those that are meant among them, ascending.
            target: the pictures of these. unit: as of :meth:`add`.

        Returns:
            Each view's place, and (9 stride,) int64.
        """
        found, pixels = [], 0
        for group in self._launches(cameras):
            own = [place for place in places if place in group]
            if not own:
                continue
            views = self._prepared([cameras[place] for place in own])
            self._reserve(views)
            self._sweep_over(views, target, pixels, _scale([cameras[place] for place in group]), unit)
            pixels += views.pixels
            count = _SUMS // 8 * views.stride
            for number, place in enumerate(own):
                narrowed = self._narrowing.download(self._totals.buffer, (count,), number * count)
                found.append((place, replace(narrowed, data=narrowed.data.copy())))
            self._device.fill(self._totals.buffer, np.uint32(0), 8 * count * len(own))
        return found

    def add_sums(self, cameras: Sequence[Camera], sums: Sequence[tuple[int, Narrowed]], unit: float) -> None:
        """:meth:`add` views of which all sums are known: the same bits."""
        known = dict(sums)
        for group in self._launches(cameras):
            some = [cameras[place] for place in group]
            self._shown = views = self.rasterizer.projected(some, self._shown)
            self._reserve(views)
            nbytes = _SUMS * views.stride
            self._arrived.reserve(nbytes)
            for number, place in enumerate(group):
                self._narrowing.upload(self._arrived.buffer, known[place])
                cl.enqueue_copy(
                    self._device.queue, self._totals.buffer, self._arrived.buffer, byte_count=nbytes,
                    dst_offset=number * nbytes,
                )  # fmt: skip
            self._follow(views, _scale(some) * unit)

    def _launches(self, cameras: Sequence[Camera]) -> list[range]:
        """Places of the views that a launch does."""
        most = self._sweep.most_views
        return [range(first, min(first + most, len(cameras))) for first in range(0, len(cameras), most)]

    def _prepared(self, cameras: Sequence[Camera]) -> ViewSet:
        if self._views is None or not self.rasterizer.prepare_again(self._views, cameras):
            if self._views is not None:
                self._views.close()
                self._views = None
            self._views = self.rasterizer.prepare_set(cameras)
        return self._views

    def _reserve(self, views: ViewSet) -> None:
        if self._totals.reserve(_SUMS * views.stride * len(views.views)):
            # They become zero again whenever they have been used.
            self._device.fill(self._totals.buffer, np.uint32(0), self._totals.nbytes)
        if self._factors.reserve(4 * len(views.views)):
            self._written = None

    def _follow(self, views: ViewSet, scale: float) -> None:
        """From the sums, which were multiplied by this, to the gradient."""
        cameras = [view.camera for view in views.views]
        factors = [pixel_weight(camera) / scale for camera in cameras]
        if factors != self._written:  # whoever writes waits for the device
            written = np.array(factors, np.float32)
            cl.enqueue_copy(self._device.queue, self._factors.buffer, written, is_blocking=True)
            self._written = factors
        parameters = self.rasterizer.parameters
        self._chain.bind(
            **parameters.geometry,
            sh=parameters.sh,
            views=views.table,
            view_count=len(views.views),
            colours=views.colours,
            factors=self._factors.buffer,
            totals=self._totals.buffer,
            gradient=self.gradient,
        )
        lanes = self._sweep.lanes
        self._chain.launch((parameters.stride // lanes,), (SPLAT_GROUP // lanes,))

    def read(self) -> FloatArray:
        """(N, columns) float32, the gradient."""
        shape = (self.columns.count, self.rasterizer.stride)
        columns = self._device.download(self.gradient, shape, np.float32)
        return np.ascontiguousarray(columns[:, : self.rasterizer.splats].T)

    def _release(self) -> None:
        """Give back what the next call can make again."""
        for views in (self._views, self._shown):
            if views is not None:
                views.close()
        self._views = self._shown = None
        for scratch in (self._totals, self._factors, self._arrived, self._narrowing):
            scratch.close()

    def close(self) -> None:
        """Give all device memory back."""
        self._release()
        self._memory.close()
        self.rasterizer.close()


def _scale(cameras: Sequence[Camera]) -> float:
    """The fixed point of views that a launch does."""
    largest = max(_LARGEST_VALUE, _LARGEST_GAP * _LARGEST_SQUARE)
    return fixed_point_scale(max(each.width for each in cameras), max(each.height for each in cameras), largest)
