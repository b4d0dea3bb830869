"""The re-fit's sweep over the tiles of prepared views, cl/refit/refit_cpu.cl and refit_gpu.cl: :class:`Sweep`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.macros import gpu_limits, totals_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet, camera_struct
from potr_cl.stages.refitting.fixed_point import LARGEST_VALUE, fixed_point_scale

#: Work-items of a tile's work-group on a GPU, and views of a launch there. A CPU does one view at a time, a work-item a
#: tile.
_GROUP, _MOST_VIEWS = 128, 32
#: On CPUs, launches whose sums are gathered together: the coefficients' sums, which take much more than a view's, go
#: through the memory once for so many views.
_GATHERED = 4


class Sweep:
    """The kernels of one device.

    Args:
        device: to run on.
        rules: of the rasterizer.

    Attributes:
        lanes: splats a work-item, in kernels that go over splats.
        most_views: that a launch can do.
        gathered: launches whose sums are gathered together, where each does one view.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self._gpu = device.family == "gpu"
        self.lanes = 1 if self._gpu else device.vector_width
        self.most_views, self.gathered = (_MOST_VIEWS, 1) if self._gpu else (1, _GATHERED)
        of_family: dict[str, Any] = {"LANES": max(device.vector_width, 8), **totals_limits(device)}
        if self._gpu:
            of_family = gpu_limits(device)
        self._kernels = [
            device.shared_kernel(
                "refit/refit_gpu.cl" if self._gpu else "refit/refit_cpu.cl",
                "refit_sweep",
                ALPHA_CAP=float(rules.alpha_cap),
                TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
                LARGEST_VALUE=LARGEST_VALUE,
                WEIGHTS=weights,
                **of_family,
            )
            for weights in (0, 1)
        ]

    def fixed_point_scales(self, cameras: Sequence[Camera]) -> list[float]:
        """What the sums of each view are multiplied by, see :func:`.fixed_point.fixed_point_scale`.

        Args:
            cameras: all views; those that a launch does have one scale.
        """
        if not self._gpu:
            return [fixed_point_scale(camera.width, camera.height) for camera in cameras]
        # With it no view can overflow, whichever a launch does together.
        scale = fixed_point_scale(max(c.width for c in cameras), max(c.height for c in cameras))
        return [scale] * len(cameras)

    def run(
        self,
        views: ViewSet,
        shapes: cl.Buffer,
        colours: cl.Buffer,
        background: tuple[float, float, float],
        target: cl.Buffer | None,
        scale: float,
        errors: cl.Buffer,
        totals: cl.Buffer,
        weights: bool,
    ) -> None:
        """Enqueue a sweep: from the splats' colours to the pixels' values, and from those to sums for each splat.

        Args:
            views: prepared.
            shapes: (views, stride, 8) float32, theirs.
            colours: (views, stride, 4) float32, R, G, B of each splat in each view.
            background: R, G, B behind the splats.
            target: (pixels, 3) float32, view after view: subtracted from the pixels; None: nothing is.
            scale: the views' fixed point.
            errors: (tiles,) float32, becomes each tile's sum of squared pixel values.
            totals: (views, stride, 4) int64: weight times value, three channels, and the squared weights are added.
            weights: sum up the squared weights too.

        Raises:
            DeviceError: the device refused it.
        """
        of_family: dict[str, Any] = {"views": views.table, "stride": views.stride}
        if not self._gpu:
            of_family = {"view": camera_struct(views.views[0].camera)}
        kernel = self._kernels[weights].bind(
            **of_family,
            shapes=shapes,
            colours=colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=background[0],
            green=background[1],
            blue=background[2],
            target=colours if target is None else target,
            has_target=target is not None,
            scale=scale,
            errors=errors,
            totals=totals,
        )
        if self._gpu:
            most = max(view.tiles for view in views.views)
            kernel.launch((most * _GROUP, len(views.views)), (_GROUP, 1))
        else:
            kernel.launch((views.tiles,), (1,))
