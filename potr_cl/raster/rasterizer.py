"""The rasterizer: projection, tile lists, depth order and compositing of one view after the other.

The stages run in this order and leave their results in device buffers of a :class:`ViewSet`, so that whoever needs
views more than once keeps them and repeats only the last stage:

1. ``project``: each splat's ellipse and colour on screen (cl/raster/project.cl);
2. ``count_tiles``, ``scan_tiles``, ``fill_tiles``: which splats touch which 16 x 16 tile (cl/raster/tile_lists_*.cl);
3. ``sort_tiles``: each tile's list front to back (cl/raster/sort_*.cl); ``subtile_masks``: which parts of its tile each
   intersection touches (cl/raster/subtile_masks_*.cl);
4. ``composite``: the picture (cl/raster/composite_*.cl).

A GPU's kernels do all views of a set in one launch, a CPU's one view at a time. A view alone on a GPU is composited by
``composite_frame`` (cl/raster/composite_frame_gpu.cl), which needs no sub-tiles.

Semantics: the original 3DGS rasterizer (Kerbl et al. 2023); where renderers differ, :class:`RasterRules` says how.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceError, DeviceMemoryError, UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.opencl.structs import struct_dtype

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

#: Bytes of an intersection's sub-tiles.
_SUBTILES_BYTES = {"cpu": 4, "gpu": 2}

#: Splats whose parameters are uploaded at a time.
_UPLOADED = 1 << 18

#: Where the SH coefficients stand among the kernel's parameters.
_SH = 4

#: ``View`` of the kernels, and ``SetView``, which has one.
_CAMERA = struct_dtype("include/splat.clh", "View")
_SET_VIEW = struct_dtype("include/view_set.clh", "SetView")

#: Work-items of a work-group a tile, stage by stage. On a CPU one: PoCL would keep the private memory of more of them
#: on its stack.
_TILE_GROUPS = {
    "cpu": {"scan": 1, "sort": 1, "subtiles": 1, "composite": 1},
    "gpu": {"scan": 256, "sort": 256, "subtiles": 128, "composite": 128, "frame": 256},
}


@dataclass(frozen=True)
class RasterRules:
    """The rules in which rasterizers differ.

    Attributes:
        near: splats whose view-space depth is at or below this, in world units, are not drawn.
        alpha_cap: largest alpha of a splat in a pixel.
        square_extent: draw a splat only in the tiles that the square of half side ceil(3 sigma_max) around its centre
            touches, as the original does; without, wherever its alpha reaches 1/255.
        threshold_included: a pixel ends before a splat that would bring its transmittance to 1e-4 exactly; without,
            only below.
    """

    near: float = 0.2
    alpha_cap: float = 0.99
    square_extent: bool = True
    threshold_included: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.near) and self.near > 0):
            raise UsageError(f"the near plane must be a positive distance, not {self.near}")
        if not 1 / 255 <= self.alpha_cap < 1:
            raise UsageError(f"the alpha cap must lie in [1/255, 1), not {self.alpha_cap}")

    @property
    def transmittance_threshold(self) -> float:
        """A pixel ends before its transmittance would fall below this float32."""
        threshold = np.float32(1e-4)
        return float(np.nextafter(threshold, np.float32(1)) if self.threshold_included else threshold)


#: The original 3DGS rasterizer.
INRIA = RasterRules()
#: gsplat's rasterizer, with the original's near plane instead of its own default of 0.01.
GSPLAT = RasterRules(alpha_cap=0.999, square_extent=False, threshold_included=True)


@lru_cache(maxsize=4096)
def camera_struct(camera: Camera) -> NDArray[Any]:
    """The camera as the kernels take it (``View`` in cl/include/splat.clh)."""
    struct = np.zeros((), _CAMERA)
    struct["rotation"] = camera.rotation.ravel()
    struct["camera_centre_high"] = camera.centre
    struct["camera_centre_low"] = camera.centre - struct["camera_centre_high"]
    struct["fx"], struct["fy"] = camera.fx, camera.fy
    struct["cx"], struct["cy"] = camera.cx, camera.cy
    struct["limit_x"] = 1.3 * camera.width / (2 * camera.fx)
    struct["limit_y"] = 1.3 * camera.height / (2 * camera.fy)
    struct["width"], struct["height"] = camera.width, camera.height
    struct["columns"], struct["rows"] = _tiles(camera)
    return struct


def _tiles(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles that cover the image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


class View:
    """One camera's part of a :class:`ViewSet`; the buffers are there for the only view of a set.

    Attributes:
        owner: the set.
        camera: whose view it is.
        columns, rows: tiles across and down.
        intersection_count: intersections there are; set once the device is known to have found them all.
        capacity: intersections that there is room for.
    """

    def __init__(self, owner: ViewSet, camera: Camera) -> None:
        self.owner = owner
        self.camera = camera
        self.columns, self.rows = _tiles(camera)
        if max(self.columns, self.rows) > _MOST_TILES:
            raise UsageError(
                f"view '{camera.name}': {camera.width} x {camera.height} pixels are more than {_MOST_TILES * TILE} "
                "on a side; render a smaller image"
            )
        self.intersection_count = self.capacity = 0

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return self.columns * self.rows

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.camera.width * self.camera.height

    @property
    def shapes(self) -> cl.Buffer:
        """(N, 8) float32, a splat's ellipse, see cl/include/splat.clh."""
        return self._alone.shapes

    @property
    def colours(self) -> cl.Buffer:
        """(N, 4) float32; R, G, B of the splats that are drawn, the rest unset."""
        return self._alone.colours

    @property
    def offsets(self) -> cl.Buffer:
        """(columns * rows + 1,) uint32, where each tile's run of ``intersections`` begins."""
        return self._alone.offsets

    @property
    def intersections(self) -> cl.Buffer:
        """(capacity,) uint32 splat numbers, tile by tile, front to back within a tile."""
        return self._alone.intersections

    @property
    def _alone(self) -> ViewSet:
        (_,) = self.owner.views
        return self.owner

    def free(self) -> None:
        """Give the buffers back."""
        self._alone.free()


def gpu_limits(device: Device) -> dict[str, int]:
    """Macros of the GPU kernels that composite (cl/include/subtile_lists.clh), by what the device can do."""
    return {"NATIVE_EXP2": int(device.native_exp2)} | totals_limits(device)


def totals_limits(device: Device) -> dict[str, int]:
    """Macros of kernels with exact totals (cl/include/totals.clh), by what the device can do."""
    extensions = device.info.handle.extensions.split()
    # Elsewhere than in the low word first, the two words of a total would be swapped.
    int64 = "cl_khr_int64_base_atomics" in extensions and device.info.handle.endian_little
    return {"INT64_ATOMICS": int(int64)}


class ViewSet:
    """Views whose buffers lie one after another, so that one launch can do them all.

    Attributes:
        views: each with the parts of the buffers that are its own.
        tiles, pixels: of all of them.
        capacity: room for intersections, of all views.
        intersection_starts: where each view's intersections begin, and their end.
        table: where each view's part begins, ``SetView`` in cl/include/view_set.clh.
        shapes, colours, offsets, intersections: as :class:`View` has them, and N splats a view.
        subtiles: (capacity,), a bit for each sub-tile of its tile that an intersection touches
            (cl/include/subtiles.clh), uint32 for CPU kernels, uint16 for GPU kernels.
    """

    shapes: cl.Buffer
    colours: cl.Buffer
    offsets: cl.Buffer
    intersections: cl.Buffer
    subtiles: cl.Buffer

    def __init__(self, device: Device, cameras: Sequence[Camera], stride: int) -> None:
        self._device = device
        self._buffers: list[cl.Buffer] = []
        self.views = [View(self, camera) for camera in cameras]
        self.tiles = sum(view.tiles for view in self.views)
        self.pixels = sum(view.pixels for view in self.views)
        self.capacity = 0
        self.intersection_starts = [0] * (len(cameras) + 1)
        self._offset_starts = [0, *itertools.accumulate(view.tiles + 1 for view in self.views)]
        try:
            self.shapes = self._take(32 * stride * len(cameras), "the projected splats")
            self.colours = self._take(16 * stride * len(cameras), "the projected splats' colours")
            self.offsets = self._take(4 * self._offset_starts[-1], "the tile offsets")
            self.table = self._take(_SET_VIEW.itemsize * len(cameras), "the views")
        except BaseException:
            self.free()
            raise
        self._write_table()

    def _take(self, nbytes: int, what: str) -> cl.Buffer:
        self._buffers.append(self._device.allocate(nbytes, what))
        return self._buffers[-1]

    def _give_back(self, *buffers: cl.Buffer) -> None:
        for buffer in buffers:
            self._buffers.remove(buffer)
            self._device.free(buffer)

    def _write_table(self) -> None:
        table = np.zeros(len(self.views), _SET_VIEW)
        table["first_intersection"] = self.intersection_starts[:-1]
        table["first_offset"] = self._offset_starts[:-1]
        tile = pixel = 0
        for row, view in zip(table, self.views, strict=True):
            row["view"] = camera_struct(view.camera)
            row["first_tile"], row["first_pixel"] = tile, pixel
            tile += view.tiles
            pixel += view.pixels
        cl.enqueue_copy(self._device.queue, self.table, table, is_blocking=True)

    def aim(self, camera: Camera) -> bool:
        """Make the only view another camera's, if that has as many tiles across and down; whether it has."""
        (view,) = self.views
        if (view.columns, view.rows) != _tiles(camera):
            return False
        if camera is not view.camera:
            view.camera = camera
            self.pixels = view.pixels
            self._write_table()
        return True

    def make_room(self, counts: Sequence[int]) -> None:
        """Room for so many intersections of each view; those there are get lost.

        Raises:
            DeviceMemoryError: the device has not that much, or not all in one buffer.
        """
        if self.capacity:
            self._give_back(self.intersections, self.subtiles)
            self.capacity = 0
        starts = [0, *itertools.accumulate(counts)]
        if max(starts[-1], self.pixels) > 0xFFFFFFFF:
            raise DeviceMemoryError(f"{len(counts)} views have more intersections or pixels than can be numbered")
        self.intersections = self._take(4 * starts[-1], "the tile lists")
        self.subtiles = self._take(_SUBTILES_BYTES[self._device.family] * starts[-1], "the intersections' sub-tiles")
        for view, count in zip(self.views, counts, strict=True):
            view.capacity = count
        self.intersection_starts, self.capacity = starts, starts[-1]
        if len(self.views) > 1:
            self._write_table()

    def read_offsets(self) -> list[NDArray[np.uint32]]:
        """Each view's ``offsets``, once the device has found them."""
        words = self._device.download(self.offsets, (self._offset_starts[-1],), np.uint32)
        return [words[start:stop] for start, stop in itertools.pairwise(self._offset_starts)]

    def read_counts(self) -> list[int]:
        """Each view's intersections, once the device has found them; 2^32 - 1 for more than that."""
        if len(self.views) > 1:
            return [int(offsets[-1]) for offsets in self.read_offsets()]
        last = np.empty(1, np.uint32)
        with self._device.errors("failed while computing"):
            cl.enqueue_copy(
                self._device.queue, last, self.offsets, src_offset=4 * self.views[0].tiles, is_blocking=True
            )
        return [int(last[0])]

    @property
    def nbytes_cached(self) -> int:
        """Bytes of all but shapes and colours."""
        return sum(buffer.size for buffer in self._buffers if buffer not in (self.shapes, self.colours))

    def free_geometry(self) -> None:
        """Give shapes and colours back, for those who keep the lists and project again (:meth:`Rasterizer.project`)."""
        self._give_back(self.shapes, self.colours)
        self.shapes = self.colours = None

    def free(self) -> None:
        """Give the buffers back."""
        for buffer in self._buffers:
            self._device.free(buffer)
        self._buffers = []


class Rasterizer(Owner):
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
        self._bounds = Scratch(device, "the projected splats' bounds")
        self._counts = Scratch(device, "the tile counts")
        self._keys = Scratch(device, "the tile lists' sort keys")
        self._image = Scratch(device, "the image")
        self._transmittance = Scratch(device, "the transmittance")
        self._scratch: ViewSet | None = None

    def _upload(self, scene: Scene) -> None:
        """Activate the parameters and copy them, structure of arrays, padded to the stride."""

        upload = self._upload_columns
        quaternions = scene.quaternions.astype(np.float64)
        length = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))[:, None]
        nothing = np.flatnonzero(length == 0)
        length[nothing] = 1
        quaternions /= length
        quaternions[nothing] = (1.0, 0.0, 0.0, 0.0)
        scales = np.minimum(np.exp(np.minimum(scene.log_scales.astype(np.float64), 100)), _LARGEST_SCALE)
        logits = scene.opacity_logits.astype(np.float64)
        # log(sigmoid(logit)): logaddexp says the same, and takes eight times as long.
        log2_opacities = (np.minimum(logits, 0) - np.log1p(np.exp(-np.abs(logits)))) / np.log(2)
        self._parameters = [
            upload(scene.means, 0, "the centres"),
            upload(scales, 0, "the scales"),
            upload(quaternions, 0, "the rotations"),
            upload(log2_opacities[:, None], -np.inf, "the opacities"),
            upload(scene.sh.reshape(self.splats, -1), 0, "the SH coefficients"),
        ]

    def _upload_columns(self, rows: NDArray[Any], fill: float, what: str) -> cl.Buffer:
        """A value a splat and column; rows are turned into columns on the device, some at a time."""
        device, width = self.device, rows.shape[1]
        result = device.allocate(4 * width * self.stride, what)
        cl.enqueue_fill_buffer(device.queue, result, np.float32(fill), 0, 4 * width * self.stride)
        turn = device.shared_kernel("raster/columns.cl", "columns", [None, np.uint32, np.uint32, np.uint32, None])
        for first in range(0, self.splats, _UPLOADED):
            some = np.ascontiguousarray(rows[first : first + _UPLOADED], np.float32)
            source = device.upload(some, what)
            turn.set_args(source, first, width, self.stride, result)
            device.launch(turn, (len(some),))
            device.free(source)
        return result

    def _build(self, sh_count: int) -> None:
        device, rules = self.device, self.rules
        self._lanes = 1 if device.family == "gpu" else device.vector_width
        number, real, buffer = np.uint32, np.float32, None
        self._project = device.shared_kernel(
            "raster/project.cl",
            "project",
            [*[buffer] * 5, number, *[buffer] * 4],
            LANES=self._lanes,
            SH_COUNT=sh_count,
            NEAR=float(rules.near),
            SQUARE_EXTENT=int(rules.square_extent),
        )
        make = device.shared_kernel
        lists, subtiles = f"raster/tile_lists_{device.family}.cl", f"raster/subtile_masks_{device.family}.cl"
        picture: list[Any] = [real, real, real, buffer, buffer]
        limits: dict[str, float | int] = {
            "ALPHA_CAP": float(rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": rules.transmittance_threshold,
        }
        if device.family == "gpu":
            self._count = make(lists, "count_tiles", [buffer, number, *[buffer] * 3])
            self._scan = make(lists, "scan_tiles", [buffer] * 3)
            self._fill = make(lists, "fill_tiles", [buffer, number, *[buffer] * 4, number])
            # 16 KB of keys: half of what every GPU has, so that two tiles are sorted at a time.
            self._sort = make("raster/sort_gpu.cl", "sort_tiles", [*[buffer] * 5, number], SORT_CAPACITY=2048)
            self._subtiles = make(subtiles, "subtile_masks", [buffer, number, *[buffer] * 4, number])
            limits |= gpu_limits(device)
            composite = [buffer, number, *[buffer] * 5, number, *picture]
            frame = [*[buffer] * 5, number, *picture]
            self._frame = make("raster/composite_frame_gpu.cl", "composite_frame", frame, **limits)
        else:
            limits["LANES"] = max(self._lanes, 8)
            self._count = make(lists, "count_tiles", [buffer, buffer, number, _CAMERA, buffer])
            self._scan = make(lists, "scan_tiles", [buffer, buffer, number])
            self._fill = make(lists, "fill_tiles", [buffer, buffer, number, _CAMERA, buffer, buffer, number])
            self._sort = make("raster/sort_cpu.cl", "sort_tiles", [*[buffer] * 4, number])
            self._subtiles = make(subtiles, "subtile_masks", [*[buffer] * 4, number, _CAMERA], LANES=limits["LANES"])
            composite = [*[buffer] * 5, number, _CAMERA, *picture]
        self._composite = make(f"raster/composite_{device.family}.cl", "composite", composite, **limits)

    def replace_sh(self, sh: FloatArray) -> cl.Buffer:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree.

        Views that were prepared before keep their colours until they are projected again.

        Returns:
            The buffer of the former coefficients, which is the caller's to free.
        """
        former = self._parameters[_SH]
        self._parameters[_SH] = self._upload_columns(sh.reshape(self.splats, -1), 0, "the SH coefficients")
        return former

    def project(
        self,
        views: ViewSet,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        """Enqueue the projection alone of prepared views; with other SH, or into other buffers, if these are given."""
        self._enqueue_project(views, self._room_for_bounds(views), sh, shapes, colours)

    def _room_for_bounds(self, views: ViewSet) -> cl.Buffer:
        self._bounds.reserve(8 * self.stride * len(views.views))
        return self._bounds.buffer

    def _enqueue_project(
        self,
        views: ViewSet,
        bounds: cl.Buffer,
        sh: cl.Buffer | None = None,
        shapes: cl.Buffer | None = None,
        colours: cl.Buffer | None = None,
    ) -> None:
        self._project.set_args(
            *self._parameters[:_SH],
            self._parameters[_SH] if sh is None else sh,
            self.stride,
            views.table,
            views.shapes if shapes is None else shapes,
            views.colours if colours is None else colours,
            bounds,
        )
        lanes = self._lanes
        self.device.launch(self._project, (self.stride // lanes, len(views.views)), (_SPLAT_GROUP // lanes, 1))

    def _over_splats(self, kernel: cl.Kernel, views: ViewSet) -> None:
        self.device.launch(kernel, (self.stride, len(views.views)), (_SPLAT_GROUP, 1))

    def _over_tiles(self, stage: str, kernel: cl.Kernel, views: ViewSet, tiles: int | None = None) -> None:
        group = _TILE_GROUPS[self.device.family][stage]
        most = max(view.tiles for view in views.views) if tiles is None else tiles
        self.device.launch(kernel, (most * group, len(views.views)), (group, 1))

    def _enqueue_count(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer) -> None:
        """Enqueue the tile offsets of projected views."""
        if self.device.family == "gpu":
            self._count.set_args(views.table, self.stride, bounds, views.shapes, counts)
            self._scan.set_args(views.table, counts, views.offsets)
        else:
            (view,) = views.views
            self._count.set_args(bounds, view.shapes, self.stride, camera_struct(view.camera), counts)
            self._scan.set_args(counts, view.offsets, view.tiles)
        self._over_splats(self._count, views)
        self._over_tiles("scan", self._scan, views, 1)

    def _enqueue_lists(self, views: ViewSet, bounds: cl.Buffer, counts: cl.Buffer, frame: bool = False) -> None:
        """Enqueue tile lists, depth order and sub-tiles of views with offsets; of a frame that is only composited no
        sub-tiles where that needs none. Leaves the counts zero."""
        # The bitonic network sorts in place, merging needs room for as many keys again.
        self._keys.reserve((8 if self.device.family == "gpu" else 16) * views.capacity)
        keys, capacity = self._keys.buffer, views.capacity
        if self.device.family == "gpu":
            lists = (views.offsets, views.intersections)
            self._fill.set_args(views.table, self.stride, bounds, views.shapes, counts, keys, capacity)
            self._sort.set_args(views.table, keys, *lists, counts, capacity)
            self._subtiles.set_args(views.table, self.stride, views.shapes, *lists, views.subtiles, capacity)
        else:
            (view,) = views.views
            camera = camera_struct(view.camera)
            self._fill.set_args(bounds, view.shapes, self.stride, camera, counts, keys, capacity)
            self._sort.set_args(keys, view.offsets, view.intersections, counts, capacity)
            self._subtiles.set_args(view.shapes, view.offsets, view.intersections, views.subtiles, capacity, camera)
        self._over_splats(self._fill, views)
        self._over_tiles("sort", self._sort, views)
        if not (frame and self.device.family == "gpu"):
            self._over_tiles("subtiles", self._subtiles, views)

    def _enqueue_composite(self, views: ViewSet, image: cl.Buffer) -> None:
        """Enqueue the pictures, one behind the other into ``image``."""
        self._transmittance.reserve(4 * views.pixels)
        if self.device.family == "gpu" and len(views.views) == 1:
            alone = (views.table, views.shapes, views.colours, views.offsets, views.intersections, views.capacity)
            self._frame.set_args(*alone, *self.background, image, self._transmittance.buffer)
            self._over_tiles("frame", self._frame, views)
            return
        lists = (views.shapes, views.colours, views.offsets, views.intersections, views.subtiles)
        result = (*self.background, image, self._transmittance.buffer)
        if self.device.family == "gpu":
            self._composite.set_args(views.table, self.stride, *lists, views.capacity, *result)
        else:
            (view,) = views.views
            self._composite.set_args(*lists, views.capacity, camera_struct(view.camera), *result)
        self._over_tiles("composite", self._composite, views)

    def _first_capacity(self) -> int:
        """Room for intersections before anything is known of a view."""
        return max(4 * self.splats, 1 << 16)

    def prepare(self, camera: Camera) -> View:
        """Projection, tile lists and depth order of a view, to keep for as many :meth:`composite` as wanted.

        Returns:
            The view, with buffers of its own, its list no longer than needed; :meth:`View.free` it.

        Raises:
            DeviceError: it does not fit the device.
        """
        return self.prepare_set([camera]).views[0]

    def prepare_set(self, cameras: Sequence[Camera]) -> ViewSet:
        """:meth:`prepare` several views, waiting for the device but once. CPU kernels take one at a time.

        Returns:
            The views; :meth:`ViewSet.free` them.

        Raises:
            DeviceMemoryError: they do not fit the device, or not all in buffers of the size that it allows.
            DeviceError: one view alone has too many intersections, or the device failed.
        """
        device = self.device
        views = ViewSet(device, cameras, self.stride)
        try:
            counts, bounds = self._zeroed_counts(views), self._room_for_bounds(views)
            self._enqueue_project(views, bounds)
            self._enqueue_count(views, bounds, counts)
            found = views.read_counts()
            for view, count in zip(views.views, found, strict=True):
                self._accept(view, count)
            views.make_room(found)
            self._enqueue_lists(views, bounds, counts)
        except BaseException:
            self._counts.close()  # not zero
            views.free()
            raise
        finally:
            if len(cameras) > 1:  # far more than a single view will need
                for scratch in (self._keys, self._bounds, self._counts):
                    scratch.close()
        return views

    def _zeroed_counts(self, views: ViewSet) -> cl.Buffer:
        """Counters for all tiles: zero at first, and left so by what uses them."""
        if self._counts.reserve(_COUNTER_BYTES * views.tiles):
            cl.enqueue_fill_buffer(self.device.queue, self._counts.buffer, np.uint32(0), 0, self._counts.nbytes)
        return self._counts.buffer

    def composite(self, view: View) -> tuple[FloatArray, FloatArray]:
        """The picture of a prepared view: as :meth:`render`."""
        self._image.reserve(12 * view.pixels)
        self._enqueue_composite(view.owner, self._image.buffer)
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
        views = self._scratch_view(camera)
        (view,) = views.views
        try:
            self._image.reserve(12 * views.pixels)
            counts, bounds = self._zeroed_counts(views), self._room_for_bounds(views)
            while True:
                self._enqueue_project(views, bounds)
                self._enqueue_count(views, bounds, counts)
                self._enqueue_lists(views, bounds, counts, frame=True)
                self._enqueue_composite(views, self._image.buffer)
                # Lists that did not fit are cut short, so the kernels were safe; their result is thrown away.
                (count,) = views.read_counts()
                self._accept(view, count)
                if count <= view.capacity:
                    return self._image.buffer, self._transmittance.buffer
                views.make_room([count + count // 4])
        except BaseException:
            self._counts.close()  # maybe not zero
            raise

    def render_into(self, cameras: Sequence[Camera], target: cl.Buffer) -> None:
        """Render views one behind the other into ``target``, (pixels, 3) float32: on a GPU as many at a time as fit
        easily."""
        device, queue = self.device, self.device.queue
        if device.family == "cpu":
            start = 0
            for camera in cameras:
                nbytes = 12 * camera.width * camera.height
                cl.enqueue_copy(queue, target, self.render_device(camera)[0], byte_count=nbytes, dst_offset=start)
                start += nbytes
            return
        most = int(max((device.info.memory - device.allocated) // (512 * self.stride), 1))
        number = start = 0
        while number < len(cameras):
            some = cameras[number : number + most]
            try:
                views = self.prepare_set(some)
            except DeviceMemoryError:
                if most == 1:
                    raise
                most //= 2
                continue
            try:
                self._image.reserve(12 * views.pixels)
                self._enqueue_composite(views, self._image.buffer)
                nbytes = 12 * views.pixels
                cl.enqueue_copy(queue, target, self._image.buffer, byte_count=nbytes, dst_offset=start)
            finally:
                views.free()
            number += len(some)
            start += nbytes

    def _accept(self, view: View, count: int) -> None:
        """Take the number of intersections that the device found to a view."""
        if count == 0xFFFFFFFF:
            raise DeviceError(
                f"view '{view.camera.name}' needs more than 2^32 tile intersections: "
                "too many huge splats for this image size"
            )
        view.intersection_count = count

    def _pictures(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        shape = (camera.height, camera.width)
        return (
            self.device.download(self._image.buffer, (*shape, 3), np.float32),
            self.device.download(self._transmittance.buffer, shape, np.float32),
        )

    def _scratch_view(self, camera: Camera) -> ViewSet:
        """The view that :meth:`render` uses again and again; its lists keep the room that earlier views needed."""
        old = self._scratch
        capacity = self._first_capacity()
        if old is not None:
            if old.aim(camera):
                return old
            capacity = max(capacity, old.capacity)
            old.free()
            self._scratch = None
        views = ViewSet(self.device, [camera], self.stride)
        try:
            views.make_room([capacity])
        except BaseException:
            views.free()
            raise
        self._scratch = views
        return views

    def close(self) -> None:
        self.free()

    def free(self) -> None:
        """Give all device memory back; the rasterizer is of no use afterwards."""
        if self._scratch is not None:
            self._scratch.free()
        for buffer in self._parameters:
            self.device.free(buffer)
        for scratch in (self._bounds, self._counts, self._keys, self._image, self._transmittance):
            scratch.close()


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
