"""Views that a CPU's memory has no room for, made again whenever they are measured: :class:`PassingParts`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.host import mapped
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.pruning.fixed_point import FixedPoint, zero_totals
from potr_cl.stages.pruning.kept_views import tiles_of
from potr_cl.stages.pruning.launcher import launcher_for
from potr_cl.stages.pruning.passing_views import PATIENCE
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.stages.pruning.removal import F64, Indices
from potr_cl.stages.pruning.survivors import SplatState
from potr_cl.stages.pruning.sweep_buffers import SweepBuffers
from potr_cl.stages.pruning.sweep_options import SweepOptions

#: Puts some splats of the uncompressed scene, by number, into a scene on the device.
Fill = Callable[[SceneBuffers, Indices], None]


@dataclass(frozen=True)
class _Part:
    """Views that see much of the same.

    Attributes:
        numbers: of the views.
        splats: a bit for each splat of the scene, packed: those of which a view has an intersection with any tile.
    """

    numbers: list[int]
    splats: NDArray[np.uint8]


@dataclass(frozen=True)
class _Ready:
    """The splats of a part that are left, on the device.

    Attributes:
        splats: their numbers in the scene, ascending.
        rasterizer: of these.
        buffers: that the sweeps of its views share.
    """

    splats: Indices
    rasterizer: Rasterizer
    buffers: SweepBuffers


class PassingParts(Owner):
    """Views of which nothing stays on the device. Their target pictures are kept on the host.

    The splats that are left and that any view of a part draws are brought to the device, then the part's views are
    measured one after the other. That is done when views have lost enough since the last time, as
    :class:`~potr_cl.stages.pruning.passing_views.PassingViews` does.

    Args:
        device: that computes.
        scene: the uncompressed scene.
        fill: as above.
        cameras: all views, also those that are kept.
        options: speed/accuracy trade-offs of the sweeps.
        fixed_point: units of what they measure.
        background: R, G, B behind the scene.

    Attributes:
        views: how many they are.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        fill: Fill,
        cameras: Sequence[Camera],
        options: SweepOptions,
        fixed_point: FixedPoint,
        background: tuple[float, float, float],
    ) -> None:
        self._device, self._scene, self._fill = device, scene, fill
        self._cameras, self._options, self._fixed_point = cameras, options, fixed_point
        self._background = background
        self._preparing = PreparingMemory(device)
        self._parts: list[_Part] = []
        self._targets: dict[int, FloatArray] = {}
        self._sh: FloatArray | None = None  # other coefficients than those of the targets
        #: (N, 2) what they have measured last, and whether that is to be measured again in any case.
        self._totals = np.zeros((0, 2), np.int64)
        self._known = False

    @property
    def views(self) -> int:
        return sum(len(part.numbers) for part in self._parts)

    def take(self, numbers: Sequence[int], drawn: NDArray[np.bool_]) -> None:
        """Measure some views, too, together.

        Args:
            numbers: of the views, ascending.
            drawn: (N,) the splats of which one of them has an intersection with any tile.
        """
        self._parts.append(_Part(list(numbers), np.packbits(drawn)))

    def add_to(self, totals: NDArray[np.int64], alive: NDArray[np.bool_]) -> None:
        """Add what the views measure, which is done anew where they have lost enough.

        Args:
            totals: (N, 2).
            alive: (N,) the splats that are left; all of them, at the first time.

        Raises:
            DeviceError: a view does not fit the device.
        """
        if not self._parts:
            return
        if not self._known or self._are_stale(alive):
            if len(self._totals):
                self._totals[:] = 0
            else:
                self._totals = np.zeros((len(self._scene), 2), np.int64)
            for part in self._parts:
                self._measure(part, alive)
            self._preparing.close()
            self._known = True
        totals += self._totals

    def forget(self) -> None:
        """Have the next measurement measure all of them."""
        self._known = False

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours, (N, M, 3) float32, which must not change before they are replaced again."""
        self._sh = sh
        self.forget()

    def importances(self, alive: NDArray[np.bool_]) -> Iterator[tuple[int, Indices, F64]]:
        """What :meth:`potr_cl.stages.pruning.removal.RemovalSweep.view_importances` yields, of these views."""
        part_of = {number: part for part in self._parts for number in part.numbers}
        for number in sorted(part_of):
            camera = self._cameras[number]
            with self._ready(part_of[number], alive) as ready:
                if ready is None:
                    yield number, np.zeros(0, np.int64), np.zeros(0)
                    continue
                with self._swept(number, ready) as views:
                    ((_, _, intersections, sums),) = views.read_sums()
                weights = np.maximum(sums[:, 1], 0)  # negative: touches no pixel
                total = np.bincount(intersections, weights=weights, minlength=len(ready.splats))[: len(ready.splats)]
                seen = np.flatnonzero(total > 0)
                yield number, ready.splats[seen], total[seen] / (camera.width * camera.height)

    def _are_stale(self, alive: NDArray[np.bool_]) -> bool:
        """Whether they have lost more than the tolerance since they were measured: a part of their area, on average."""
        tolerance = self._options.tolerance
        if tolerance <= 0:
            return True
        importance = int(self._totals[:, 1].sum(where=~alive))
        part = self.views / len(self._cameras)
        return importance * self._fixed_point.units[1] / part > PATIENCE * tolerance

    def _measure(self, part: _Part, alive: NDArray[np.bool_]) -> None:
        with self._ready(part, alive) as ready:
            if ready is None:
                return
            for number in part.numbers:
                with self._swept(number, ready):
                    pass
            measured = self._device.download(ready.buffers.totals, (len(ready.splats), 2), np.int64)
            self._totals[ready.splats] += measured

    @contextmanager
    def _ready(self, part: _Part, alive: NDArray[np.bool_]) -> Iterator[_Ready | None]:
        """A part's splats that are left, on the device inside the block; None if there are none."""
        device = self._device
        splats = np.flatnonzero(np.unpackbits(part.splats, count=len(alive)).view(bool) & alive)
        if not len(splats):
            yield None
            return
        scene = self._scene
        with ExitStack() as stack:
            own = SceneBuffers(device, len(splats), scene.sh.shape[1], scene.antialiased, scene.low_pass)
            stack.enter_context(own)
            self._fill(own, splats)
            if self._sh is not None:
                own.write_sh_of(self._sh, splats)
            rasterizer = Rasterizer(device, own, background=self._background, preparing=self._preparing)
            stack.enter_context(rasterizer)
            memory = stack.enter_context(Memory(device))
            tiles = max(tiles_of(self._cameras[number]) for number in part.numbers)
            buffers = SweepBuffers(
                alive=memory.upload(np.full(own.stride, SplatState.ALIVE, np.uint8), "the splats that are left"),
                tiles=memory.upload(np.arange(tiles, dtype=np.uint32), "the tiles to sweep"),
                stale=memory.allocate(4 * tiles, "the tiles' staleness"),
                listed=memory.allocate(4, "the numbers of tiles to sweep"),
                totals=memory.upload(zero_totals(own.stride), "the removal effects"),
            )
            yield _Ready(splats, rasterizer, buffers)

    @contextmanager
    def _swept(self, number: int, ready: _Ready) -> Iterator[PreparedSet]:
        """A view prepared and swept, inside the block; the first time, its target is kept."""
        device, camera, rasterizer = self._device, self._cameras[number], ready.rasterizer
        views = rasterizer.prepare_set([camera])
        with PreparedSet(rasterizer, range(number, number + 1), views) as prepared:
            target = self._targets.get(number)
            if target is not None:
                with device.errors("cannot hold the target images"):
                    cl.enqueue_copy(device.queue, prepared.target, target, is_blocking=True)
            launcher = launcher_for(rasterizer, self._options, self._fixed_point)
            geometry = (prepared.views.shapes, prepared.views.colours)
            kernels = launcher.bind(prepared, geometry, ready.buffers, first_time=target is None)
            kernels.sweep_all()
            if target is None:
                target = mapped.array((camera.height, camera.width, 3), np.float32, "target pictures")
                with device.errors("failed while computing"):
                    cl.enqueue_copy(device.queue, target, prepared.target, is_blocking=True)
                self._targets[number] = target
            with device.errors("failed while computing"):
                device.queue.finish()
            yield prepared

    def close(self) -> None:
        """Give all device memory back."""
        self._preparing.close()
        self._targets = {}
