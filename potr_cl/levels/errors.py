"""What coarser levels of detail lose, by pictures: :class:`MeasuredErrors`.

A level's error in a view is a picture: at each pixel the squared difference to the finest level. It is shared out to
the finest level's splats as they share the pixel, by transmittance times opacity: so occlusion counts, and the parts
of all leaves add up to the picture's error. That takes one transposed pass of the colours' map (stages/refitting) for
each view and three levels, however many leaves there are. Leaves hardly disturb each other: on lego, errors of leaves
that are replaced one by one add up to that of all together within 0.03 dB at the first level, 0.3 dB at the third.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host.threads import Ahead, thread_pool
from potr_cl.levels.budgets import coverage
from potr_cl.levels.environment import Surroundings
from potr_cl.levels.plan import scale_of_level
from potr_cl.model.camera import Camera, resized
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.views_between import views_between
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.own_views import OwnViews
from potr_cl.stages.refitting.refit_options import colourless
from potr_cl.stages.refitting.sliced_arrays import Layout
from potr_cl.stages.refitting.view_kernels import RefitSweep

#: Views that errors are measured in, at least nearly so many, and the most pixels that one has then.
_VIEWS, _PIXELS = 32, 1 << 19
#: The round of views between views in which these are drawn: encodes take the first ones.
_ROUND = 1000
#: Splats by which the size of a pixel in the scene is found.
_SAMPLE = 1 << 14
#: What a splat without SH coefficients shows.
_GREY = 0.5
#: What :class:`potr_cl.outputs.output.Leaves` are: (N,) int64, and (leaves, 6) float64.
Leaves = tuple[NDArray[np.int64], NDArray[np.float64]]
#: Errors of so many scenes are shared out at once.
_CHANNELS = 3


@dataclass(frozen=True)
class MeasuredErrors:
    """See :class:`potr_cl.outputs.output.LevelErrors`.

    Attributes:
        device: to render on; None only where there are no views.
        views: the training views; without any, nothing is measured.
        scene: the uncompressed scene.
        background: R, G, B behind it.
        memory: bytes of the device's memory that may be filled with views; None: the callee's own default.
        between: views to measure leaves' errors in, as :func:`measuring_views` gives them; none: the training views.
        scales: by how much smaller the pictures are in which each level is shown; none: as it was made.
    """

    device: Device | None
    views: Sequence[Camera]
    scene: Scene
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    memory: int | None = None
    between: Sequence[Camera] = ()
    scales: Sequence[float] = ()

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
        scale = self.scales[level] if self.scales else scale_of_level(level)
        return float(np.float32(np.median(sizes) / scale)) if sizes else 0.0

    def far(self, scene: Scene) -> NDArray[np.bool_]:
        """See :meth:`potr_cl.outputs.output.LevelErrors.far`."""
        return self._surroundings.have(scene)

    @cached_property
    def _surroundings(self) -> Surroundings:
        return Surroundings.of(self.scene, self.views)

    def of_leaves(
        self, scenes: Callable[[int], Scene], levels: int, leaves: Callable[[], Leaves]
    ) -> NDArray[np.float64]:
        """See :meth:`potr_cl.outputs.output.LevelErrors.of_leaves`."""
        if not self.views or levels < 2:
            return np.zeros((len(leaves()[1]), levels))
        assert self.device is not None
        views = [_small(view) for view in self.between or self.views]
        with SharedOut(self.device, scenes(0), views, leaves, self.background, self.memory) as shared:
            parts = shared.of(map(scenes, range(1, levels)))
        _, boxes = leaves()
        covered = np.array([seen_coverage(view, boxes) for view in views])
        found = np.zeros((len(boxes), levels))
        found[:, 1:] = errors_a_coverage(parts, covered)
        return np.maximum.accumulate(found, axis=1)


def errors_a_coverage(parts: NDArray[np.float64], covered: NDArray[np.float64]) -> NDArray[np.float64]:
    """(leaves, levels) by which leaves' coverage is multiplied to foretell what they add to pictures' errors.

    The sum over the views by that of the coverage. Of a view, no more counts than the second most of all per coverage:
    from one place within a leaf, a single splat may fill the picture, which would tell of that place alone.

    Args:
        parts: (views, leaves, levels) what they add in some views.
        covered: (views, leaves) what they cover there.
    """
    ratios = parts / np.maximum(covered, 1e-12)[:, :, None]
    if len(ratios) > 1:
        ratios = np.minimum(ratios, np.partition(ratios, -2, axis=0)[-2])
    found: NDArray[np.float64] = (ratios * covered[:, :, None]).sum(axis=0)
    found /= np.maximum(covered.sum(axis=0), 1e-12)[:, None]
    return found


def measuring_views(scene: Scene, views: Sequence[Camera]) -> list[Camera]:
    """Views of a scene between some views, spread evenly.

    Levels are nearer to the scene where they were made for than where people look from, so no level is made for these.
    Where a camera can hardly have been anywhere else, the given views have to do.
    """
    between = views_between(scene, views, _VIEWS / len(views), first=_ROUND)
    count = min(len(views), _VIEWS)
    given = [views[k] for k in np.linspace(0, len(views) - 1, count).round().astype(int)]
    return between if len(between) >= count / 2 else given


def _small(view: Camera) -> Camera:
    """The view in no more pixels than tell a level's error."""
    part = min(math.sqrt(_PIXELS / (view.width * view.height)), 1.0)
    return resized(view, max(int(view.width * part), 1), max(int(view.height * part), 1))


def seen_coverage(view: Camera, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) what the engine takes boxes (n, 6) to cover of the picture; 0 of those behind, which add nothing to it."""
    low, high = boxes[:, :3], boxes[:, 3:]
    ahead = (low + high) / 2 @ view.rotation[2] + view.translation[2] > 0
    around = ((low <= view.centre) & (view.centre <= high)).all(axis=1)
    found: NDArray[np.float64] = np.where(ahead | around, coverage(view, boxes), 0.0)
    return found


class SharedOut:
    """Shares out the errors of other scenes' pictures to the leaves of one scene; a context.

    Args:
        device: to render on.
        scene: the finest level, as readers see it.
        views: to look from.
        leaves: gives the leaves, once it is asked; splats that lie in none have no part, which the others share.
        background, memory: as of :class:`MeasuredErrors`.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        views: Sequence[Camera],
        leaves: Callable[[], Leaves],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        memory: int | None = None,
    ) -> None:
        self._device, self._views, self._leaves = device, views, leaves
        self._background, self._memory = background, memory
        self._pictures, self._covered = [], []
        for picture, transmittance in self._rendered(scene):
            self._pictures.append(picture.clip(0, 1))
            self._covered.append((_GREY * (1 - transmittance))[:, :, None])
        with ExitStack() as stack:
            self._sweep = RefitSweep(device)
            layout = Layout(len(scene), stride_of(len(scene)), 1, self._sweep.lanes)
            self._coefficients = stack.enter_context(Coefficients(device, layout))
            self._black, self._sums = self._coefficients.vector(), self._coefficients.vector()
            self._coefficients.zero(self._black)
            self._rasterizer = stack.enter_context(Rasterizer(device, colourless(scene)))
            self._owned = stack.pop_all()

    def __enter__(self) -> SharedOut:
        return self

    def __exit__(self, *_: object) -> None:
        self._owned.close()

    def _rendered(self, scene: Scene) -> Iterator[tuple[FloatArray, FloatArray]]:
        with Rasterizer(self._device, scene, background=self._background) as rasterizer:
            for view in self._views:
                yield rasterizer.render(view)

    def of(self, scenes: Iterable[Scene]) -> NDArray[np.float64]:
        """(views, leaves, scenes) each leaf's part of the mean squared error of each view's picture of a scene."""
        found: list[NDArray[np.float64]] = []
        left = iter(scenes)
        while some := list(islice(left, _CHANNELS)):
            differences = [np.zeros((*picture.shape[:2], _CHANNELS), np.float32) for picture in self._pictures]

            def compare(channel: int, own: FloatArray, difference: FloatArray, picture: FloatArray) -> None:
                difference[:, :, channel] = np.square(picture.clip(0, 1) - own).mean(axis=2)

            def darkened(covered: FloatArray, difference: FloatArray) -> FloatArray:
                # Of a grey scene in front of black; what the picture should show is darker where the error is larger.
                dark: FloatArray = covered - difference / np.maximum(difference.max(axis=(0, 1)), np.float32(1e-30))
                return dark

            with thread_pool() as pool:
                compared = [
                    pool.submit(compare, channel, own, difference, picture)
                    for channel, scene in enumerate(some)
                    for own, difference, (picture, _) in zip(
                        self._pictures, differences, self._rendered(scene), strict=True
                    )
                ]
                for each in compared:
                    each.result()
                targets = pool.map(darkened, self._covered, differences)
                views = (
                    (difference, self._of_splats(number, target))
                    for number, (difference, target) in enumerate(zip(differences, targets, strict=True))
                )
                with Ahead(self._of_leaves, views) as parts:
                    found.append(np.array([each for _, each in parts])[:, :, : len(some)])
        return np.concatenate(found, axis=2)

    def _of_splats(self, number: int, picture: FloatArray) -> FloatArray:
        """(N, 3) what splats of the finest level have in three pictures' squared differences.

        Args:
            number: of the view.
            picture: (H, W, 3) that a grey scene should show in it, darker where the differences are larger.
        """
        target = _Picture(self._device, picture)
        coefficients, view = self._coefficients, self._views[number]
        coefficients.zero(self._sums)
        with OwnViews(self._sweep, self._rasterizer, coefficients, [view], memory=self._memory) as own:
            ColourMap(coefficients, own).gradient(self._black, target, self._sums)
            return coefficients.read_sh(self._sums)[:, 0]

    def _of_leaves(self, of_view: tuple[FloatArray, FloatArray]) -> NDArray[np.float64]:
        """(leaves, 3) the parts of three pictures' squared differences (H, W, 3), of which splats have (N, 3)."""
        difference, of_splats = of_view
        columns, (of_leaf, boxes) = np.maximum(of_splats, 0).T, self._leaves()
        parts = np.stack([np.bincount(of_leaf, each, len(boxes) + 1)[:-1] for each in columns], axis=1)
        whole = difference.mean(axis=(0, 1), dtype=np.float64)
        shared: NDArray[np.float64] = parts * (whole / np.maximum(parts.sum(axis=0), 1e-300))
        return shared


@dataclass(frozen=True)
class _Picture:
    """One picture (H, W, 3), for :class:`potr_cl.views.targets.Targets`."""

    device: Device
    picture: FloatArray

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        with self.device.errors("failed to take a picture"):
            picture = np.ascontiguousarray(self.picture, np.float32)
            cl.enqueue_copy(self.device.queue, buffer, picture, dst_offset=start, is_blocking=True)
