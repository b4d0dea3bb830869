"""How a scene's pictures change when its parameters change along a direction: :class:`PictureTangents`.

With J the derivatives of all pixels of some views, it finds J x, where :mod:`potr_cl.stages.fitting.derivatives` finds
Jᵀ W v. The same numbers are taken as constant, so that one is the other's transpose (but for the weights W). A view
takes two steps:

1. ``splat_tangents`` goes from the parameters to nine numbers for each splat (cl/fit/splat_tangents.cl);
2. ``tangents`` composites these, front to back (cl/fit/tangents_cpu.cl and its twin).
"""

from __future__ import annotations

import pyopencl as cl

from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.fitting.launcher import launcher_for
from potr_cl.stages.fitting.pixel_sums import PixelTangents

#: Bytes of a splat's numbers in a view: three float4.
SPLAT_CHANGES = 48


class PictureTangents(Owner):
    """J x of one scene, whose parameters may change on the device between two calls.

    Args:
        device: to compute on.
        rasterizer: of the scene; it prepares the views.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._launcher = launcher_for(device, rasterizer.rules)
        self._changes = Scratch(device, "the splats' changes")
        self._splats = device.shared_kernel(
            "fit/splat_tangents.cl",
            "splat_tangents",
            LANES=self._launcher.lanes,
            SH_COUNT=rasterizer.parameters.sh_count,
            **rasterizer.filter_macros,
        )

    def of(self, views: ViewSet, direction: cl.Buffer, result: cl.Buffer, first_pixel: int = 0) -> None:
        """Enqueue J x of prepared views, one or, for GPU kernels, several.

        Args:
            views: prepared since the parameters changed last.
            direction: x, (columns, stride) float32, ordered as the gradient of
                :class:`potr_cl.stages.fitting.derivatives.PictureDerivatives`. Quaternions are of length 1; along
                themselves nothing changes.
            result: (pixels, 3) float32, gets the views' J x, one behind the other.
            first_pixel: where they begin there.

        Raises:
            DeviceError: it does not fit the device, or the device failed.
        """
        parameters, lanes = self._rasterizer.parameters, self._launcher.lanes
        self._changes.reserve(SPLAT_CHANGES * views.stride * len(views.views))
        self._splats.bind(
            **parameters.geometry,
            sh=parameters.sh,
            views=views.table,
            colours=views.colours,
            direction=direction,
            tangents=self._changes.buffer,
        )
        self._splats.launch((parameters.stride // lanes, len(views.views)), (SPLAT_GROUP // lanes, 1))
        self._launcher.tangents(
            PixelTangents(views, self._rasterizer.background, self._changes.buffer, first_pixel, result)
        )

    def close(self) -> None:
        """Give all device memory back."""
        self._changes.close()
