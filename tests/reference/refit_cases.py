"""Scenes to re-fit on a device and in float64, and the device's vectors laid open beside the definition's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions, Refitted
from potr_cl.stages.refitting.sliced_arrays import Ridge
from potr_cl.views.targets import RenderedTargets, Targets
from tests.reference.refit import Array, Reference


class Case:
    """A scene to re-fit to the pictures of another."""

    def __init__(
        self,
        device: Device,
        scene: Scene,
        other: Scene,
        cameras: Sequence[Camera],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.device, self.scene, self.cameras, self.background = device, scene, cameras, background
        self.rasterizer = Rasterizer(device, other, background=background)
        self.pictures = [self.rasterizer.render(c)[0] for c in cameras]
        self.targets = RenderedTargets(self.rasterizer, cameras)

    def reference(self, **changes: Any) -> Reference:
        return Reference(self.scene, self.cameras, self.pictures, background=self.background, **changes)

    def solve(self, options: RefitOptions, active: NDArray[np.bool_] | None = None) -> Refitted:
        return refit_colours(
            self.device, self.scene, self.cameras, self.targets, options, active, background=self.background
        )

    def __enter__(self) -> Case:
        return self

    def __exit__(self, *_: object) -> None:
        self.rasterizer.close()


def as_rows(vectors: Coefficients, x: Vector) -> Array:
    """(N, M, 3) in Y, Co, Cg, a vector."""
    return vectors.read(x).reshape(-1, 3, vectors.layout.splats).transpose(2, 0, 1).astype(np.float64)


def unpacked(blocks: SplatBlocks) -> Array:
    """(N, M, M) the splats' own blocks."""
    packed = blocks.packed()
    sh_count = blocks.diagonals().shape[1]
    found = np.empty((packed.shape[1], sh_count, sh_count))
    rows, columns = np.triu_indices(sh_count)
    found[:, rows, columns] = found[:, columns, rows] = packed.T
    return found


class Linearised:
    """The map at a scene's own colours, cut where they are.

    Attributes:
        gradient: (N, M, 3) in Y, Co, Cg, A transposed W (pictures - targets).
        error: |pictures - targets|^2 by W.
        blocks: (N, M, M), the splats' own blocks.
        room: bytes that are left of the memory for views and targets.
    """

    def __init__(self, case: Case, targets: Targets | None = None, memory: int | None = None) -> None:
        self._refit = ColourRefit(case.device, case.scene, case.cameras, background=case.background, memory=memory)
        vectors, colour_map = self._refit.coefficients, self._refit.colour_map
        self._at, result = vectors.vector(), vectors.vector()
        vectors.write_sh(self._at, case.scene.sh)
        vectors.zero(result)
        blocks = SplatBlocks(vectors)
        self.error = colour_map.gradient(self._at, targets or case.targets, result, blocks)
        self.blocks: Array = unpacked(blocks)
        self.gradient: Array = as_rows(vectors, result)
        self.room = colour_map.own.room

    def normal(self, direction: Array, every: int = 1) -> Array:
        """A transposed W A times a direction, by one of so many blocks of pixels."""
        vectors = self._refit.coefficients
        x, result = vectors.vector(), vectors.vector()
        vectors.write(x, direction.transpose(1, 2, 0).reshape(-1, len(direction)))
        self._refit.colour_map.normal(x, result, self._at, Ridge(0.0, 0.0, 0.0), every=every)
        return as_rows(vectors, result)

    def activate(self, active: NDArray[np.bool_]) -> None:
        """(N, M, 3) in Y, Co, Cg: the coefficients that may change."""
        self._refit.coefficients.activate(active)

    def error_alone(self, targets: Targets) -> float:
        """|pictures - targets|^2 by W, without a gradient."""
        return self._refit.colour_map.error(self._at, targets)

    def gradient_of_dc(self, targets: Targets, every: int) -> tuple[Array, float]:
        """(N, 3) in Y, Co, Cg, the gradient of the constant coefficients, and the error; by one of so many blocks."""
        vectors = self._refit.coefficients
        result = vectors.vector()
        vectors.zero(result)
        error = self._refit.colour_map.gradient(self._at, targets, result, constant=True, every=every)
        found: Array = as_rows(vectors, result)[:, 0]
        return found, error

    def __enter__(self) -> Linearised:
        return self

    def __exit__(self, *_: object) -> None:
        self._refit.close()


class Pictures:
    """Targets that are given as arrays."""

    def __init__(self, device: Device, pictures: Sequence[NDArray[np.floating[Any]]]) -> None:
        self.device, self.pictures = device, pictures
        self.buffers = [device.upload(np.ascontiguousarray(p, np.float32), "a picture") for p in pictures]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        for number in numbers:
            picture = self.buffers[number]
            cl.enqueue_copy(self.device.queue, buffer, picture, byte_count=picture.size, dst_offset=start)
            start += picture.size

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        for buffer in self.buffers:
            self.device.free(buffer)
