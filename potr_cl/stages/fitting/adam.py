"""Adam on a device (:class:`Adam`): steps down a gradient, for each parameter as long as its own history says."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec.quantize import LEAST_LOGIT, ZERO_SCALE, canonical_rotations
from potr_cl.host.threads import thread_pool
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


#: How fast the moments forget (Kingma and Ba, 2015), and the averages: after about so many steps.
_DECAY_MEAN, _DECAY_SQUARE = 0.9, 0.999
_AVERAGED = 50
#: Splats whose colours are turned from columns to rows at a time: few enough to stay in a cache.
_TURNED = 1 << 12


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
    """The parameters of a scene, the moments of their gradient, and their averages over the last steps.

    Each step goes down the gradient of a few views, and away from where others would have it: the parameters sway about
    what suits all. Their averages (Polyak and Juditsky, 1992) do not: on plush they are 0.9 dB nearer to its pictures.

    Args:
        scene: where the parameters begin.
        buffers: of a rasterizer that has this scene; each step writes the new parameters there.
        factors: what the rasterizer's scene is rounded with, while ``values`` are not; the scene has to be
            :func:`in_form_of_files` then. The gradient is taken for that of the parameters, as if nothing were rounded
            (the straight-through estimator of Bengio et al., 2013).

    Attributes:
        values: (columns, stride) float32, the parameters; quaternions of length 1 at first.
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
        self._device, self._scene, self.buffers, self.columns = device, scene, buffers, columns
        self._factors = factors
        # AC coefficients that stand still are left out: four fifths of all columns. Their average is what they are.
        self._moving = columns.count if rates.ac else columns.ac.start
        self._memory = Memory(device)
        with device.all_or_nothing():
            nbytes = 4 * columns.count * buffers.stride
            self.values = self._memory.allocate(nbytes, "the parameters")
            self._write_scene()
            self._kept = self._memory.allocate(nbytes, "the best parameters")
            self._moments = [self._memory.allocate(nbytes, "the gradient's moments") for _ in range(2)]
            self._averages = self._memory.allocate(nbytes, "the averages")
            self._begin()
            self._steps = self._memory.upload(_steps(columns, rates, limits), "the steps")
            self._activate, self._step = (device.shared_kernel("fit/adam.cl", name) for name in ("activate", "adam"))

    def restart(self) -> None:
        """Begin anew, and give the rasterizer its scene."""
        self.buffers.write_sh(self.buffers.sh, self._scene.sh)
        self._write_scene()
        self._begin()
        self.give()

    def _write_scene(self) -> None:
        """Set the parameters to the scene's; its colours lie in the rasterizer's buffers."""
        scene, columns, stride = self._scene, self.columns, self.buffers.stride
        geometry = np.zeros((columns.dc.start, stride), np.float32)
        some = slice(0, len(scene))
        geometry[columns.means, some] = scene.means.T
        geometry[columns.log_scales, some] = scene.log_scales.T
        geometry[columns.quaternions, some] = unit_quaternions(scene.quaternions).T
        geometry[columns.opacity_logits, some] = scene.opacity_logits
        self._device.copy(self.values, geometry)
        self._device.copy(self.values, self.buffers.sh, 4 * columns.sh * stride, to=geometry.nbytes)

    def _begin(self) -> None:
        """The moments and averages of parameters that have not moved."""
        self._taken = 0
        for moment in self._moments:
            self._device.fill(moment, np.float32(0), moment.size)
        self.keep()
        self._device.copy(self._averages, self.values)

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
        shape = self.columns.count, self.buffers.stride
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

    def kept(self) -> Scene:
        """The scene as it was when :meth:`keep` was called last. Splats that have not moved are the same bit by bit."""
        scene, columns, splats = self._scene, self.columns, len(self._scene)
        found = self._device.download(self._kept, (self._moving, self.buffers.stride), np.float32)[:, :splats]
        quaternions = np.ascontiguousarray(found[columns.quaternions].T)
        still = (quaternions == unit_quaternions(scene.quaternions).astype(np.float32)).all(axis=1)
        quaternions[still] = scene.quaternions[still]  # of any length
        sh = np.empty(scene.sh.shape, np.float32)
        coefficients = sh.reshape(splats, -1)
        moved = self._moving - columns.dc.start

        def turn(first: int) -> None:
            some = slice(first, first + _TURNED)
            coefficients[some, :moved] = found[columns.dc.start :, some].T
            coefficients[some, moved:] = scene.sh[some].reshape(-1, columns.sh)[:, moved:]

        with thread_pool() as pool:
            list(pool.map(turn, range(0, splats, _TURNED)))
        return Scene(
            np.ascontiguousarray(found[columns.means].T),
            np.ascontiguousarray(found[columns.log_scales].T),
            quaternions,
            found[columns.opacity_logits][0].copy(),
            sh,
            scene.antialiased,
            scene.low_pass,
        )


def in_form_of_files(scene: Scene) -> Scene:
    """The same splats, of their equivalent forms each in the one that a file has: what :class:`Factors` are for."""
    imaginary, log_scales = canonical_rotations(scene.quaternions, scene.log_scales)
    real = np.sqrt(np.maximum(1 - (imaginary**2).sum(axis=1), 0))
    quaternions = np.column_stack([real, imaginary]).astype(np.float32)
    return dataclasses.replace(scene, quaternions=quaternions, log_scales=log_scales)


def _steps(columns: Columns, rates: Rates, limits: Limits) -> FloatArray:
    """(columns, 4) as cl/fit/adam.cl takes them."""
    steps = np.zeros((columns.count, 4), np.float32)
    steps[:, 0] = rates.of_columns(columns)
    steps[:, 1], steps[:, 2] = -1e30, 1e30
    steps[columns.log_scales, 1:3] = limits.log_scales
    steps[columns.opacity_logits, 1:3] = limits.opacity_logits
    return steps
