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
from potr_cl.reference.refit import Array, Reference
from potr_cl.stages.refitting.refit import ColourRefit, RefitOptions, Refitted, RenderedTargets, Targets, refit_colours


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
        self.rasterizer.free()


class Linearised:
    """A solver at its start, with its vectors to be looked at and set."""

    def __init__(self, case: Case, targets: Targets | None = None, options: RefitOptions | None = None) -> None:
        refit = self.refit = ColourRefit(case.device, case.scene, case.cameras, options, background=case.background)
        refit._zero(refit._gram)
        refit._copy(refit._start, refit._x)
        self.state = refit._linearise(targets or case.targets, refit.options.lam, True)

    def vector(self, buffer: cl.Buffer) -> Array:
        """(N, M, 3) in Y, Co, Cg."""
        refit = self.refit
        columns = refit.device.download(buffer, (refit._sh_count, 3, refit._stride), np.float32)
        vector: Array = columns[:, :, : refit._splats].transpose(2, 0, 1).astype(np.float64)
        return vector

    def normal(self, direction: Array) -> Array:
        """A transposed W A times a direction."""
        refit = self.refit
        columns = np.zeros((refit._sh_count, 3, refit._stride), np.float32)
        columns[:, :, : refit._splats] = direction.transpose(1, 2, 0)
        cl.enqueue_copy(refit.device.queue, refit._direction, columns)
        refit._zero(refit._product)
        refit._sweep_views(refit._direction, refit._product, None, unit=1 / float(np.abs(direction).max()))
        return self.vector(refit._product)

    def gram(self) -> Array:
        """(N, M, M), upper triangles."""
        refit, count = self.refit, self.refit._sh_count
        packed = refit.device.download(refit._gram, (refit._triangle, refit._stride), np.float32)
        blocks = np.zeros((refit._splats, count, count))
        rows, columns = np.triu_indices(count)
        blocks[:, rows, columns] = packed[:, : refit._splats].T
        return blocks

    def active(self) -> NDArray[np.bool_]:
        """(N, M, 3)."""
        refit = self.refit
        words = refit.device.download(refit._active, (2, refit._stride), np.uint32)[:, : refit._splats]
        bits = [words[c // 24] >> (c % 24) & 1 for c in range(refit._columns)]
        return np.array(bits, bool).T.reshape(refit._splats, -1, 3)

    def __enter__(self) -> Linearised:
        return self

    def __exit__(self, *_: object) -> None:
        self.refit.free()


class Pictures:
    """Targets that are given as arrays."""

    def __init__(self, device: Device, pictures: Sequence[NDArray[np.floating[Any]]]) -> None:
        self.device, self.pictures = device, pictures
        self.buffers = [device.upload(np.ascontiguousarray(p, np.float32), "a picture") for p in pictures]

    def __call__(self, number: int) -> cl.Buffer:
        return self.buffers[number]

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        for buffer in self.buffers:
            self.device.free(buffer)
