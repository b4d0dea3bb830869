"""Adam on a device (:class:`Adam`): steps down a gradient, for each parameter as long as its own history says."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.stages.fitting.derivatives import Columns
from potr_cl.stages.fitting.parameters import UNROUNDED, Factors, Parameters

#: How fast the moments forget (Kingma and Ba, 2015), and the averages: after about so many steps.
_DECAY_MEAN, _DECAY_SQUARE = 0.9, 0.999
_AVERAGED = 50


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


class Adam(Parameters):
    """The parameters of a scene, the moments of their gradient, and their averages over the last steps.

    Each step goes down the gradient of a few views, and away from where others would have it: the parameters sway about
    what suits all. Their averages (Polyak and Juditsky, 1992) do not: on plush they are 0.9 dB nearer to its pictures.

    Args:
        device: to compute on.
        scene: where the parameters begin.
        buffers: of a rasterizer that has this scene; each step writes the new parameters there.
        columns: which parameter is in which column.
        rates: of a step.
        limits: of the parameters.
        factors: what the rasterizer's scene is rounded with; the gradient is taken for that of the parameters, as if
            nothing were (the straight-through estimator of Bengio et al., 2013).

    Raises:
        DeviceError: it does not fit the device, or the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        buffers: SceneBuffers,
        columns: Columns,
        rates: Rates,
        limits: Limits,
        factors: Factors = UNROUNDED,
    ) -> None:
        super().__init__(device, scene, buffers, columns, factors)
        self._taken = 0
        # AC coefficients that stand still are left out: four fifths of all columns. Their average is what they are.
        self._moving = columns.count if rates.ac else columns.ac.start
        try:
            nbytes = self.values.size
            self._moments = [self._memory.allocate(nbytes, "the gradient's moments") for _ in range(2)]
            for moment in self._moments:
                device.fill(moment, np.float32(0), nbytes)
            self._averages = self._memory.upload(self._start, "the averages")
            self._steps = self._memory.upload(_steps(columns, rates, limits), "the steps")
            self._step = device.shared_kernel("fit/adam.cl", "adam")
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
        buffers, columns = self.buffers, self.columns
        self._step.bind(
            parameters=self.values,
            gradient=gradient,
            means=self._moments[0],
            squares=self._moments[1],
            averages=self._averages,
            sh=buffers.sh,
            splats=buffers.splats,
            stride=buffers.stride,
            first_sh=columns.dc.start,
            steps=self._steps,
            part=part,
            decay_mean=_DECAY_MEAN,
            decay_square=_DECAY_SQUARE,
            newest=max(1 / (1 + self._taken), 1 / _AVERAGED),
            debias_mean=1 / (1 - _DECAY_MEAN**self._taken),
            debias_square=1 / (1 - _DECAY_SQUARE**self._taken),
        )
        self._step.launch((buffers.stride, self._moving), (SPLAT_GROUP, 1))
        self.give(colours=False)

    def state(self) -> list[FloatArray]:
        """All numbers that the next steps depend on, for :meth:`adopt`."""
        shape = self._start.shape
        return [self._device.download(buffer, shape, np.float32) for buffer in self._moving_buffers]

    def adopt(self, taken: int, state: Sequence[FloatArray]) -> None:
        """Go on from where another one was after so many steps."""
        self._taken = taken
        for buffer, values in zip(self._moving_buffers, state, strict=True):
            cl.enqueue_copy(self._device.queue, buffer, values, is_blocking=True)
        self.give()

    @property
    def _moving_buffers(self) -> list[cl.Buffer]:
        return [self.values, *self._moments, self._averages]

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Within it the rasterizer has the averages for its scene, and :meth:`keep` remembers them."""
        moving = self.values
        self.values = self._averages
        self.give()
        try:
            yield
        finally:
            self.values = moving
            self.give()


def _steps(columns: Columns, rates: Rates, limits: Limits) -> FloatArray:
    """(columns, 4) as cl/fit/adam.cl takes them."""
    steps = np.zeros((columns.count, 4), np.float32)
    steps[:, 0] = rates.of_columns(columns)
    steps[:, 1], steps[:, 2] = -1e30, 1e30
    steps[columns.log_scales, 1:3] = limits.log_scales
    steps[columns.opacity_logits, 1:3] = limits.opacity_logits
    return steps
