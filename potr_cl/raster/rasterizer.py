"""The rasterizer (:class:`Rasterizer`): projection, tile lists, depth order and compositing of views.

The steps run in this order and leave their results in device buffers of a
:class:`~potr_cl.raster.view_set.ViewSet`. A caller that needs a view more than once keeps these, and repeats only the
last step:

1. ``project``: each splat's ellipse and colour on screen (cl/raster/project.cl);
2. ``count_tiles``, ``scan_tiles``, ``fill_tiles``: which splats touch which 16 x 16 tile (cl/raster/tile_lists_*.cl);
3. ``sort_tiles``: each tile's list front to back (cl/raster/sort_*.cl); ``subtile_masks``: which parts of its tile each
   intersection touches (cl/raster/subtile_masks_*.cl);
4. ``composite``: the picture (cl/raster/composite_*.cl).

All but the first are enqueued by the launcher of the device's kernel family (:mod:`potr_cl.raster.launcher`).

Semantics: the original 3DGS rasterizer (Kerbl et al. 2023); where renderers differ,
:class:`~potr_cl.raster.rules.RasterRules` says how.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import LOW_PASS, FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.raster.launcher import launcher_for
from potr_cl.raster.rules import INRIA, LEAST_COMPENSATION, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP, Drawable, SceneBuffers, uploaded
from potr_cl.raster.view_set import View, ViewSet

#: Least room for intersections before anything is known of a view, and as a multiple of the splats.
_FIRST_CAPACITY, _FIRST_CAPACITY_A_SPLAT = 1 << 16, 4
#: Projected splats of the views that are rendered together. More take gigabytes, and a driver long to find them.
_PROJECTED = 1 << 26


class PreparingMemory(Owner):
    """What preparing views takes besides what is left of them: rasterizers that take turns may share it.

    Args:
        device: whose memory it is.

    Attributes:
        bounds, counts, keys: the tiles that splats touch, the tiles' counters, and the lists while they are sorted.
        image, transmittance: of pictures.
    """

    def __init__(self, device: Device) -> None:
        self.bounds = Scratch(device, "the projected splats' bounds")
        self.counts = Scratch(device, "the tile counts")
        self.keys = Scratch(device, "the tile lists' sort keys")
        self.image = Scratch(device, "the image")
        self.transmittance = Scratch(device, "the transmittance")

    def rest(self) -> None:
        """Give all back but the pictures."""
        for scratch in (self.bounds, self.counts, self.keys):
            scratch.close()

    def close(self) -> None:
        self.rest()
        for scratch in (self.image, self.transmittance):
            scratch.close()


class Rasterizer(Owner):
    """Renders one scene on one device, with the scene and all scratch memory kept there until it is closed.

    Args:
        device: to render on.
        scene: to render; copied to the device, later changes of its arrays are not seen. Or one that lies on the device
            already, which stays the caller's.
        rules: of the rasterizer to follow.
        background: R, G, B behind everything.
        preparing: memory to prepare views and for their pictures, which stays the caller's; None: its own.

    Attributes:
        device, rules, background: as given.
        splats: N.
        stride: N rounded up; buffers that hold one value for each splat have this length.

    Raises:
        DeviceError: the scene does not fit or lies on another device, or the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        scene: Drawable,
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        preparing: PreparingMemory | None = None,
    ) -> None:
        self.device = device
        self.rules = rules
        self.background = background
        with device.all_or_nothing():
            if isinstance(scene, SceneBuffers):
                if scene.device is not device:
                    raise DeviceError(
                        f"the scene lies on {scene.device.info}, which was opened apart from {device.info}"
                    )
                self._scene, self._owns = scene, False
            else:
                self._scene, self._owns = uploaded(device, scene), True
            self._replaced: cl.Buffer | None = None  # other SH coefficients than the scene's
            self._other_sh = Memory(device)
            self._launcher = launcher_for(device, rules)
            self._filter_macros = _filter_macros(self._scene)
            self._projection = device.shared_kernel(
                "raster/project.cl",
                "project",
                LANES=self._launcher.lanes,
                SH_COUNT=self._scene.sh_count,
                NEAR=float(rules.near),
                SQUARE_EXTENT=int(rules.square_extent),
                **self._filter_macros,
                **self._scene.pick_macros,
            )
        self._preparing = preparing or PreparingMemory(device)
        self._shares = preparing is not None
        #: Whether the memory that sets are prepared in is kept for now, and whether it is that of several views.
        self._keeps_preparing = self._prepared_several = False
        self._image, self._transmittance = self._preparing.image, self._preparing.transmittance
        self._frame: ViewSet | None = None

    @property
    def splats(self) -> int:
        return self._scene.splats

    @property
    def parameters(self) -> SceneBuffers:
        """The scene on the device. Who writes to its buffers prepares views anew."""
        return self._scene

    @property
    def filter_macros(self) -> dict[str, float]:
        """Macros that a kernel needs which goes through the projection again; none unless the scene is antialiased."""
        return dict(self._filter_macros)

    @property
    def stride(self) -> int:
        return self._scene.stride

    def render(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """Render one view.

        Returns:
            image: (H, W, 3) float32, linear in the scene's colours, not clamped above.
            transmittance: (H, W) float32, the share of the background that shows through.

        Raises:
            DeviceError: the view does not fit the device, or the device failed.
        """
        self.render_device(camera)
        return self._pictures(camera)

    def render_device(self, camera: Camera) -> tuple[cl.Buffer, cl.Buffer]:
        """Render one view and leave it on the device, finished.

        Returns:
            Buffers that begin with the image and the transmittance, as :meth:`render` describes them; the next call
            overwrites them.
        """
        views = self._frame_view(camera)
        (view,) = views.views
        try:
            counts, bounds = self._zeroed_counts(views), self._room_for_bounds(views)
            while True:
                self._enqueue_project(views, bounds)
                self._launcher.enqueue_offsets(views, bounds, counts)
                self._enqueue_lists(views, bounds, counts, for_frame=True)
                self._enqueue_composite(views)
                # Lists that did not fit are cut short, so the kernels were safe; their result is thrown away.
                (count,) = views.read_counts()
                _accept(view, count)
                if count <= view.capacity:
                    return self._image.buffer, self._transmittance.buffer
                views.make_room([count + count // 4])
        except BaseException:
            self._preparing.counts.close()  # maybe not zero
            raise

    def render_into(
        self, cameras: Sequence[Camera], target: cl.Buffer, start: int = 0, memory: Memory | None = None
    ) -> None:
        """Render views one behind the other into a buffer; on a GPU, several at a time.

        Args:
            cameras: of the views.
            target: takes (pixels, 3) float32.
            start: byte where they begin.
            memory: on a GPU, to prepare views in, as of :meth:`prepare_set`.
        """
        if self._launcher.whole_sets:
            self._render_sets_into(cameras, target, start, memory)
            return
        for camera in cameras:
            nbytes = 12 * camera.width * camera.height
            image, _ = self.render_device(camera)
            cl.enqueue_copy(self.device.queue, target, image, byte_count=nbytes, dst_offset=start)
            start += nbytes

    def _render_sets_into(
        self, cameras: Sequence[Camera], target: cl.Buffer, start: int, memory: Memory | None
    ) -> None:
        device = self.device
        room = (device.info.memory - device.allocated) // 512
        most = int(max(min(room, _PROJECTED) // self.stride, 1))
        number = 0
        views: ViewSet | None = None
        try:
            while number < len(cameras):
                # Sets of about one size: drivers take long to give memory back and to take it anew.
                left = len(cameras) - number
                sets = -(-left // most)
                some = cameras[number : number - (-left // sets)]
                try:
                    former, views = views, None
                    views = self._prepare_instead(former, some, memory)
                except DeviceMemoryError:
                    if most == 1:
                        raise
                    most = max(len(some) // 2, 1)
                    continue
                nbytes = 12 * views.pixels
                self._enqueue_composite(views)
                cl.enqueue_copy(device.queue, target, self._image.buffer, byte_count=nbytes, dst_offset=start)
                number += len(some)
                start += nbytes
        finally:
            if views is not None:
                views.close()
                if not self._shares:
                    self._preparing.close()

    def _prepare_instead(self, former: ViewSet | None, cameras: Sequence[Camera], memory: Memory | None) -> ViewSet:
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
        return self.prepare_set(cameras, memory)

    def prepare(self, camera: Camera) -> View:
        """Find projection, tile lists and depth order of a view, which :meth:`composite` can use any number of times.

        Returns:
            The view, with buffers of its own, which are no larger than needed; the caller closes it.

        Raises:
            DeviceError: it does not fit the device.
        """
        return self.prepare_set([camera]).views[0]

    @contextmanager
    def preparing_many(self) -> Iterator[None]:
        """Inside the block, memory that sets are prepared in is kept for the next one: drivers take long to give it."""
        self._keeps_preparing = True
        try:
            yield
        finally:
            self._keeps_preparing = False
            if self._prepared_several:
                self._rest_preparing()

    def prepare_set(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """:meth:`prepare` several views, and wait for the device only once. CPU kernels take one view at a time.

        Args:
            cameras: of the views.
            memory: to take the views' buffers from, which is closed with them; None: memory of their own.

        Returns:
            The views; the caller closes them.

        Raises:
            DeviceMemoryError: they do not fit the device, or not all in buffers of the size that it allows.
            DeviceError: one view alone has too many intersections, or the device failed.
        """
        views = ViewSet(self.device, cameras, self.stride, self._launcher.subtile_bytes, memory)
        try:
            counts, bounds = self._zeroed_counts(views), self._room_for_bounds(views)
            self._enqueue_project(views, bounds)
            self._launcher.enqueue_offsets(views, bounds, counts)
            # All of them, while there is nothing else to wait for: the lists are enqueued behind them.
            views.found_offsets = views.read_offsets()
            found = [int(offsets[-1]) for offsets in views.found_offsets]
            for view, count in zip(views.views, found, strict=True):
                _accept(view, count)
            views.make_room(found)
            self._enqueue_lists(views, bounds, counts, for_frame=False)
        except BaseException:
            self._preparing.counts.close()  # not zero
            if len(cameras) > 1:
                self._rest_preparing()
            views.close()
            raise
        if len(cameras) > 1:  # far more than a single view will need
            self._prepared_several = True
            if not self._keeps_preparing:
                self._rest_preparing()
        return views

    def _rest_preparing(self) -> None:
        self._prepared_several = False
        if not self._shares:
            self._preparing.rest()

    def prepare_again(self, views: ViewSet, cameras: Sequence[Camera]) -> bool:
        """Point prepared views at other cameras, in the memory that they have; more is taken only where it must be.

        Args:
            views: as :meth:`prepare_set` gave them.
            cameras: as many as there are views.

        Returns:
            Whether each of the cameras has as many tiles across and down as the view that it takes the place of. If
            not, nothing was done.

        Raises:
            As :meth:`prepare_set`; the views are of no use then.
        """
        if not views.aim_all(cameras):
            return False
        try:
            counts, bounds = self._zeroed_counts(views), self._room_for_bounds(views)
            self._enqueue_project(views, bounds)
            self._launcher.enqueue_offsets(views, bounds, counts)
            found = views.read_counts()
            for view, count in zip(views.views, found, strict=True):
                _accept(view, count)
            if any(count > view.capacity for view, count in zip(views.views, found, strict=True)):
                views.make_room([count + count // 4 for count in found])
            self._enqueue_lists(views, bounds, counts, for_frame=False)
        except BaseException:
            self._preparing.counts.close()  # not zero
            raise
        return True

    def composite(self, view: View) -> tuple[FloatArray, FloatArray]:
        """The picture of a prepared view; returns what :meth:`render` returns."""
        self._enqueue_composite(view.owner)
        return self._pictures(view.camera)

    def project(
        self,
        views: ViewSet,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        """Enqueue only the projection of prepared views; with other SH, or into other buffers, if these are given."""
        self._enqueue_project(views, self._room_for_bounds(views), sh, shapes, colours)

    @property
    def sh(self) -> cl.Buffer:
        """The SH coefficients that splats have now, as :class:`~potr_cl.raster.scene_buffers.SceneBuffers` has them."""
        return self._scene.sh if self._replaced is None else self._replaced

    def replace_sh(self, sh: FloatArray) -> cl.Buffer | None:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Views that were prepared before keep their colours until they are projected again.

        Returns:
            The buffer of the former coefficients, which is the caller's to free; None if they are those of a scene that
            lay on the device already, and stay there.
        """
        former = self.sh
        self._replaced = self._scene.other_sh(self._other_sh, sh)
        if former is not self._scene.sh:
            return self._other_sh.release(former)
        return self._scene.release_sh() if self._owns else None

    def _room_for_bounds(self, views: ViewSet) -> cl.Buffer:
        self._preparing.bounds.reserve(8 * self.stride * len(views.views))
        return self._preparing.bounds.buffer

    def _zeroed_counts(self, views: ViewSet) -> cl.Buffer:
        """Counters for all tiles. They are zero, and the kernels that use them leave them zero."""
        if self._preparing.counts.reserve(self._launcher.counter_bytes * views.tiles):
            self.device.fill(self._preparing.counts.buffer, np.uint32(0), self._preparing.counts.nbytes)
        return self._preparing.counts.buffer

    def _enqueue_project(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        self._projection.bind(
            **self._scene.geometry,
            **self._scene.picks,
            sh=self.sh if sh is None else sh,
            views=views.table,
            shapes=views.shapes if shapes is None else shapes,
            colours=views.colours if colours is None else colours,
            bounds=bounds,
        )
        lanes = self._launcher.lanes
        self._projection.launch((self.stride // lanes, len(views.views)), (SPLAT_GROUP // lanes, 1))

    def _enqueue_lists(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer, for_frame: bool) -> None:
        self._preparing.keys.reserve(self._launcher.key_bytes * views.capacity)
        self._launcher.enqueue_lists(views, bounds, counts, self._preparing.keys.buffer, for_frame)

    def _enqueue_composite(self, views: ViewSet) -> None:
        """Enqueue the pictures, one behind the other into the rasterizer's own image."""
        self._image.reserve(12 * views.pixels)
        self._transmittance.reserve(4 * views.pixels)
        self._launcher.enqueue_composite(views, self.background, self._image.buffer, self._transmittance.buffer)

    def _pictures(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        shape = (camera.height, camera.width)
        return (
            self.device.download(self._image.buffer, (*shape, 3), np.float32),
            self.device.download(self._transmittance.buffer, shape, np.float32),
        )

    def _frame_view(self, camera: Camera) -> ViewSet:
        """The view that :meth:`render` uses again and again; its lists keep the room that earlier views needed."""
        old = self._frame
        capacity = max(_FIRST_CAPACITY_A_SPLAT * self.splats, _FIRST_CAPACITY)
        if old is not None:
            if old.aim(camera):
                return old
            capacity = max(capacity, old.capacity)
            old.close()
            self._frame = None
        views = ViewSet(self.device, [camera], self.stride, self._launcher.subtile_bytes)
        try:
            views.make_room([capacity])
        except BaseException:
            views.close()
            raise
        self._frame = views
        return views

    def rest(self) -> None:
        """Give the scratch memory back until it is needed again; of frames and pictures nothing is left."""
        if self._frame is not None:
            self._frame.close()
            self._frame = None
        if not self._shares:
            self._preparing.close()

    def close(self) -> None:
        if self._frame is not None:
            self._frame.close()
        for owner in (
            *([self._scene] if self._owns else []),
            self._other_sh,
            *([] if self._shares else [self._preparing]),
        ):
            owner.close()


def render(
    scene: Scene,
    camera: Camera,
    device: Device | None = None,
    rules: RasterRules = INRIA,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialiased: bool | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Render one view of a scene; for many views keep a :class:`Rasterizer`.

    Args:
        device: to render on; the best one there is by default.
        antialiased: whether to render it as an antialiased scene; None: as it was trained.

    Returns, Raises: as :meth:`Rasterizer.render`.
    """
    with Rasterizer(device or Device(), scene.rendered(antialiased), rules, background) as rasterizer:
        return rasterizer.render(camera)


def _filter_macros(scene: SceneBuffers) -> dict[str, float]:
    """Macros of the projection that an antialiased scene needs; the kernel of classic ones has no trace of it."""
    if not scene.antialiased:
        return {}
    macros = {"ANTIALIASED": 1, "LEAST_COMPENSATION_SQUARED": LEAST_COMPENSATION**2}
    if scene.low_pass != LOW_PASS:
        macros |= {"LOW_PASS": scene.low_pass, "LOW_PASS_SQUARED": scene.low_pass**2}
    return macros


def _accept(view: View, count: int) -> None:
    """Note in a view how many intersections the device has found."""
    if count == 0xFFFFFFFF:
        raise DeviceError(
            f"view '{view.camera.name}' needs more than 2^32 tile intersections: "
            "too many huge splats for this image size"
        )
    view.intersection_count = count
