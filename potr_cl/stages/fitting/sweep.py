"""The fit's sweep over the tiles of prepared views, cl/fit/derivatives_*.cl: :class:`Sweep`."""

from __future__ import annotations

from typing import Any

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.macros import sweep_limits
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import ViewSet, camera_struct
from potr_cl.stages.fitting.fixed_point import LARGEST_GAP, LARGEST_VALUE

#: Work-items of a tile's work-group on a GPU, and views of a launch there. A CPU does one view at a time, a work-item a
#: tile.
_GROUP, _MOST_VIEWS = 128, 32


class Sweep:
    """The kernel of one device.

    Args:
        device: to run on.
        rules: of the rasterizer.

    Attributes:
        lanes: splats a work-item, in kernels that go over splats.
        most_views: that a launch can do.

    Raises:
        DeviceError: the kernel cannot be built.
    """

    def __init__(self, device: Device, rules: RasterRules) -> None:
        self._gpu = device.family == "gpu"
        self.lanes, self.most_views = (1, _MOST_VIEWS) if self._gpu else (device.vector_width, 1)
        self._kernel = device.shared_kernel(
            f"fit/derivatives_{device.family}.cl",
            "derivatives",
            ALPHA_CAP=float(rules.alpha_cap),
            TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
            LARGEST_VALUE=LARGEST_VALUE,
            LARGEST_GAP=LARGEST_GAP,
            **sweep_limits(device),
        )

    def run(
        self,
        views: ViewSet,
        background: tuple[float, float, float],
        target: cl.Buffer,
        first_pixel: int,
        given: bool,
        unit: float,
        scale: float,
        totals: cl.Buffer,
    ) -> None:
        """Enqueue the sums of cl/fit/sums.clh over the pixels of some views.

        Args:
            views: prepared, with their geometry.
            background: R, G, B behind the splats.
            target: (pixels, 3) float32, view after view; theirs begin at ``first_pixel``.
            given: whether these are the numbers v that pixels are multiplied by; if not, v is the picture's difference
                to the target, times ``unit``.
            scale: the views' fixed point.
            totals: (views, stride, 9) int64, the sums are added to them.

        Raises:
            DeviceError: the device refused it.
        """
        of_family: dict[str, Any] = {"views": views.table, "stride": views.stride}
        if not self._gpu:
            of_family = {"view": camera_struct(views.views[0].camera)}
        kernel = self._kernel.bind(
            **of_family,
            shapes=views.shapes,
            colours=views.colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=background[0],
            green=background[1],
            blue=background[2],
            target=target,
            first_pixel=first_pixel,
            given=given,
            unit=unit,
            scale=scale,
            totals=totals,
        )
        if self._gpu:
            # A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing.
            most = max(view.tiles for view in views.views)
            kernel.launch((most * _GROUP, len(views.views)), (_GROUP, 1))
        else:
            kernel.launch((views.tiles,), (1,))
