"""Views are made ready to be composited: :class:`Projection`, tile lists and depth order (:class:`Preparation`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import LOW_PASS, FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.launcher import RasterLauncher
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rules import LEAST_COMPENSATION, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP, SceneBuffers
from potr_cl.raster.view_set import ViewSet


class Projection(Owner):
    """The projection of a scene's splats (cl/raster/project.cl), with the SH coefficients that they have now.

    Args:
        device: that computes.
        scene: on it; stays the caller's.
        rules: of the rasterizer to follow.
        lanes: how many splats a work-item does.

    Attributes:
        filter_macros: macros that a kernel needs which goes through the projection again; none unless the scene is
            antialiased.
    """

    def __init__(self, device: Device, scene: SceneBuffers, rules: RasterRules, lanes: int) -> None:
        self._scene, self._lanes = scene, lanes
        self._replaced: cl.Buffer | None = None  # other SH coefficients than the scene's
        self._memory = Memory(device)
        self.filter_macros = _filter_macros(scene)
        self._kernel = device.shared_kernel(
            "raster/project.cl",
            "project",
            LANES=lanes,
            SH_COUNT=scene.sh_count,
            NEAR=float(rules.near),
            SQUARE_EXTENT=int(rules.square_extent),
            **self.filter_macros,
            **scene.pick_macros,
        )

    def enqueue(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        """Enqueue the projection of views.

        Args:
            views: to project.
            bounds: takes (views, stride, 4) uint16, the tiles around each splat.
            sh: other coefficients than those that the splats have now.
            shapes, colours: other buffers than the views' own.
        """
        self._kernel.bind(
            **self._scene.geometry,
            **self._scene.picks,
            sh=self.sh if sh is None else sh,
            views=views.table,
            shapes=views.shapes if shapes is None else shapes,
            colours=views.colours if colours is None else colours,
            bounds=bounds,
        )
        self._kernel.launch((self._scene.stride // self._lanes, len(views.views)), (SPLAT_GROUP // self._lanes, 1))

    @property
    def sh(self) -> cl.Buffer:
        """The SH coefficients that splats have now, as :class:`~potr_cl.raster.scene_buffers.SceneBuffers` has them."""
        return self._scene.sh if self._replaced is None else self._replaced

    def replace_sh(self, sh: FloatArray) -> cl.Buffer | None:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Returns:
            The buffer of the former coefficients, which is the caller's to free; None if they are the scene's own.
        """
        former = self._replaced
        self._replaced = self._scene.other_sh(self._memory, sh)
        return None if former is None else self._memory.release(former)


def _filter_macros(scene: SceneBuffers) -> dict[str, float]:
    """Macros of the projection that an antialiased scene needs; the kernel of classic ones has no trace of it."""
    if not scene.antialiased:
        return {}
    macros = {"ANTIALIASED": 1, "LEAST_COMPENSATION_SQUARED": LEAST_COMPENSATION**2}
    if scene.low_pass != LOW_PASS:
        macros |= {"LOW_PASS": scene.low_pass, "LOW_PASS_SQUARED": scene.low_pass**2}
    return macros


class Preparation(Owner):
    """Prepares views of one scene.

    Args:
        device: that computes.
        stride: N rounded up, as the scene on the device has it.
        projection: of the scene's splats.
        launcher: of the other steps.
        memory: to prepare views in, which stays the caller's; None: its own.

    Attributes:
        memory: that views are prepared in.
        shares: whether it stays the caller's.
    """

    def __init__(
        self,
        device: Device,
        stride: int,
        projection: Projection,
        launcher: RasterLauncher,
        memory: PreparingMemory | None,
    ) -> None:
        self._device, self._stride, self._projection, self._launcher = device, stride, projection, launcher
        self.memory, self.shares = memory or PreparingMemory(device), memory is not None
        #: Whether the memory that sets are prepared in is kept for now, and whether it is that of several views.
        self._keeps = self._prepared_several = False

    def new_views(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """Views with nothing in them yet, and without room for intersections."""
        return ViewSet(self._device, cameras, self._stride, self._launcher.subtile_bytes, memory)

    def prepare_set(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.prepare_set`."""
        views = self.new_views(cameras, memory)
        try:
            with self.counting():
                self._enqueue_offsets(views)
                # All of them, while there is nothing else to wait for: the lists are enqueued behind them.
                views.found_offsets = views.read_offsets()
                found = _accepted(views, [int(offsets[-1]) for offsets in views.found_offsets])
                views.make_room(found)
                self._enqueue_lists(views, for_frame=False, known=True)
        except BaseException:
            if len(cameras) > 1:
                self._rest()
            views.close()
            raise
        if len(cameras) > 1:  # far more than a single view will need
            self._prepared_several = True
            if not self._keeps:
                self._rest()
        return views

    def prepare_again(self, views: ViewSet, cameras: Sequence[Camera]) -> bool:
        """See :meth:`potr_cl.raster.rasterizer.Rasterizer.prepare_again`."""
        if not views.aim(cameras):
            return False
        with self.counting():
            self._enqueue_offsets(views)
            found = _accepted(views, views.read_counts())
            if any(count > view.capacity for view, count in zip(views.views, found, strict=True)):
                views.make_room([count + count // 4 for count in found])
            self._enqueue_lists(views, for_frame=False)
        return True

    def enqueue_frame(self, views: ViewSet) -> None:
        """Enqueue all steps of views that have room, for one picture of each; inside :meth:`counting`.

        Lists that do not fit are cut short: so the kernels are safe, and :meth:`counted` says what would have fitted.
        """
        self._enqueue_offsets(views)
        self._enqueue_lists(views, for_frame=True)

    def counted(self, views: ViewSet) -> list[int]:
        """How many intersections each view has, once the device has found them."""
        return _accepted(views, views.read_counts())

    @contextmanager
    def counting(self) -> Iterator[None]:
        """The tiles' counters are zero before each use and after it; given back here if an error comes between."""
        try:
            yield
        except BaseException:
            self.memory.counts.close()
            raise

    @contextmanager
    def of_many_sets(self) -> Iterator[None]:
        """Inside the block, memory that sets are prepared in is kept for the next one: drivers take long to give it."""
        self._keeps = True
        try:
            yield
        finally:
            self._keeps = False
            if self._prepared_several:
                self._rest()

    def room_for_bounds(self, views: ViewSet) -> cl.Buffer:
        """Memory for what the projection of views leaves for the steps behind it."""
        self.memory.bounds.reserve(8 * self._stride * len(views.views))
        return self.memory.bounds.buffer

    def _enqueue_offsets(self, views: ViewSet) -> None:
        counts = self.memory.zeroed_counts(self._launcher.counter_bytes * views.tiles)
        bounds = self.room_for_bounds(views)
        self._projection.enqueue(views, bounds)
        self._launcher.enqueue_offsets(views, bounds, counts)

    def _enqueue_lists(self, views: ViewSet, for_frame: bool, known: bool = False) -> None:
        """Enqueue what follows the offsets, which the host may know."""
        memory = self.memory
        memory.keys.reserve(self._launcher.key_bytes * views.capacity)
        some_are_long = known and self._launcher.whole_sets and memory.long_lists.find(views)
        self._launcher.enqueue_lists(
            views,
            memory.bounds.buffer,
            memory.counts.buffer,
            memory.keys.buffer,
            for_frame,
            memory.long_lists if some_are_long else None,
        )

    def _rest(self) -> None:
        self._prepared_several = False
        if not self.shares:
            self.memory.rest()

    def in_sets(
        self, composite: Callable[[ViewSet], None], cameras: Sequence[Camera], most: int, former: ViewSet | None = None
    ) -> ViewSet | None:
        """Prepare and composite views, in sets of about one size: drivers take long to give memory and to take it back.

        Args:
            composite: enqueues the pictures of a set, and what becomes of them.
            cameras: of the views.
            most: how many a set has at most; fewer, where the device has no room.
            former: a set whose memory is taken, or given back; of no use any more.

        Returns:
            The last set, the caller's to close.
        """
        number = 0
        views = former
        try:
            while number < len(cameras):
                left = len(cameras) - number
                sets = -(-left // most)
                some = cameras[number : number - (-left // sets)]
                try:
                    former, views = views, None
                    views = self._instead_of(former, some)
                except DeviceMemoryError:
                    if most == 1:
                        raise
                    most = max(len(some) // 2, 1)
                    continue
                composite(views)
                number += len(some)
        except BaseException:
            if views is not None:
                views.close()
            raise
        return views

    def _instead_of(self, former: ViewSet | None, cameras: Sequence[Camera]) -> ViewSet:
        """Prepared views, in the memory of others that nobody needs any more, if they fit in there."""
        if former is not None:
            fits = False
            try:
                fits = len(former.views) == len(cameras) and self.prepare_again(former, cameras)
            finally:
                if not fits:
                    former.close()
            if fits:
                return former
        return self.prepare_set(cameras)

    def close(self) -> None:
        """Give the memory back, unless it is the caller's."""
        if not self.shares:
            self.memory.close()


def _accepted(views: ViewSet, found: list[int]) -> list[int]:
    """Note in the views how many intersections the device has found, and return that."""
    for view, count in zip(views.views, found, strict=True):
        if count == 0xFFFFFFFF:
            raise DeviceError(
                f"view '{view.camera.name}' needs more than 2^32 tile intersections: "
                "too many huge splats for this image size"
            )
        view.intersection_count = count
    return found
