"""The pictures that views should show, and where these are meanwhile.

Whoever gives them is a :class:`Targets`, asked for some views at a time:

- :class:`RenderedTargets`: nowhere; a scene is rendered whenever somebody asks.
- :class:`PhotographTargets`: in files, read whenever somebody asks.
- :class:`HostTargets`: on the host, asked for once, so that what made them can go.
- :class:`PicturesAhead`: on devices, rendered in the background before anybody asks, and given away once.
- :class:`PicturesInPassing`: on a CPU, drawn in passing by what looks at the views anyway, and given away once.

:class:`TargetPictures` keeps as many of them on a device as a budget allows, and asks for the others again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.host import mapped
from potr_cl.host.threads import in_background
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.raster.picked_splats import IndexSubsets
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import ResidentScene, whole_on_device
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.raster.view_set import ViewSet
from potr_cl.views.budget import ViewCache, target_bytes
from potr_cl.views.pictures import SeenRasterizer
from potr_cl.views.visibility import Visibility

#: Pictures that are asked for together to be kept one by one, and their bytes at the most: a GPU prepares several views
#: in one go. And bytes of those that go to the host together.
_TOGETHER, _MOST_BYTES, _TO_HOST = 64, 1 << 28, 1 << 26
#: Pictures ahead and in passing take no more than this part of a device's memory: those ahead lie there twice for a
#: moment, the others beside all that pruning has.
AHEAD = 1 / 16
_WHAT = "the target images"


class Targets(Protocol):
    """What the pictures of some numbered views should show."""

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """Write the pictures of several views to device memory.

        Args:
            buffer: takes (H, W, 3) float32 of each, one behind the other.
            start: byte where they begin.
        """
        ...


@dataclass(frozen=True)
class RenderedTargets:
    """The pictures that another scene gives: the uncompressed one's.

    Attributes:
        picks: what each of them may draw, where the rasterizer goes by that.
    """

    rasterizer: Rasterizer | SeenRasterizer
    cameras: Sequence[Camera]
    picks: IndexSubsets | None = None

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """See :meth:`Targets.into`."""
        cameras = [self.cameras[number] for number in numbers]
        with self.rasterizer.device.errors("failed while rendering"):
            if self.picks is None:
                self.rasterizer.render_into(cameras, buffer, start)
            else:
                assert isinstance(self.rasterizer, SeenRasterizer)
                self.rasterizer.draw(self.picks, numbers, cameras, buffer, start)


@contextmanager
def targets_of(
    device: Device,
    scene: Drawable,
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
    visibility: Visibility | None = None,
) -> Iterator[RenderedTargets]:
    """A scene's pictures; by what views may draw, where that is known and the scene fits a GPU: the same bits."""
    with ExitStack() as stack:
        if visibility is not None and device.family == "gpu":
            scene = stack.enter_context(whole_on_device(device, scene))
        if visibility is not None and isinstance(scene, SceneBuffers) and device.family == "gpu":
            seen = stack.enter_context(SeenRasterizer(device, scene, visibility.groups, background=background))
            yield RenderedTargets(seen, cameras, seen.picks(stack.enter_context(Memory(device)), visibility.seen))
        else:
            whole = stack.enter_context(Rasterizer(device, scene, background=background))
            yield RenderedTargets(whole, cameras)


class Photographs(Protocol):
    """Gives pictures by camera; :class:`potr_cl.quality.photographs.GroundTruth` does."""

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view."""
        ...


@dataclass(frozen=True)
class PhotographTargets:
    """Photographs, read anew whenever they are asked for.

    Attributes:
        photographs: of all the cameras.
    """

    device: Device
    photographs: Photographs
    cameras: Sequence[Camera]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """See :meth:`Targets.into`.

        Raises:
            UsageError: a photograph cannot be opened.
            DataError: one is damaged.
        """
        for number in numbers:
            picture = np.ascontiguousarray(self.photographs.picture(self.cameras[number]), np.float32)
            with self.device.errors("failed to take a photograph"):
                cl.enqueue_copy(self.device.queue, buffer, picture, dst_offset=start, is_blocking=True)
            start += picture.nbytes


class HostTargets(Owner):
    """The pictures of others, asked for once and kept on the host: what made them can go.

    Where memory is bounded, many of them lie in a temporary file (:mod:`potr_cl.host.mapped`).

    Raises:
        PotrError: there is no room for them.
        DeviceError: the device failed, or a view does not fit it.
    """

    def __init__(self, device: Device, targets: Targets, cameras: Sequence[Camera]) -> None:
        self._ferry = Ferry(device)
        self._ends = np.cumsum([0, *(target_bytes(camera) // 4 for camera in cameras)])
        self._pictures = mapped.array((int(self._ends[-1]),), np.float32, "pictures")
        largest = max(map(target_bytes, cameras))
        # On a GPU several at a time are rendered faster.
        together = 1 if device.family == "cpu" else min(max(_TO_HOST // largest, 1), len(cameras))
        with Memory(device) as memory, ThreadPoolExecutor(1) as thread:
            # One thread takes pictures to the host while the next ones are rendered.
            buffers = [memory.allocate(together * largest, _WHAT) for _ in range(2)]
            taken: Future[None] | None = None
            for first in range(0, len(cameras), together):
                numbers = range(first, min(first + together, len(cameras)))
                targets.into(numbers, buffers[0])
                own = self._pictures[self._ends[numbers.start] : self._ends[numbers.stop]]
                if taken is not None:
                    taken.result()
                taken = thread.submit(self._ferry.to_host, [Cargo(own)], buffers[0])
                buffers.reverse()
            if taken is not None:
                taken.result()

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """See :meth:`Targets.into`."""
        cargo = []
        for number in numbers:
            cargo.append(Cargo(self._pictures[self._ends[number] : self._ends[number + 1]], start))
            start += cargo[-1].values.nbytes
        self._ferry.to_device(buffer, cargo)

    def close(self) -> None:
        """Keep nothing any more."""
        self._ferry.close()
        self._pictures = self._pictures[:0]


class PicturesAhead(Owner):
    """Renders a kept scene's pictures in a thread a device, where that has much more room than they take.

    A CPU renders none: it has other things to do.

    Args:
        numbers: of the views whose pictures each device will be asked for.
        visibility: what each view may draw, where no view sees much of the scene.
    """

    def __init__(
        self,
        source: ResidentScene,
        background: tuple[float, float, float],
        cameras: Sequence[Camera],
        numbers: Mapping[Device, Sequence[int]],
        visibility: Visibility | None = None,
    ) -> None:
        self.source, self._background, self._cameras, self._visibility = source, background, cameras, visibility
        self._begun = {
            device: in_background(self._rendered, device, some)
            for device, some in numbers.items()
            if device.family == "gpu" and some
        }

    def _rendered(self, device: Device, numbers: Sequence[int]) -> _Rendered | None:
        """Some views' pictures on a device; None: it has not much room, or the scene does not lie there."""
        if sum(target_bytes(self._cameras[number]) for number in numbers) > AHEAD * device.info.memory:
            return None
        scene = self.source.found_on(device)
        if not isinstance(scene, SceneBuffers):
            return None
        with suppress(DeviceMemoryError), device.all_or_nothing():
            rendered = _Rendered(device, self._cameras, numbers)
            with targets_of(device, scene, self._cameras, self._background, self._visibility) as targets:
                targets.into(numbers, rendered.buffer)
            return rendered
        return None

    def before(self, device: Device, targets: Targets) -> Targets:
        """The pictures that ``targets`` gives, on a device: it is asked for those that were not rendered ahead.

        Those that were are given once. When all have been given, their memory is given back.
        """
        begun = self._begun.get(device)
        return targets if begun is None else _Ahead(begun, targets)

    def close(self) -> None:
        """Give all device memory back."""
        for begun in self._begun.values():
            with suppress(DeviceError):
                rendered = begun.result()
                if rendered is not None:
                    rendered.close()


@dataclass(frozen=True)
class _Ahead:
    begun: Future[_Rendered | None]
    targets: Targets

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """See :meth:`Targets.into`."""
        rendered = self.begun.result()
        if rendered is None or not rendered.give(numbers, buffer, start):
            self.targets.into(numbers, buffer, start)


class _Rendered(Owner):
    """Pictures on a device, one behind the other, each to be given once."""

    def __init__(self, device: Device, cameras: Sequence[Camera], numbers: Sequence[int]) -> None:
        self._device = device
        ends = np.cumsum([0, *(target_bytes(cameras[number]) for number in numbers)]).tolist()
        self._places = dict(zip(numbers, itertools.pairwise(ends), strict=True))
        self._memory = Memory(device)
        self.buffer = self._memory.allocate(ends[-1], _WHAT)

    def give(self, numbers: Sequence[int], buffer: cl.Buffer, to: int) -> bool:
        """Enqueue copies to another buffer; whether all are there."""
        if any(number not in self._places for number in numbers):
            return False
        for number in numbers:
            start, end = self._places.pop(number)
            with self._device.errors("failed while computing"):
                cl.enqueue_copy(
                    self._device.queue, buffer, self.buffer, byte_count=end - start, src_offset=start, dst_offset=to
                )
            to += end - start
        if not self._places:
            self.close()
        return True

    def close(self) -> None:
        self._places = {}
        self._memory.close()


class PicturesInPassing(Owner):
    """A scene's pictures on a CPU, drawn by whoever looks at its views for something else; each is given once.

    They lie there until then: to make a view ready takes longer than to render it.

    Args:
        cameras: whose pictures are taken.
    """

    def __init__(self, device: Device, cameras: Sequence[Camera]) -> None:
        self._device, self._memory = device, Memory(device)
        self._wanted = {id(camera): camera for camera in cameras}
        self._rooms, self._of = dict[int, cl.Buffer](), dict[int, tuple[Camera, cl.Buffer]]()

    @staticmethod
    def wanted(device: Device, cameras: Sequence[Camera]) -> PicturesInPassing | None:
        """None: a GPU renders pictures ahead, or there is not much more room than they take."""
        if device.family != "cpu" or sum(map(target_bytes, cameras)) > AHEAD * device.info.memory:
            return None
        return PicturesInPassing(device, cameras)

    def leave_out(self, splats: Scene) -> None:
        """Take no pictures of views that show any of these splats, which whoever prepares the views has not got."""
        with Rasterizer(self._device, splats) as rasterizer:
            for camera in list(self._wanted.values()):
                with rasterizer.prepare_set([camera]) as views:
                    if views.views[0].intersection_count:
                        del self._wanted[id(camera)]

    def room_for(self, views: ViewSet) -> cl.Buffer | None:
        """Room for the picture of a prepared view, (H, W, 3) float32; None: nobody wants it, or there is none.

        Whoever asks draws it, and says so (:meth:`are_drawn`).
        """
        (view,) = views.views
        if id(view.camera) in self._wanted and id(view.camera) not in self._rooms:
            with suppress(DeviceMemoryError):
                self._rooms[id(view.camera)] = self._memory.allocate(12 * views.pixels, _WHAT)
        return self._rooms.get(id(view.camera))

    def are_drawn(self, cameras: Iterable[Camera]) -> None:
        """From now on the pictures of these views are there, of those that have room; no others will be."""
        there = {id(camera): camera for camera in cameras if id(camera) in self._rooms}
        self._of = {key: (camera, self._rooms.pop(key)) for key, camera in there.items()}
        self._memory.free(*self._rooms.values())
        self._rooms, self._wanted = {}, {}

    def before(self, targets: Targets, cameras: Sequence[Camera]) -> Targets:
        """The pictures that ``targets`` gives of these cameras: it is asked for those that are not here."""
        return _InPassing(self, targets, cameras)

    def give(self, camera: Camera, buffer: cl.Buffer, start: int) -> bool:
        """Enqueue a copy to another buffer; whether the picture is there."""
        if id(camera) not in self._of:
            return False
        _, picture = self._of.pop(id(camera))
        self._device.copy(buffer, picture, target_bytes(camera), to=start)
        self._memory.free(picture)
        return True

    def close(self) -> None:
        self._rooms, self._of = {}, {}
        self._memory.close()


@dataclass(frozen=True)
class _InPassing:
    pictures: PicturesInPassing
    targets: Targets
    cameras: Sequence[Camera]

    def into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        """See :meth:`Targets.into`."""
        for number in numbers:
            camera = self.cameras[number]
            if not self.pictures.give(camera, buffer, start):
                self.targets.into([number], buffer, start)
            start += target_bytes(camera)


@dataclass
class Room:
    """Bytes that are left of a budget of one's own."""

    room: float


class TargetPictures(Owner):
    """Pictures that are asked for again and again. They are kept on the device after their first use.

    Args:
        budget: that the pictures which are kept are taken from.
        targets: give them, until others are named (:meth:`fill`, :meth:`of`).
        sets: of views that will be asked for, always together: there is room for the largest in any case. None: views
            are asked for in any order, and kept one by one.
    """

    def __init__(
        self,
        device: Device,
        cameras: Sequence[Camera],
        budget: ViewCache | Room,
        targets: Targets | None = None,
        sets: Iterable[Sequence[int]] | None = None,
    ) -> None:
        self._device, self._cameras, self._budget, self._targets = device, list(cameras), budget, targets
        self._singly = sets is None
        self._memory = Memory(device)
        self._others = Scratch(device, _WHAT)
        self._kept: dict[tuple[int, ...], cl.Buffer] = {}
        if sets is not None:
            self._others.reserve(max(map(self._nbytes, sets), default=0))

    def fill(self, sets: Iterable[Sequence[int]], targets: Targets | None = None) -> None:
        """Have those pictures ready that are kept.

        Args:
            sets: of views whose pictures will be asked for.
            targets: give them from now on; None: those that gave them before.
        """
        self._show(targets)
        self._fill(map(tuple, sets))
        if self._singly:
            self._others.close()

    def of(self, numbers: Sequence[int], targets: Targets | None = None) -> cl.Buffer:
        """(pixels, 3) float32, what some views should show, one behind the other; valid until the next call.

        Args:
            targets: as of :meth:`fill`. Others than before take the place of what was kept.
        """
        self._show(targets)
        units = [(number,) for number in numbers] if self._singly else [tuple(numbers)]
        self._fill(units)
        if len(units) == 1 and units[0] in self._kept:
            return self._kept[units[0]]
        buffer, start = self._reserved(numbers), 0
        for kept, some in itertools.groupby(units, self._kept.__contains__):
            together = list(some)
            if not kept:
                self._into(list(itertools.chain(*together)), buffer, start)
                start += sum(map(self._nbytes, together))
                continue
            for unit in together:
                size = self._nbytes(unit)
                cl.enqueue_copy(self._device.queue, buffer, self._kept[unit], byte_count=size, dst_offset=start)
                start += size
        return buffer

    def _nbytes(self, numbers: Sequence[int]) -> int:
        return sum(target_bytes(self._cameras[number]) for number in numbers)

    def _fill(self, sets: Iterable[tuple[int, ...]]) -> None:
        waiting: list[tuple[int, ...]] = []
        for numbers in sets:
            nbytes = self._nbytes([*sum(waiting, ()), *numbers])
            if numbers in self._kept or numbers in waiting or nbytes > self._budget.room:
                continue
            if waiting and (not self._singly or len(waiting) == _TOGETHER or nbytes > _MOST_BYTES):
                self._take(waiting)
                waiting = []
            waiting.append(numbers)
        self._take(waiting)

    def _take(self, sets: Sequence[tuple[int, ...]]) -> None:
        """Keep pictures, for which there is room."""
        if len(sets) == 1:
            buffer = self._keep(sets[0])
            try:
                self._into(sets[0], buffer)
            except BaseException:
                self._drop(sets[0])
                raise
        elif sets:
            every, start = sum(sets, ()), 0
            self._into(every, self._reserved(every))
            for numbers in sets:
                size = self._nbytes(numbers)
                cl.enqueue_copy(
                    self._device.queue, self._keep(numbers), self._others.buffer, byte_count=size, src_offset=start
                )
                start += size

    def _into(self, numbers: Sequence[int], buffer: cl.Buffer, start: int = 0) -> None:
        assert self._targets is not None
        self._targets.into(numbers, buffer, start)

    def _reserved(self, numbers: Sequence[int]) -> cl.Buffer:
        self._others.reserve(self._nbytes(numbers))
        return self._others.buffer

    def _keep(self, numbers: tuple[int, ...]) -> cl.Buffer:
        buffer = self._memory.allocate(self._nbytes(numbers), _WHAT)
        self._budget.room -= buffer.size
        self._kept[numbers] = buffer
        return buffer

    def _show(self, targets: Targets | None) -> None:
        if targets is not None and targets is not self._targets:
            self._forget()
            self._targets = targets

    def _drop(self, numbers: tuple[int, ...]) -> None:
        buffer = self._kept.pop(numbers)
        self._budget.room += buffer.size
        self._memory.free(buffer)

    def _forget(self) -> None:
        for numbers in list(self._kept):
            self._drop(numbers)

    def close(self) -> None:
        """Give all device memory back."""
        self._forget()
        self._others.close()
        self._memory.close()
