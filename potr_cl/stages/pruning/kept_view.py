"""A view of a large scene that stays prepared, with the splats that it may draw: :class:`KeptView`."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.launcher import SetKernels
from potr_cl.stages.pruning.prepared_views import PreparedSet


@dataclass(frozen=True)
class View:
    """A view, and what it may draw.

    Attributes:
        number: among all views.
        camera: of the view.
        splats: how many it may draw.
        numbers: of these in the scene, uint32, ascending, in the device's memory.
    """

    number: int
    camera: Camera
    splats: int
    numbers: cl.Buffer


class KeptView(Owner):
    """A view that stays prepared.

    Args:
        view: which one.
        prepared: its lists and sums; this object's from now on.
        memory: that owns what else it takes; this object's from now on.
        rasterizer: that prepared it.
        kernels: with all arguments bound.
    """

    def __init__(
        self, view: View, prepared: PreparedSet, memory: Memory, rasterizer: Rasterizer, kernels: SetKernels
    ) -> None:
        self.view, self.prepared, self.rasterizer = view, prepared, rasterizer
        self._memory, self._kernels = memory, kernels

    def sweep(self, count: int, queue: cl.CommandQueue) -> None:
        """Enqueue the sweep of the first tiles of its list."""
        self._kernels.sweep(self.prepared.first_tile, count, queue)

    def target_is_known(self) -> None:
        """From now on, sweeps compare with the target picture."""
        self._kernels.target_is_known()

    def note_removal(self, tolerance: float, queue: cl.CommandQueue) -> None:
        """Enqueue that it notes which splats have gone, and lists the tiles that are staler than the tolerance."""
        self._kernels.note_removal(queue, list_above=tolerance)

    def close(self) -> None:
        self.prepared.close()
        self._memory.close()
        self.rasterizer.close()
