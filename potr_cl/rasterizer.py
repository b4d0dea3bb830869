"""The rasterizer: projection, tile lists, depth order and compositing of one view after the other.

The stages run in this order and leave their results in device buffers of a :class:`View`, so that whoever needs a view
more than once keeps the view and repeats only the last stage:

1. ``project``: each splat's ellipse and colour on screen (cl/project.cl);
2. ``count_tiles``, ``scan_tiles``, ``fill_tiles``: which splats touch which 16 x 16 tile (cl/tile_lists_*.cl);
3. ``sort_tiles``: each tile's list front to back (cl/sort_*.cl); on CPUs ``entry_patches``: which parts of its tile
   each entry touches (cl/entry_patches_cpu.cl);
4. ``composite``: the picture (cl/composite_*.cl).

Semantics: the original 3DGS rasterizer (Kerbl et al. 2023); where renderers differ, :class:`RasterRules` says how.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.cameras import Camera
from potr_cl.device import Device, Scratch
from potr_cl.errors import DeviceError, UsageError
from potr_cl.scene import FloatArray, Scene

TILE = 16

#: Splats are padded to a multiple of this and handled in groups of it. CPUs are told the group too: left to itself,
#: PoCL makes one of thousands and overflows its stack with their private memory.
_SPLAT_GROUP = 256

#: A tile's counter on the device with room to the next, enough for both kernel families.
_COUNTER_BYTES = 32

#: Tiles along a side of the image: the kernels number them in 16 bits.
_MOST_TILES = 0xFFFF

#: Standard deviations above this many world units are taken as this: nothing can be seen to differ, nothing overflows.
_LARGEST_SCALE = 1e12

#: Where the SH coefficients stand among the kernel's parameters.
_SH = 4

_CAMERA = np.dtype(
    [
        ("rotation", np.float32, 9),
        ("eye_high", np.float32, 3),
        ("eye_low", np.float32, 3),
        ("focal", np.float32, 2),
        ("principal", np.float32, 2),
        ("limit", np.float32, 2),
        ("size", np.int32, 2),
        ("tiles", np.int32, 2),
    ]
)


@dataclass(frozen=True)
class RasterRules:
    """The rules in which rasterizers differ.

    Attributes:
        near: splats whose view-space depth is at or below this, in world units, are not drawn.
        alpha_cap: largest alpha of a splat in a pixel.
        square_extent: draw a splat only in the tiles that the square of half side ceil(3 sigma_max) around its centre
            touches, as the original does; without, wherever its alpha reaches 1/255.
        stop_included: a pixel ends before a splat that would bring its transmittance to 1e-4 exactly; without, only
            below.
    """

    near: float = 0.2
    alpha_cap: float = 0.99
    square_extent: bool = True
    stop_included: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.near) and self.near > 0):
            raise UsageError(f"the near plane must be a positive distance, not {self.near}")
        if not 1 / 255 <= self.alpha_cap < 1:
            raise UsageError(f"the alpha cap must lie in [1/255, 1), not {self.alpha_cap}")

    @property
    def stop(self) -> float:
        """A pixel ends before its transmittance would fall below this float32."""
        stop = np.float32(1e-4)
        return float(np.nextafter(stop, np.float32(1)) if self.stop_included else stop)


#: The original 3DGS rasterizer.
INRIA = RasterRules()
#: gsplat's rasterizer, with the original's near plane instead of its own default of 0.01.
GSPLAT = RasterRules(alpha_cap=0.999, square_extent=False, stop_included=True)


@lru_cache(maxsize=4096)
def camera_struct(camera: Camera) -> NDArray[Any]:
    """The camera as the kernels take it (``View`` in cl/splat.clh)."""
    struct = np.zeros((), _CAMERA)
    struct["rotation"] = camera.rotation.ravel()
    struct["eye_high"] = camera.centre
    struct["eye_low"] = camera.centre - struct["eye_high"]
    struct["focal"] = camera.fx, camera.fy
    struct["principal"] = camera.cx, camera.cy
    struct["limit"] = 1.3 * camera.width / (2 * camera.fx), 1.3 * camera.height / (2 * camera.fy)
    struct["size"] = camera.width, camera.height
    struct["tiles"] = _tiles(camera)
    return struct


def _tiles(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles that cover the image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


class View:
    """One camera's projection, tile lists and depth order, in device buffers.

    Attributes:
        camera: whose view it is.
        columns, rows: tiles across and down.
        shapes: (N, 8) float32, a splat's ellipse, see cl/splat.clh.
        colours: (N, 4) float32; R, G, B of the splats that are drawn, the rest unset.
        offsets: (columns * rows + 1,) uint32, where each tile's run of ``entries`` begins.
        entry_count: entries there are; set once the device is known to have found them all.
    """

    def __init__(self, device: Device, camera: Camera, splats: int, capacity: int) -> None:
        self._device = device
        self.camera = camera
        self.columns, self.rows = _tiles(camera)
        if max(self.columns, self.rows) > _MOST_TILES:
            raise UsageError(
                f"view '{camera.name}': {camera.width} x {camera.height} pixels are more than {_MOST_TILES * TILE} "
                "on a side; render a smaller image"
            )
        with device.all_or_nothing():
            self.shapes = device.allocate(32 * splats, "the projected splats")
            self.colours = device.allocate(16 * splats, "the projected splats' colours")
            self.offsets = device.allocate(4 * (self.tiles + 1), "the tile offsets")
            self._lists = Scratch(device, "the tile lists")
            self._lists.reserve(4 * capacity)
            self._patches = Scratch(device, "the entries' patches") if device.family == "cpu" else None
            if self._patches is not None:
                self._patches.reserve(4 * capacity)
        self.entry_count = 0

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.columns * self.rows

    @property
    def entries(self) -> cl.Buffer:
        """(capacity,) uint32 splat numbers, tile by tile, front to back within a tile."""
        return self._lists.buffer

    @property
    def lists(self) -> tuple[cl.Buffer, ...]:
        """The entries and, for CPU kernels, their patches: (capacity,) uint32 a bit for each patch of its tile that an
        entry touches (cl/patches.clh)."""
        return (self.entries,) if self._patches is None else (self.entries, self._patches.buffer)

    @property
    def capacity(self) -> int:
        """Entries that there is room for."""
        return self._lists.nbytes // 4

    def grow(self, capacity: int) -> None:
        """Make room for more entries; those there are get lost."""
        self._lists.reserve(4 * capacity)
        if self._patches is not None:
            self._patches.reserve(4 * capacity)

    def trim(self) -> None:
        """Give back the room that the entries do not need."""
        self._lists = self._trimmed(self._lists, "the tile lists")
        if self._patches is not None:
            self._patches = self._trimmed(self._patches, "the entries' patches")

    def _trimmed(self, scratch: Scratch, what: str) -> Scratch:
        trimmed = Scratch(self._device, what)
        trimmed.reserve(4 * self.entry_count)
        if self.entry_count:
            cl.enqueue_copy(self._device.queue, trimmed.buffer, scratch.buffer, byte_count=4 * self.entry_count)
        scratch.free()
        return trimmed

    def free_geometry(self) -> None:
        """Give shapes and colours back, for those who keep the lists and project again (:meth:`Rasterizer.project`)."""
        for buffer in (self.shapes, self.colours):
            if buffer is not None:
                self._device.free(buffer)
        self.shapes = self.colours = None

    def free(self) -> None:
        """Give the buffers back."""
        self.free_geometry()
        self._device.free(self.offsets)
        self._lists.free()
        if self._patches is not None:
            self._patches.free()


class Rasterizer:
    """Renders one scene on one device, with the scene and all scratch memory kept there.

    Args:
        device: to render on.
        scene: to render; copied to the device, later changes of its arrays are not seen.
        rules: of the rasterizer to follow.
        background: R, G, B behind everything.

    Attributes:
        device, rules, background: as given.
        splats: N. stride: N padded; buffers of a value a splat hold so many.

    Raises:
        DeviceError: the scene does not fit, or the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        rules: RasterRules = INRIA,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        if len(scene) > 0xFFFFFF00:
            raise DeviceError(f"{len(scene)} splats are more than the kernels can number")
        self.device = device
        self.rules = rules
        self.background = background
        self.splats = len(scene)
        self.stride = max(-(-len(scene) // _SPLAT_GROUP), 1) * _SPLAT_GROUP
        with device.all_or_nothing():
            self._upload(scene)
            self._build(scene.sh.shape[1])
            self._bounds = device.allocate(8 * self.stride, "the projected splats' bounds")
            self._total = device.allocate(4, "the entry count")
        self._counts = Scratch(device, "the tile counts")
        self._keys = Scratch(device, "the tile lists' sort keys")
        self._image = Scratch(device, "the image")
        self._transmittance = Scratch(device, "the transmittance")
        self._scratch: View | None = None
        self._bound: View | None = None

    def _upload(self, scene: Scene) -> None:
        """Activate the parameters and copy them, structure of arrays, padded to the stride."""

        upload = self._upload_columns
        quaternions = scene.quaternions.astype(np.float64)
        length = np.linalg.norm(quaternions, axis=1, keepdims=True)
        quaternions = np.where(length > 0, quaternions / np.where(length > 0, length, 1), (1.0, 0.0, 0.0, 0.0))
        scales = np.minimum(np.exp(np.minimum(scene.log_scales.astype(np.float64), 100)), _LARGEST_SCALE)
        log2_opacities = -np.logaddexp(0, -scene.opacity_logits.astype(np.float64)) / np.log(2)
        self._parameters = [
            upload(scene.means, 0, "the centres"),
            upload(scales, 0, "the scales"),
            upload(quaternions, 0, "the rotations"),
            upload(log2_opacities[:, None], -np.inf, "the opacities"),
            upload(scene.sh.reshape(self.splats, -1), 0, "the SH coefficients"),
        ]

    def _upload_columns(self, columns: NDArray[Any], fill: float, what: str) -> cl.Buffer:
        padded = np.full((columns.shape[1], self.stride), fill, np.float32)
        padded[:, : self.splats] = columns.T
        return self.device.upload(padded, what)

    def _build(self, sh_count: int) -> None:
        device, rules = self.device, self.rules
        self._lanes = 1 if device.family == "gpu" else device.vector_width
        row_lanes = max(self._lanes, 8)
        self._project = device.kernel(
            "project.cl",
            "project",
            LANES=self._lanes,
            SH_COUNT=sh_count,
            NEAR=float(rules.near),
            SQUARE_EXTENT=int(rules.square_extent),
        )
        # Work-items that share a tile. On a CPU one: PoCL would keep the private memory of more of them on its stack.
        self._tile_group = 256 if device.family == "gpu" else 1
        lists = f"tile_lists_{device.family}.cl"
        self._count = device.kernel(lists, "count_tiles")
        self._scan = device.kernel(lists, "scan_tiles")
        self._fill = device.kernel(lists, "fill_tiles")
        limits = {"ALPHA_CAP": float(rules.alpha_cap), "STOP": rules.stop}
        if device.family == "gpu":
            # 16 KB of keys: half of what every GPU has, so that two tiles are sorted at a time.
            self._sort = device.kernel("sort_gpu.cl", "sort_tiles", SORT_CAPACITY=2048)
            self._composite = device.kernel(
                "composite_gpu.cl", "composite", NATIVE_EXP2=int(device.native_exp2), **limits
            )
        else:
            self._sort = device.kernel("sort_cpu.cl", "sort_tiles")
            self._entry_patches = device.kernel("entry_patches_cpu.cl", "entry_patches", LANES=row_lanes)
            self._composite = device.kernel("composite_cpu.cl", "composite", LANES=row_lanes, **limits)

    def _bind(self, view: View) -> None:
        """Scratch memory for a view, and all kernel arguments but the camera; does nothing for the view bound last."""
        device = self.device
        if self._counts.reserve(_COUNTER_BYTES * view.tiles):  # zero at first; each view leaves them so
            zeros = np.zeros(self._counts.nbytes // 4, np.uint32)
            cl.enqueue_copy(device.queue, self._counts.buffer, zeros, is_blocking=True)
            self._bound = None
        pixels = view.camera.width * view.camera.height
        for scratch, size in (
            # The bitonic network sorts in place, merging needs room for as many keys again.
            (self._keys, (8 if device.family == "gpu" else 16) * view.capacity),
            (self._image, 12 * pixels),
            (self._transmittance, 4 * pixels),
        ):
            if scratch.reserve(size):
                self._bound = None
        if self._bound is view:
            return
        stride, capacity = np.uint32(self.stride), np.uint32(view.capacity)
        keys, counts, camera = self._keys.buffer, self._counts.buffer, camera_struct(view.camera)
        self._project.set_args(*self._parameters, stride, camera, view.shapes, view.colours, self._bounds)
        self._count.set_args(self._bounds, view.shapes, stride, camera, counts)
        self._scan.set_args(counts, view.offsets, np.uint32(view.tiles), self._total)
        self._fill.set_args(self._bounds, view.shapes, stride, camera, counts, keys, capacity)
        self._sort.set_args(keys, view.offsets, view.entries, counts, capacity)
        if device.family == "cpu":
            self._entry_patches.set_args(view.shapes, view.offsets, *view.lists, capacity, camera)
        self._composite.set_args(
            view.shapes,
            view.colours,
            view.offsets,
            *view.lists,
            capacity,
            camera,
            *(np.float32(channel) for channel in self.background),
            self._image.buffer,
            self._transmittance.buffer,
        )
        self._bound = view

    def _enqueue_project(self, view: View) -> None:
        self._project.set_arg(6, camera_struct(view.camera))
        self.device.launch(self._project, (self.stride // self._lanes,), (_SPLAT_GROUP // self._lanes,))

    def replace_sh(self, sh: FloatArray) -> cl.Buffer:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Views that were prepared before keep their colours until they are projected again.

        Returns:
            The buffer of the former coefficients, which is the caller's to free.
        """
        former = self._parameters[_SH]
        self._parameters[_SH] = self._upload_columns(sh.reshape(self.splats, -1), 0, "the SH coefficients")
        self._bound = None
        return former

    def project(self, camera: Camera, shapes: cl.Buffer, colours: cl.Buffer, sh: cl.Buffer | None = None) -> None:
        """Enqueue a view's projection alone, into buffers like :class:`View`'s; with other SH if ``sh`` is given."""
        parameters = [*self._parameters[:_SH], self._parameters[_SH] if sh is None else sh]
        self._project.set_args(
            *parameters, np.uint32(self.stride), camera_struct(camera), shapes, colours, self._bounds
        )
        self._bound = None
        self.device.launch(self._project, (self.stride // self._lanes,), (_SPLAT_GROUP // self._lanes,))

    def _enqueue_lists(self, view: View) -> None:
        """Enqueue tile lists and depth order of a projected view."""
        camera = camera_struct(view.camera)
        launch = self.device.launch
        self._count.set_arg(3, camera)
        launch(self._count, (self.stride,), (_SPLAT_GROUP,))
        launch(self._scan, (self._tile_group,), (self._tile_group,))
        self._fill.set_arg(3, camera)
        launch(self._fill, (self.stride,), (_SPLAT_GROUP,))
        launch(self._sort, (view.tiles * self._tile_group,), (self._tile_group,))
        if self.device.family == "cpu":
            self._entry_patches.set_arg(5, camera)
            launch(self._entry_patches, (view.tiles,), (1,))

    def _enqueue_composite(self, view: View) -> None:
        self._composite.set_arg(4 + len(view.lists), camera_struct(view.camera))
        self.device.launch(self._composite, (view.tiles * self._tile_group,), (self._tile_group,))

    def _settle(self, view: View) -> bool:
        """Wait for the entry count; make room and say False if the lists did not fit."""
        count = int(self.device.download(self._total, (1,), np.uint32)[0])
        if count == 0xFFFFFFFF:
            raise DeviceError(
                f"view '{view.camera.name}' needs more than 2^32 tile entries: too many huge splats for this image size"
            )
        view.entry_count = count
        if count <= view.capacity:
            return True
        self._bound = None
        view.grow(count + count // 4)
        return False

    def _first_capacity(self) -> int:
        """Room for entries before anything is known of a view."""
        return max(4 * self.splats, 1 << 16)

    def prepare(self, camera: Camera) -> View:
        """Projection, tile lists and depth order of a view, to keep for as many :meth:`composite` as wanted.

        Returns:
            The view, with buffers of its own, its list no longer than needed; :meth:`View.free` it.

        Raises:
            DeviceError: it does not fit the device.
        """
        view = View(self.device, camera, self.stride, self._first_capacity())
        try:
            self._bind(view)
            self._enqueue_project(view)
            self._enqueue_lists(view)
            while not self._settle(view):
                self._bind(view)
                self._enqueue_lists(view)
            view.trim()
        except BaseException:
            view.free()
            raise
        finally:
            self._bound = None
        return view

    def composite(self, view: View) -> tuple[FloatArray, FloatArray]:
        """The picture of a prepared view: as :meth:`render`."""
        self._bind(view)
        self._enqueue_composite(view)
        return self._pictures(view.camera)

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
        view = self._scratch_view(camera)
        self._bind(view)
        self._enqueue_project(view)
        self._enqueue_lists(view)
        self._enqueue_composite(view)
        # Lists that did not fit are cut short, so the kernels above were safe; their result is thrown away.
        while not self._settle(view):
            self._bind(view)
            self._enqueue_lists(view)
            self._enqueue_composite(view)
        return self._image.buffer, self._transmittance.buffer

    def _pictures(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        shape = (camera.height, camera.width)
        return (
            self.device.download(self._image.buffer, (*shape, 3), np.float32),
            self.device.download(self._transmittance.buffer, shape, np.float32),
        )

    def _scratch_view(self, camera: Camera) -> View:
        """The view that :meth:`render` uses again and again; its lists keep the room that earlier views needed."""
        old = self._scratch
        if old is not None and (old.columns, old.rows) == _tiles(camera):
            old.camera = camera
            return old
        capacity = self._first_capacity()
        if old is not None:
            capacity = max(capacity, old.capacity)
            old.free()
            self._scratch = None
        self._scratch = View(self.device, camera, self.stride, capacity)
        return self._scratch

    def free(self) -> None:
        """Give all device memory back; the rasterizer is of no use afterwards."""
        if self._scratch is not None:
            self._scratch.free()
        for buffer in (*self._parameters, self._bounds, self._total):
            self.device.free(buffer)
        for scratch in (self._counts, self._keys, self._image, self._transmittance):
            scratch.free()


def render(
    scene: Scene,
    camera: Camera,
    device: Device | None = None,
    rules: RasterRules = INRIA,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[FloatArray, FloatArray]:
    """Render one view of a scene; for many views keep a :class:`Rasterizer`.

    Args:
        device: to render on; the best one there is by default.

    Returns, Raises: as :meth:`Rasterizer.render`.
    """
    rasterizer = Rasterizer(device or Device(), scene, rules, background)
    try:
        return rasterizer.render(camera)
    finally:
        rasterizer.free()
