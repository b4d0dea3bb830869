"""Pictures of a large scene, each drawn from the splats that its view may show: :class:`SeenRasterizer`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.picked_splats import NO_SPLAT, IndexSubset, IndexSubsets, Picker
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import fits_whole, whole_on_device
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP, Drawable, SceneBuffers, gathered
from potr_cl.views import visibility

#: To find the groups takes about as long as a GPU takes to project the whole scene into so many views.
_VIEWS = 48
#: On a CPU it takes longer to gather a view's splats than to project all, but less memory: so it is done where the
#: scene takes more than this part of it, once on the host and once for the device.
_PART = 1 / 6
#: Views that a GPU renders together at most, and splats of all of them, padding included.
_TOGETHER, _PROJECTED = 8, 1 << 24


class SeenRasterizer(Owner):
    """Renders what :class:`~potr_cl.raster.rasterizer.Rasterizer` renders, of a scene of which no view sees much.

    The pictures are the same bits: what is left out is drawn nowhere. Views take turns in the same memory. On a GPU
    that has the scene, or has room for it, a view's splats are drawn from where they are. Elsewhere they are gathered
    for each view, so that the device never holds a whole scene of the host.

    Args:
        scene: the scene; it must outlive this object.
        groups: of its splats.
        rules: of the rasterizer to follow.
    """

    def __init__(
        self,
        device: Device,
        scene: Drawable,
        groups: SplatGroups,
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.device, self.rules, self.background = device, rules, background
        self._groups = groups
        with ExitStack() as owned:
            self._scene = scene = owned.enter_context(whole_on_device(device, scene))
            self._preparing = owned.enter_context(PreparingMemory(device))
            self._passing = Reused(device)
            owned.callback(self._passing.give_back)
            self._picker: Picker | None = None
            if isinstance(scene, SceneBuffers) and device.family == "gpu":
                self._picker = owned.enter_context(Picker(device, groups.group_of))
            self._owned = owned.pop_all()

    def picks(self, memory: Memory, seen: NDArray[np.bool_]) -> IndexSubsets:
        """The splats of several views on a device that has the scene, for :meth:`draw`.

        Args:
            memory: as of :class:`~potr_cl.raster.picked_splats.IndexSubsets`.
            seen: (views, G) the groups that each may show.
        """
        assert self._picker is not None, "only of scenes that lie on a GPU"
        return IndexSubsets(memory, self._picker, seen)

    def draw(
        self, picks: IndexSubsets, numbers: Sequence[int], cameras: Sequence[Camera], target: cl.Buffer, start: int = 0
    ) -> None:
        """Render some of these views into a buffer, some at a time, without waiting for the last ones.

        Args:
            picks: the views' splats.
            numbers: of the views among them.
            target, start: as of :meth:`render_into`.
        """
        first = 0
        while first < len(numbers):
            # Together: the longest tile lists of one view keep few work-groups busy.
            count = self._together([max(picks.counts[number], 1) for number in numbers[first : first + _TOGETHER]])
            while True:
                some = slice(first, first + count)
                try:
                    start = self._draw_together(picks, numbers[some], cameras[some], target, start)
                    break
                except DeviceMemoryError:
                    if count == 1:
                        raise
                    count //= 2
            first += count

    def _together(self, counts: Sequence[int]) -> int:
        """How many of the first views are rendered together: each has as much room as the one that shows most."""
        return max(n for n in range(1, len(counts) + 1) if n == 1 or n * max(counts[:n]) <= _PROJECTED)

    def _draw_together(
        self, picks: IndexSubsets, numbers: Sequence[int], cameras: Sequence[Camera], target: cl.Buffer, start: int
    ) -> int:
        """Render views with one launch of each kernel; returns the byte where they end."""
        with self._picked(picks, numbers) as rasterizer:
            views = rasterizer.prepare_set(cameras, self._passing)
            rasterizer.pictures_into(views, target, start)
            return start + 12 * views.pixels

    @contextmanager
    def _picked(self, picks: IndexSubsets, numbers: Sequence[int]) -> Iterator[Rasterizer]:
        """A rasterizer of some views' splats, each with its own."""
        assert isinstance(self._scene, SceneBuffers)
        stride = -(-max(1, *(picks.counts[number] for number in numbers)) // SPLAT_GROUP) * SPLAT_GROUP
        try:
            picked = self._passing.allocate(4 * stride * len(numbers), "the numbers of views' splats")
            self.device.fill(picked, np.uint32(NO_SPLAT), 4 * stride * len(numbers))
            for place, number in enumerate(numbers):
                if picks.counts[number]:
                    picks.numbers_into(picked, place * stride, number)
            with self._rasterizer(IndexSubset(self._scene, picked, stride, apart=stride)) as rasterizer:
                yield rasterizer
        finally:
            self._passing.close()

    @contextmanager
    def _gathered(self, seen: NDArray[np.bool_]) -> Iterator[Rasterizer]:
        """A rasterizer of the splats of some groups, which are brought together."""
        splats = self._groups.splats(seen)
        if not len(splats):
            splats = np.zeros(1, np.int64)
        with ExitStack() as stack:
            if isinstance(self._scene, SceneBuffers):
                own: Drawable = stack.enter_context(gathered(self._scene, splats))
            else:
                own = self._scene.subset(splats)
            yield stack.enter_context(self._rasterizer(own))

    def _rasterizer(self, scene: Drawable) -> Rasterizer:
        return Rasterizer(self.device, scene, self.rules, self.background, self._preparing)

    def render_into(self, cameras: Sequence[Camera], target: cl.Buffer, start: int = 0) -> None:
        """Render views one behind the other into a buffer.

        Args:
            target: takes (pixels, 3) float32.
            start: byte where they begin.
        """
        seen = self._groups.visible_by(cameras, self.rules.near)
        with Memory(self.device) as memory:
            picks = None if self._picker is None else self.picks(memory, seen)
            if picks is not None:
                self.draw(picks, range(len(cameras)), cameras, target, start)
            else:
                for own, camera in zip(seen, cameras, strict=True):
                    with self._gathered(own) as rasterizer:
                        rasterizer.render_into([camera], target, start)
                    start += 12 * camera.width * camera.height
            with self.device.errors("failed while rendering"):
                self.device.queue.finish()
        if self.device.info.kind == "cpu":
            self._preparing.rest()  # another scene may be drawn next, where there is little memory

    def render(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.render`."""
        with self._rasterizer_of(camera) as rasterizer:
            return rasterizer.render(camera)

    def strips(self, camera: Camera) -> Iterator[FloatArray]:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.strips`."""
        with self._rasterizer_of(camera) as rasterizer:
            yield from rasterizer.strips(camera)

    @contextmanager
    def _rasterizer_of(self, camera: Camera) -> Iterator[Rasterizer]:
        seen = self._groups.visible(camera, self.rules.near)
        with ExitStack() as stack:
            if self._picker is None:
                yield stack.enter_context(self._gathered(seen))
            else:
                memory = stack.enter_context(Memory(self.device))
                yield stack.enter_context(self._picked(self.picks(memory, seen[None]), [0]))


def rasterizer_for(
    device: Device,
    scene: Drawable,
    cameras: Sequence[Camera],
    rules: RasterRules = INRIA,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Rasterizer | SeenRasterizer:
    """What renders pictures of a scene from these views quickest; arguments and errors of :func:`rasterizer_of`."""
    groups = groups_worth_it(device, scene, cameras, rules.near) if isinstance(scene, Scene) else None
    return rasterizer_of(device, scene, rules, background, groups)


def rasterizer_of(
    device: Device,
    scene: Drawable,
    rules: RasterRules = INRIA,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    groups: SplatGroups | None = None,
) -> Rasterizer | SeenRasterizer:
    """What renders pictures of a scene quickest: all of it for each view, or what the view may show.

    Args:
        device, scene, rules, background: as of :class:`~potr_cl.raster.rasterizer.Rasterizer`.
        groups: of the scene's splats, where views see little of it (:func:`groups_worth_it`).
    """
    if groups is None:
        return Rasterizer(device, scene, rules, background)
    return SeenRasterizer(device, scene, groups, rules, background)


def groups_worth_it(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    near: float = INRIA.near,
    there: bool = False,
    large: bool = False,
    known: SplatGroups | None = None,
) -> SplatGroups | None:
    """The groups of a scene's splats, where it pays to render each view with what it may show; else None.

    Args:
        scene: clean.
        there: whether all of the scene is on the device already.
        large: whether it takes too much of the device's memory, or of what a user allows, to be there.
        known: its groups, where somebody has found that views see little of it.
    """
    if device.info.shares_host_memory:
        if there or not (large or scene.nbytes > _PART * device.info.memory):
            return None
    elif known is None and len(cameras) < _VIEWS and (there or fits_whole(device, scene)):
        return None
    if known is not None or visibility.seen_part(scene, cameras, near) > visibility.MOST_SEEN:
        return known
    with thread_pool() as pool:
        return SplatGroups.of(scene, run=pool.map)
