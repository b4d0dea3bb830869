"""What coarser levels of detail lose, by pictures: :class:`MeasuredErrors`.

A level's error in a view is a picture: at each pixel the squared difference to the finest level. It is shared out to
the finest level's splats as they share the pixel, by transmittance times opacity: so occlusion counts, and the parts
of all leaves add up to the picture's error. That takes one transposed pass of the colours' map (stages/refitting) for
each level, however many leaves there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.levels.plan import scale_of_level
from potr_cl.model.camera import Camera, resized
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.colour_refit import ColourRefit

#: Views that errors are measured in, spread evenly, and the most pixels that one has then.
_VIEWS, _PIXELS = 32, 1 << 19
#: Splats by which the size of a pixel in the scene is found.
_SAMPLE = 1 << 14
#: The tangent of half the field of view that the engine compares others with.
_REFERENCE = math.tan(math.radians(22.5))
#: What a splat without SH coefficients shows.
_GREY = 0.5


@dataclass(frozen=True)
class MeasuredErrors:
    """See :class:`potr_cl.outputs.output.LevelErrors`.

    Attributes:
        device: to render on; None only where there are no views.
        views: the training views; without any, nothing is measured.
        scene: the uncompressed scene.
        background: R, G, B behind it.
        memory: bytes of the device's memory that may be filled with views; None: the callee's own default.
    """

    device: Device | None
    views: Sequence[Camera]
    scene: Scene
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    memory: int | None = None

    def of_level(self, level: int) -> float:
        """The size in the scene of a pixel in the level's pictures, the median over splats and views."""
        if not level or not self.views:
            return 0.0
        some = self.scene.means[:: max(len(self.scene) // _SAMPLE, 1)].astype(np.float64)
        sizes = []
        for view in self.views:
            depths = some @ view.rotation[2] + view.translation[2]
            if (depths > 0).any():
                sizes.append(float(np.median(depths[depths > 0])) / view.fx)
        return float(np.float32(np.median(sizes) / scale_of_level(level))) if sizes else 0.0

    def of_leaves(
        self, scenes: Callable[[int], Scene], levels: int, leaves: NDArray[np.int64], boxes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See :meth:`potr_cl.outputs.output.LevelErrors.of_leaves`."""
        found = np.zeros((len(boxes), levels))
        if not self.views or levels < 2:
            return found
        assert self.device is not None
        views = measuring_views(self.views)
        covered = np.mean([coverage(view, boxes) for view in views], axis=0)
        finest = scenes(0)
        with SharedOut(self.device, finest, views, leaves, len(boxes), self.background, self.memory) as shared:
            for level in range(1, levels):
                found[:, level] = shared.of(scenes(level))
        found /= np.maximum(covered, 1e-12)[:, None]
        return np.maximum.accumulate(found, axis=1)


def measuring_views(views: Sequence[Camera]) -> list[Camera]:
    """Some of the views, spread evenly, in no more pixels than tell a level's error."""
    chosen = [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int)]
    small = []
    for view in chosen:
        part = min(math.sqrt(_PIXELS / (view.width * view.height)), 1.0)
        small.append(resized(view, max(int(view.width * part), 1), max(int(view.height * part), 1)))
    return small


def coverage(view: Camera, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) about which part of the picture boxes (n, 6) cover, 0 to 1, by PlayCanvas' engine; 0 of those behind.

    The engine's rule: (r / (r + d))², with r half the box's diagonal and d its distance, times the tangent of half the
    vertical field of view over that of 22.5 degrees.
    """
    low, high = boxes[:, :3], boxes[:, 3:]
    at = view.centre
    distances = np.linalg.norm(np.clip(at, low, high) - at, axis=1)
    radii = np.linalg.norm(high - low, axis=1) / 2
    distances *= view.height / 2 / view.fy / _REFERENCE
    depths = (low + high) / 2 @ view.rotation[2] + view.translation[2]
    parts = np.square(radii / np.maximum(radii + distances, 1e-30))
    found: NDArray[np.float64] = np.where((depths > 0) | (distances == 0), parts, 0.0)
    return found


class SharedOut:
    """Shares out the errors of other scenes' pictures to the leaves of one scene; a context.

    Args:
        device: to render on.
        scene: the finest level, as readers see it.
        views: to look from; all count the same.
        leaves: (N,) in which leaf each of its splats lies.
        count: of the leaves.
        background, memory: as of :class:`MeasuredErrors`.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        views: Sequence[Camera],
        leaves: NDArray[np.int64],
        count: int,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
    ) -> None:
        self._device, self._views, self._leaves, self._count = device, views, leaves, count
        self._background = background
        self._pictures, self._covered = [], []
        for picture, transmittance in self._rendered(scene):
            self._pictures.append(picture)
            self._covered.append(1 - transmittance)
        with ExitStack() as stack:
            grey = replace(scene, sh=np.zeros((len(scene), 1, 3), np.float32))
            self._map = stack.enter_context(ColourRefit(device, grey, views, memory=memory))
            self._black = self._map.coefficients.vector()
            self._map.coefficients.zero(self._black)
            self._sums = self._map.coefficients.vector()
            self._owned = stack.pop_all()

    def __enter__(self) -> SharedOut:
        return self

    def __exit__(self, *_: object) -> None:
        self._owned.close()

    def _rendered(self, scene: Scene) -> Iterator[tuple[FloatArray, FloatArray]]:
        with Rasterizer(self._device, scene, background=self._background) as rasterizer:
            for view in self._views:
                yield rasterizer.render(view)

    def of(self, scene: Scene) -> NDArray[np.float64]:
        """(leaves,) each leaf's part of a scene's mean squared error, the mean over the views."""
        differences = [
            np.square(np.clip(picture, 0, 1) - np.clip(own, 0, 1)).mean(axis=2)
            for (picture, _), own in zip(self._rendered(scene), self._pictures, strict=True)
        ]
        whole = float(np.mean([difference.mean(dtype=np.float64) for difference in differences]))
        largest = max(float(difference.max()) for difference in differences)
        if not whole > 0:
            return np.zeros(self._count)
        # Of a grey scene in front of black; what the pictures should show is darker where the error is larger.
        targets = [
            _GREY * covered - difference / np.float32(largest)
            for covered, difference in zip(self._covered, differences, strict=True)
        ]
        coefficients = self._map.coefficients
        coefficients.zero(self._sums)
        self._map.colour_map.gradient(self._black, _Pictures(self._device, targets), self._sums)
        of_splats = coefficients.read_sh(self._sums)[:, 0, 0].astype(np.float64)
        parts: NDArray[np.float64] = np.bincount(self._leaves, np.maximum(of_splats, 0), self._count).astype(np.float64)
        total = float(parts.sum())
        return parts * (whole / total) if total > 0 else parts


@dataclass(frozen=True)
class _Pictures:
    """Grey pictures (H, W) of numbered views, for :class:`potr_cl.views.targets.Targets`."""

    device: Device
    pictures: Sequence[FloatArray]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        for number in numbers:
            picture = np.repeat(self.pictures[number][:, :, None], 3, axis=2).astype(np.float32)
            with self.device.errors("failed to take a picture"):
                cl.enqueue_copy(self.device.queue, buffer, picture, dst_offset=start, is_blocking=True)
            start += picture.nbytes
