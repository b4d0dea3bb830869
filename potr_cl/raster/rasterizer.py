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

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.launcher import RasterLauncher
from potr_cl.raster.preparation import Preparation, Projection
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers, uploaded
from potr_cl.raster.view_set import ViewSet

#: Least room for intersections before anything is known of a view, and as a multiple of the splats.
_FIRST_CAPACITY, _FIRST_CAPACITY_A_SPLAT = 1 << 16, 4
#: Bytes of a strip of a picture.
_STRIP = 1 << 26
#: Projected splats of the views that are rendered together. More take gigabytes, and a driver long to find them.
_PROJECTED = 1 << 26


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
            self._launcher = RasterLauncher(device, rules)
            self._projection = Projection(device, self._scene, rules, self._launcher.lanes)
        self._preparation = Preparation(device, self._scene.stride, self._projection, self._launcher, preparing)
        memory = self._preparation.memory
        self._image, self._transmittance = memory.image, memory.transmittance
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
        return dict(self._projection.filter_macros)

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

    def strips(self, camera: Camera) -> Iterator[FloatArray]:
        """The image of :meth:`render` from top to bottom, a strip (rows, W, 3) after the other: for huge pictures."""
        image, _ = self.render_device(camera)
        rows = max(_STRIP // (12 * camera.width), 1)
        for first in range(0, camera.height, rows):
            shape = (min(rows, camera.height - first), camera.width, 3)
            yield self.device.download(image, shape, np.float32, 12 * camera.width * first)

    def render_device(self, camera: Camera) -> tuple[cl.Buffer, cl.Buffer]:
        """Render one view and leave it on the device, finished.

        Returns:
            Buffers that begin with the image and the transmittance, as :meth:`render` describes them; the next call
            overwrites them.
        """
        views = self._frame_view(camera)
        (view,) = views.views
        with self._preparation.counting():
            while True:
                self._preparation.enqueue_frame(views)
                self._enqueue_composite(views)
                # The picture of lists that were cut short is thrown away.
                (count,) = self._preparation.counted(views)
                if count <= view.capacity:
                    return self._image.buffer, self._transmittance.buffer
                views.make_room([count + count // 4])

    def render_into(self, cameras: Sequence[Camera], target: cl.Buffer, start: int = 0) -> None:
        """Render views one behind the other into a buffer; on a GPU, several at a time.

        Args:
            cameras: of the views.
            target: takes (pixels, 3) float32.
            start: byte where they begin.
        """
        try:
            last = self.render_again(cameras, target, start)
            if last is not None:
                last.close()
        finally:
            if self._launcher.whole_sets:
                self._preparation.close()

    def render_again(
        self, cameras: Sequence[Camera], target: cl.Buffer, start: int = 0, former: ViewSet | None = None
    ) -> ViewSet | None:
        """:meth:`render_into` for callers that render again and again.

        Args:
            former: what the last call has returned, whose memory is taken; of no use any more.

        Returns:
            What the views were prepared in, for the next call, and the caller's to close at last; None on a CPU.
        """
        device = self.device

        def copied(image: cl.Buffer, pixels: int) -> None:
            nonlocal start
            cl.enqueue_copy(device.queue, target, image, byte_count=12 * pixels, dst_offset=start)
            start += 12 * pixels

        def composited(views: ViewSet) -> None:
            self._enqueue_composite(views)
            copied(self._image.buffer, views.pixels)

        if self._launcher.whole_sets:
            left = device.info.memory - device.allocated + (0 if former is None else former.nbytes)
            most = int(max(min(left // 512, _PROJECTED) // self.stride, 1))
            return self._preparation.in_sets(composited, cameras, most, former)
        for camera in cameras:
            image, _ = self.render_device(camera)
            copied(image, camera.width * camera.height)
        return None

    def pictures_into(self, views: ViewSet, target: cl.Buffer, start: int = 0) -> None:
        """Enqueue the pictures of prepared views, one behind the other into a buffer from byte ``start`` on."""
        self._enqueue_composite(views)
        cl.enqueue_copy(self.device.queue, target, self._image.buffer, byte_count=12 * views.pixels, dst_offset=start)

    @contextmanager
    def preparing_many(self) -> Iterator[None]:
        """Inside the block, memory that sets are prepared in is kept for the next one: drivers take long to give it."""
        with self._preparation.of_many_sets():
            yield

    def prepare_set(self, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        """Find projection, tile lists and depth order of views, which :meth:`composite` can use any number of times.

        The device is waited for only once, and buffers are no larger than needed. CPU kernels take one view at a time.

        Args:
            cameras: of the views.
            memory: to take the views' buffers from, which is closed with them; None: memory of their own.

        Returns:
            The views; the caller closes them.

        Raises:
            DeviceMemoryError: they do not fit the device, or not all in buffers of the size that it allows.
            DeviceError: one view alone has too many intersections, or the device failed.
        """
        return self._preparation.prepare_set(cameras, memory)

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
        return self._preparation.prepare_again(views, cameras)

    def projected(self, cameras: Sequence[Camera], former: ViewSet | None = None) -> ViewSet:
        """Views with nothing but their projection, which is enqueued.

        Args:
            cameras: of the views.
            former: views that this gave before, whose memory is taken, or given back; of no use any more.

        Returns:
            The views; the caller closes them.

        Raises:
            DeviceMemoryError: they do not fit the device.
        """
        views = former
        if views is None or not views.aim(cameras):
            if views is not None:
                views.close()
            views = self._preparation.new_views(cameras)
        self.project(views)
        return views

    def composite(self, views: ViewSet) -> tuple[FloatArray, FloatArray]:
        """The picture of a prepared set's only view; returns what :meth:`render` returns."""
        self._enqueue_composite(views)
        return self._pictures(views.views[0].camera)

    def project(
        self,
        views: ViewSet,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        """Enqueue only the projection of prepared views; with other SH, or into other buffers, if these are given."""
        self._projection.enqueue(views, self._preparation.room_for_bounds(views), sh, shapes, colours)

    @property
    def sh(self) -> cl.Buffer:
        """The SH coefficients that splats have now, as :class:`~potr_cl.raster.scene_buffers.SceneBuffers` has them."""
        return self._projection.sh

    def replace_sh(self, sh: FloatArray) -> cl.Buffer | None:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Views that were prepared before keep their colours until they are projected again.

        Returns:
            The buffer of the former coefficients, which is the caller's to free; None if they are those of a scene that
            lay on the device already, and stay there.
        """
        former = self._projection.replace_sh(sh)
        return self._scene.release_sh() if former is None and self._owns else former

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
            if old.views[0].camera is camera or old.aim([camera]):
                return old
            capacity = max(capacity, old.capacity)
            old.close()
            self._frame = None
        views = self._preparation.new_views([camera])
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
        self._preparation.close()

    def close(self) -> None:
        if self._frame is not None:
            self._frame.close()
        for owner in (*([self._scene] if self._owns else []), self._projection, self._preparation):
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
