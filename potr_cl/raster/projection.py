"""The first step of every view, each splat's ellipse and colour on screen: :class:`Projection`."""

from __future__ import annotations

import pyopencl as cl

from potr_cl.model.scene import LOW_PASS, FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rules import LEAST_COMPENSATION, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.raster.view_set import ViewSet


class Projection(Owner):
    """The projection of a scene's splats (cl/raster/project.cl), with the SH coefficients that they have now.

    Args:
        device: that computes.
        scene: on it; stays the caller's.
        rules: of the rasterizer to follow.
        lanes: how many splats a work-item does.

    Attributes:
        filter_macros: macros that a kernel needs which goes through the projection again; none unless the scene is
            antialiased.

    Raises:
        DeviceError: the kernel cannot be built.
    """

    def __init__(self, device: Device, scene: SceneBuffers, rules: RasterRules, lanes: int) -> None:
        self._scene, self._lanes = scene, lanes
        self._replaced: cl.Buffer | None = None  # other SH coefficients than the scene's
        self._other_sh = Memory(device)
        self.filter_macros = _filter_macros(scene)
        self._kernel = device.shared_kernel(
            "raster/project.cl",
            "project",
            LANES=lanes,
            SH_COUNT=scene.sh_count,
            NEAR=float(rules.near),
            SQUARE_EXTENT=int(rules.square_extent),
            **self.filter_macros,
            **scene.pick_macros,
        )

    def enqueue(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        """Enqueue the projection of views.

        Args:
            views: to project.
            bounds: takes (views, stride, 4) uint16, the tiles around each splat.
            sh: other coefficients than those that the splats have now.
            shapes, colours: other buffers than the views' own.
        """
        self._kernel.bind(
            **self._scene.geometry,
            **self._scene.picks,
            sh=self.sh if sh is None else sh,
            views=views.table,
            shapes=views.shapes if shapes is None else shapes,
            colours=views.colours if colours is None else colours,
            bounds=bounds,
        )
        self._kernel.launch((self._scene.stride // self._lanes, len(views.views)), (SPLAT_GROUP // self._lanes, 1))

    @property
    def sh(self) -> cl.Buffer:
        """The SH coefficients that splats have now, as :class:`~potr_cl.raster.scene_buffers.SceneBuffers` has them."""
        return self._scene.sh if self._replaced is None else self._replaced

    def replace_sh(self, sh: FloatArray) -> cl.Buffer | None:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Returns:
            The buffer of the former coefficients, which is the caller's to free; None if they are the scene's own.
        """
        former = self._replaced
        self._replaced = self._scene.other_sh(self._other_sh, sh)
        return None if former is None else self._other_sh.release(former)

    def close(self) -> None:
        self._other_sh.close()


def _filter_macros(scene: SceneBuffers) -> dict[str, float]:
    """Macros of the projection that an antialiased scene needs; the kernel of classic ones has no trace of it."""
    if not scene.antialiased:
        return {}
    macros = {"ANTIALIASED": 1, "LEAST_COMPENSATION_SQUARED": LEAST_COMPENSATION**2}
    if scene.low_pass != LOW_PASS:
        macros |= {"LOW_PASS": scene.low_pass, "LOW_PASS_SQUARED": scene.low_pass**2}
    return macros
