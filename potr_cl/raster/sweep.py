"""Kernels that sweep over the tiles of prepared views and add exact totals: :class:`TileSweep`, macros, units."""

from __future__ import annotations

import math
from typing import Any

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import TILE, ViewSet, camera_struct

#: Work-items of a tile's work-group on a GPU, and views of a launch there at most: at its end the longest tile list
#: keeps one work-group busy when all others are done, so one launch is quicker than several. A CPU does one view at a
#: time, a work-item a tile.
_GROUP, _MOST_VIEWS = 128, 128


def sweep_limits(device: Device) -> dict[str, int]:
    """Macros of a sweep that depend on what a device can do (cl/include/subtile_lists.clh, subtile_vectors.clh)."""
    gpu = device.family == "gpu"
    own = {"NATIVE_EXP2": int(device.native_exp2)} if gpu else {"LANES": max(device.vector_width, 8)}
    return own | totals_limits(device)


def totals_limits(device: Device) -> dict[str, int]:
    """Macros of the kernels with exact totals (cl/include/totals.clh)."""
    extensions = device.info.handle.extensions.split()
    # totals.clh has the low word first: where the device has the high one first, 64-bit additions would mix them up.
    int64 = "cl_khr_int64_base_atomics" in extensions and device.info.handle.endian_little
    return {"INT64_ATOMICS": int(int64)}


def padded_area(width: int, height: int) -> int:
    """Pixels of all tiles of a view, at the most."""
    return (width + TILE - 1) * (height + TILE - 1)


def fixed_point_scale(width: int, height: int, largest: float) -> float:
    """What sums over a view's pixels are multiplied by: the largest power of two with which 62 bits suffice.

    Args:
        width, height: of the view in pixels.
        largest: what a pixel adds at most.
    """
    return 2.0 ** math.floor(62 - math.log2(largest * padded_area(width, height)))


def most_views(device: Device) -> int:
    """Views that a launch over tiles does at most."""
    return _MOST_VIEWS if device.family == "gpu" else 1


class TileSweep:
    """A kernel that goes over the tiles of some views, in a program for each family.

    Args:
        device: to run on.
        rules: of the rasterizer.
        source: of the program; the family and ``.cl`` follow.
        kernel: its name.
        macros: of the program, besides those of all sweeps.

    Attributes:
        lanes: splats a work-item, in kernels that go over splats.
        most_views: that a launch can do.
    """

    def __init__(self, device: Device, rules: RasterRules, source: str, kernel: str, **macros: float) -> None:
        self._gpu = device.family == "gpu"
        self.lanes, self.most_views = 1 if self._gpu else device.vector_width, most_views(device)
        self._kernel = device.shared_kernel(
            f"{source}_{device.family}.cl",
            kernel,
            ALPHA_CAP=float(rules.alpha_cap),
            TRANSMITTANCE_THRESHOLD=rules.transmittance_threshold,
            **macros,
            **sweep_limits(device),
        )

    def run(
        self,
        views: ViewSet,
        shapes: cl.Buffer,
        colours: cl.Buffer,
        background: tuple[float, float, float],
        **arguments: Any,
    ) -> None:
        """Enqueue it.

        Args:
            views: prepared.
            shapes: (views, stride, 8) float32, theirs.
            colours: (views, stride, 4) float32, R, G, B of each splat in each view.
            background: R, G, B behind the splats.
            arguments: what else the kernel takes.
        """
        of_family: dict[str, Any] = {"views": views.table, "stride": views.stride}
        if not self._gpu:
            of_family = {"view": camera_struct(views.views[0].camera)}
        kernel = self._kernel.bind(
            **of_family,
            shapes=shapes,
            colours=colours,
            offsets=views.offsets,
            intersections=views.intersections,
            subtiles=views.subtiles,
            red=background[0],
            green=background[1],
            blue=background[2],
            **arguments,
        )
        if self._gpu:
            # A work-group for each tile of the largest view, in every view: those beyond a view's tiles do nothing.
            most = max(view.tiles for view in views.views)
            kernel.launch((most * _GROUP, len(views.views)), (_GROUP, 1))
        else:
            kernel.launch((views.tiles,), (1,))
