"""The parameters of a scene that a fit changes, on a device: :class:`Parameters`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from potr_cl.codec.quantize import LEAST_LOGIT, ZERO_SCALE, canonical_rotations
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.activation import LARGEST_SCALE, unit_quaternions
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.stages.fitting.derivatives import Columns


@dataclass(frozen=True)
class Factors:
    """What a file rounds shapes and opacities with: a step is 1 / factor. 0: they are not rounded.

    Attributes:
        scale: of standard deviations, world units.
        rotation: of quaternions, times the root of the splat's largest scale level.
        opacity: of logits.
    """

    scale: float = 0.0
    rotation: float = 0.0
    opacity: float = 0.0


UNROUNDED = Factors()


class Parameters(Owner):
    """All parameters of a scene's splats, as a solver moves them.

    Args:
        device: that they lie on.
        scene: where they begin.
        buffers: of a rasterizer that has this scene.
        columns: which parameter is in which column.
        factors: what :meth:`give` rounds with; ``values`` are never rounded. The scene has to be
            :func:`in_form_of_files` then.

    Attributes:
        buffers, columns: as given.
        values: (columns, stride) float32, the parameters; quaternions of length 1 at first.

    Raises:
        DeviceError: they do not fit the device, or the kernels cannot be built.
    """

    def __init__(
        self, device: Device, scene: Scene, buffers: SceneBuffers, columns: Columns, factors: Factors = UNROUNDED
    ) -> None:
        self._device, self._scene, self.buffers, self.columns = device, scene, buffers, columns
        self._factors = factors
        self._start = _columns_of(scene, columns, buffers.stride)
        self._memory = Memory(device)
        try:
            self.values = self._memory.upload(self._start, "the parameters")
            self._kept = self._memory.upload(self._start, "the best parameters")
            self._activate = device.shared_kernel("fit/adam.cl", "activate")
        except BaseException:
            self.close()
            raise

    def give(self, colours: bool = True) -> None:
        """Write the parameters to the rasterizer's buffers, as its projection takes them.

        Args:
            colours: whether also the SH coefficients, which lie there just as they do here.
        """
        buffers = self.buffers
        self._activate.bind(
            parameters=self.values,
            splats=buffers.splats,
            stride=buffers.stride,
            sh_columns=self.columns.sh if colours else 0,
            largest_scale=LARGEST_SCALE,
            sf_scale=self._factors.scale,
            zero_scale=ZERO_SCALE,
            sf_rotation=self._factors.rotation,
            sf_opacity=self._factors.opacity,
            least_logit=LEAST_LOGIT,
            means=buffers.means,
            scales=buffers.scales,
            quaternions=buffers.quaternions,
            log2_opacities=buffers.log2_opacities,
            sh=buffers.sh,
        )
        self._activate.launch((buffers.stride,), (SPLAT_GROUP,))

    def keep(self) -> None:
        """Remember the parameters as they are, in place of what was remembered before."""
        cl.enqueue_copy(self._device.queue, self._kept, self.values)

    def back(self) -> None:
        """Go back to the parameters as they were when :meth:`keep` was called last, or at first."""
        cl.enqueue_copy(self._device.queue, self.values, self._kept)
        self.give()

    def kept(self) -> Scene:
        """The scene as it was when :meth:`keep` was called last. Splats that have not moved are the same bit by bit."""
        columns = self.columns
        found = self._device.download(self._kept, self._start.shape, np.float32)
        moved = np.flatnonzero((found != self._start)[:, : len(self._scene)].any(axis=0))
        rows = found[:, moved].T
        scene = self._scene
        arrays = {}
        for name in ("means", "log_scales", "quaternions", "opacity_logits"):
            former = getattr(scene, name)
            arrays[name] = former.copy()
            arrays[name][moved] = rows[:, getattr(columns, name)].reshape(len(moved), *former.shape[1:])
        sh = np.array(scene.sh, np.float32)
        sh[moved] = rows[:, 11:].reshape(len(moved), *sh.shape[1:])
        return Scene(**arrays, sh=sh, antialiased=scene.antialiased, low_pass=scene.low_pass)

    def close(self) -> None:
        """Give all device memory back."""
        self._memory.close()


def in_form_of_files(scene: Scene) -> Scene:
    """The same splats, of their equivalent forms each in the one that a file has: what :class:`Factors` are for."""
    imaginary, log_scales = canonical_rotations(scene.quaternions, scene.log_scales)
    real = np.sqrt(np.maximum(1 - (imaginary**2).sum(axis=1), 0))
    quaternions = np.column_stack([real, imaginary]).astype(np.float32)
    return dataclasses.replace(scene, quaternions=quaternions, log_scales=log_scales)


def _columns_of(scene: Scene, columns: Columns, stride: int) -> FloatArray:
    """(columns, stride) the parameters of a scene; quaternions of length 1."""
    result = np.zeros((columns.count, stride), np.float32)
    some = slice(0, len(scene))
    result[columns.means, some] = scene.means.T
    result[columns.log_scales, some] = scene.log_scales.T
    result[columns.quaternions, some] = unit_quaternions(scene.quaternions).T
    result[columns.opacity_logits, some] = scene.opacity_logits
    result[11:, some] = scene.sh.reshape(len(scene), -1).T
    return result
