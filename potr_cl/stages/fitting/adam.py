"""Adam on a device (:class:`Adam`): steps down a gradient, for each parameter as long as its own history says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.activation import LARGEST_SCALE, unit_quaternions
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.stages.fitting.derivatives import Columns

#: How fast the moments forget (Kingma and Ba, 2015).
_DECAY_MEAN, _DECAY_SQUARE = 0.9, 0.999


@dataclass(frozen=True)
class Rates:
    """The length of a step for each kind of parameter.

    Attributes:
        means: in world units. log_scales, quaternions, opacity_logits: of the parameter.
        dc, ac: of the SH coefficients.
    """

    means: float
    log_scales: float
    quaternions: float
    opacity_logits: float
    dc: float
    ac: float

    def of_columns(self, columns: Columns) -> NDArray[np.float64]:
        """(columns,) the same by column."""
        rates = np.zeros(columns.count)
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "dc", "ac"):
            rates[getattr(columns, name)] = getattr(self, name)
        return rates


@dataclass(frozen=True)
class Limits:
    """What parameters stay between once they move.

    Attributes:
        log_scales, opacity_logits: least and greatest.
    """

    log_scales: tuple[float, float]
    opacity_logits: tuple[float, float]


class Adam(Owner):
    """The parameters of a scene on a device, and the moments of their gradient.

    Args:
        device: to compute on.
        scene: where the parameters begin.
        buffers: of a rasterizer that has this scene; each step writes the new parameters there.
        columns: which parameter is in which column.
        rates: of a step.
        limits: of the parameters.

    Raises:
        DeviceError: it does not fit the device, or the kernels cannot be built.
    """

    def __init__(
        self, device: Device, scene: Scene, buffers: SceneBuffers, columns: Columns, rates: Rates, limits: Limits
    ) -> None:
        self._device, self._scene, self._buffers, self._columns = device, scene, buffers, columns
        self._start = _columns_of(scene, columns, buffers.stride)
        self._taken = 0
        self._memory = Memory(device)
        try:
            nbytes = self._start.nbytes
            self._parameters = self._memory.upload(self._start, "the parameters")
            self._kept = self._memory.upload(self._start, "the best parameters")
            self._moments = [self._memory.allocate(nbytes, "the gradient's moments") for _ in range(2)]
            for moment in self._moments:
                cl.enqueue_fill_buffer(device.queue, moment, np.float32(0), 0, nbytes)
            self._steps = self._memory.upload(_steps(columns, rates, limits), "the steps")
            self._step = device.shared_kernel("fit/adam.cl", "adam")
            self._activate = device.shared_kernel("fit/adam.cl", "activate")
        except BaseException:
            self.close()
            raise

    def step(self, gradient: cl.Buffer, part: float) -> None:
        """Take a step, and give the rasterizer its scene.

        Args:
            gradient: (columns, stride) float32; becomes 0.
            part: of the rates that this step is long.
        """
        self._taken += 1
        buffers, columns = self._buffers, self._columns
        self._step.bind(
            parameters=self._parameters,
            gradient=gradient,
            means=self._moments[0],
            squares=self._moments[1],
            splats=buffers.splats,
            stride=buffers.stride,
            steps=self._steps,
            part=part,
            decay_mean=_DECAY_MEAN,
            decay_square=_DECAY_SQUARE,
            debias_mean=1 / (1 - _DECAY_MEAN**self._taken),
            debias_square=1 / (1 - _DECAY_SQUARE**self._taken),
        )
        self._step.launch((buffers.stride, columns.count), (SPLAT_GROUP, 1))
        self._give()

    def _give(self) -> None:
        """Write the parameters to the rasterizer's buffers, as its projection takes them."""
        buffers = self._buffers
        self._activate.bind(
            parameters=self._parameters,
            splats=buffers.splats,
            stride=buffers.stride,
            sh_columns=self._columns.sh,
            largest_scale=LARGEST_SCALE,
            means=buffers.means,
            scales=buffers.scales,
            quaternions=buffers.quaternions,
            log2_opacities=buffers.log2_opacities,
            sh=buffers.sh,
        )
        self._activate.launch((buffers.stride,), (SPLAT_GROUP,))

    def keep(self) -> None:
        """Remember the parameters as they are, in place of what was remembered before."""
        cl.enqueue_copy(self._device.queue, self._kept, self._parameters)

    def kept(self) -> Scene:
        """The scene as it was when :meth:`keep` was called last. Splats that have not moved are the same bit by bit."""
        columns = self._columns
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


def _steps(columns: Columns, rates: Rates, limits: Limits) -> FloatArray:
    """(columns, 4) as cl/fit/adam.cl takes them."""
    steps = np.zeros((columns.count, 4), np.float32)
    steps[:, 0] = rates.of_columns(columns)
    steps[:, 1], steps[:, 2] = -1e30, 1e30
    steps[columns.log_scales, 1:3] = limits.log_scales
    steps[columns.opacity_logits, 1:3] = limits.opacity_logits
    return steps


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
