"""Removal effects and importances of all splats over all views (paper sections "Splat importance", "Effect of a
splat's removal").

A view's projection, tile lists and depth order are made once: pruning never changes them, it only takes entries out.
Each measurement is one sweep over the tiles of every view (cl/removal_*.cl), whose sums go to exact integer totals a
splat; a tile in which little has changed since its last sweep keeps its sums.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.cameras import Camera
from potr_cl.errors import UsageError
from potr_cl.rasterizer import Rasterizer, View, _camera_struct

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass
class _Swept:
    """A view and what the sweeps keep of it."""

    view: View
    struct: NDArray[np.void]
    begins: cl.Buffer
    lengths: cl.Buffer
    sums: cl.Buffer
    target: cl.Buffer
    weight: float
    stale: NDArray[np.float32]


class RemovalSweep:
    """Measures removal effects and importances while splats are taken out.

    Args:
        rasterizer: holds the uncompressed scene, its rules and its background.
        cameras: the views that count.
        tolerance: a tile is swept again once the importance removed from it, as a part of its area, exceeds this; 0:
            whenever anything was removed from it.
        progress: called with the views prepared and their number.

    Raises:
        UsageError: no camera.
        DeviceError: a view does not fit the device.
    """

    def __init__(
        self,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        tolerance: float = 0.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        if not cameras:
            raise UsageError("removal effects need at least one view")
        self._rasterizer = rasterizer
        self._device = device = rasterizer.device
        self._tolerance = tolerance
        self._first = True
        rules = rasterizer.rules
        limits: dict[str, float | int] = {"ALPHA_CAP": float(rules.alpha_cap), "STOP": rules.stop}
        if device.family == "gpu":
            limits["NATIVE_EXP2"] = int(device.native_exp2)
        else:
            limits["LANES"] = max(device.vector_width, 4)
        source = f"removal_{device.family}.cl"
        self._kernel = device.kernel(source, "removal", **limits)
        self._stale_kernel = device.kernel(source, "staleness", **limits)
        self._group = 64 if device.family == "gpu" else 1

        self.splats = rasterizer.splats
        self._alive = np.ones(rasterizer._stride, np.uint8)
        self._alive_buffer = device.upload(self._alive, "the splats that are left")
        self._totals = device.upload(np.zeros((rasterizer._stride, 4), np.uint32), "the removal effects")
        # Views of different sizes count the same: each is scaled to the size of the largest.
        self._pixels = max(c.width * c.height for c in cameras)
        self._scale = 2.0 ** np.floor(60 - np.log2(12.0 * self._pixels * len(cameras)))
        self._bound = 2.0**60 / self._scale / len(cameras)
        self._swept: list[_Swept] = []
        for done, camera in enumerate(cameras, start=1):
            self._swept.append(self._prepare(camera))
            if progress is not None:
                progress(done, len(cameras))
        most = max(s.view.tiles for s in self._swept)
        self._tiles = device.allocate(4 * most, "the tiles to sweep")
        self._stale = device.allocate(4 * most, "the tiles' staleness")

    def _prepare(self, camera: Camera) -> _Swept:
        device = self._device
        view = self._rasterizer.prepare(camera)
        offsets = device.download(view.offsets, (view.tiles + 1,), np.uint32)
        return _Swept(
            view=view,
            struct=_camera_struct(camera),
            begins=device.upload(offsets[:-1], "the tile lists"),
            lengths=device.upload(np.diff(offsets), "the tile lists"),
            sums=device.upload(np.zeros((view.entry_count, 2), np.float32), "the tiles' removal effects"),
            target=device.allocate(12 * camera.width * camera.height, "the target image"),
            weight=self._pixels / (camera.width * camera.height),
            stale=np.full(view.tiles, np.inf, np.float32),
        )

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats, float64; of removed splats they mean nothing.

        ΔMSE is the change of the mean squared error over all views, pixels and channels against the uncompressed
        scene's renders if that splat alone went; I the mean over views and pixels of T α.
        """
        device, background = self._device, self._rasterizer.background
        for swept in self._swept:
            tiles = np.flatnonzero(swept.stale > self._tolerance).astype(np.uint32)
            if len(tiles) == 0:
                continue
            cl.enqueue_copy(device.queue, self._tiles, tiles, is_blocking=False)
            self._kernel.set_args(
                swept.view.shapes,
                swept.view.colours,
                self._alive_buffer,
                self._tiles,
                swept.begins,
                swept.lengths,
                swept.view.entries,
                swept.struct,
                *(np.float32(channel) for channel in background),
                np.int32(self._first),
                np.float32(self._scale * swept.weight),
                np.float32(self._bound / swept.weight),
                swept.target,
                swept.sums,
                self._totals,
            )
            device.launch(self._kernel, (len(tiles) * self._group,), (self._group,))
            swept.stale[tiles] = 0
        self._first = False
        words = device.download(self._totals, (self.splats, 2), np.int64)
        values = words / (self._scale * self._pixels * len(self._swept))
        return values[:, 0] / 3, values[:, 1]

    def remove(self, splats: Indices) -> None:
        """Take splats out of all lists; note how much each tile loses."""
        device = self._device
        self._alive[splats] = 2  # just gone
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)
        for swept in self._swept:
            self._stale_kernel.set_args(
                self._alive_buffer, swept.begins, swept.lengths, swept.view.entries, swept.sums, self._stale
            )
            device.launch(self._stale_kernel, (swept.view.tiles * self._group,), (self._group,))
            swept.stale += device.download(self._stale, (swept.view.tiles,), np.float32)
        self._alive[splats] = 0
        cl.enqueue_copy(device.queue, self._alive_buffer, self._alive, is_blocking=True)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile, whatever has changed."""
        for swept in self._swept:
            swept.stale[:] = np.inf

    def free(self) -> None:
        """Give all device memory back."""
        for swept in self._swept:
            swept.view.free()
            for buffer in (swept.begins, swept.lengths, swept.sums, swept.target):
                self._device.free(buffer)
        for buffer in (self._alive_buffer, self._totals, self._tiles, self._stale):
            self._device.free(buffer)
        self._swept = []
