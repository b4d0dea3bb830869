"""A large scene on a GPU while splats are removed from it, and colours change: :class:`ShrinkingScene`."""

from __future__ import annotations

from collections.abc import Callable

import pyopencl as cl

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.picked_splats import PickedSplats
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.pruning.fixed_point import FixedPoint
from potr_cl.stages.pruning.launcher import SweepLauncher, launcher_for
from potr_cl.stages.pruning.survivors import Survivors
from potr_cl.stages.pruning.sweep_options import SweepOptions


class ShrinkingScene(Owner):
    """What all views of the scene are measured with, each with the splats that it may draw.

    Args:
        device: that computes.
        whole: the uncompressed scene on it.
        options: speed/accuracy trade-offs of the sweeps.
        fixed_point: units of what they measure.
        background: R, G, B behind the scene.
        wait: returns once the device has finished what was enqueued.

    Attributes:
        device, whole, options, fixed_point: as given.
        survivors: the splats that are left.
        pristine: whether these are all, and have the colours of the target pictures.

    Raises:
        DeviceError: the device has no room.
    """

    def __init__(
        self,
        device: Device,
        whole: SceneBuffers,
        options: SweepOptions,
        fixed_point: FixedPoint,
        background: tuple[float, float, float],
        wait: Callable[[], None],
    ) -> None:
        self.device, self.whole, self.options = device, whole, options
        self.fixed_point, self._background = fixed_point, background
        self._colours = Memory(device)
        self._sh: cl.Buffer | None = None  # other coefficients than those of the targets
        self._preparing = PreparingMemory(device)
        self.survivors = Survivors(device, whole.splats, whole.stride, wait)
        self.pristine = True

    def rasterizer(self, numbers: cl.Buffer, splats: int, former: bool = False) -> Rasterizer:
        """Of some splats, with the colours that they have now.

        Args:
            numbers: of the splats, uint32, in the device's memory; splats: how many they are.
            former: with the colours of the target pictures instead.
        """
        picked = PickedSplats(self.whole, numbers, splats)
        if self._sh is not None and not former:
            picked.sh = self._sh
        return Rasterizer(self.device, picked, background=self._background, preparing=self._preparing)

    def launcher(self, rasterizer: Rasterizer) -> SweepLauncher:
        """The removal kernels for views that a rasterizer of this scene has prepared."""
        return launcher_for(rasterizer, self.options, self.fixed_point)

    def replace_sh(self, sh: FloatArray) -> tuple[cl.Buffer, cl.Buffer | None]:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Returns:
            Their buffer; and that of the former ones, which :meth:`free` takes when nobody needs it any more. None: it
            is the uncompressed scene's.
        """
        former, self._sh = self._sh, self.whole.other_sh(self._colours, sh)
        self.pristine = False
        return self._sh, former

    def free(self, former: cl.Buffer | None) -> None:
        """Give coefficients back that were replaced."""
        if former is not None:
            self._colours.free(former)

    def finish(self) -> None:
        """Wait for the device.

        Raises:
            DeviceError: it failed.
        """
        with self.device.errors("failed while computing"):
            self.device.queue.finish()

    def close(self) -> None:
        for owner in (self.survivors, self._preparing, self._colours):
            owner.close()
