"""How views are swept: what may be traded for speed (:class:`SweepOptions`), the units of what is summed up
(:class:`FixedPoint`), and the removal kernels of either family (:class:`SetKernels`).

CPUs (cl/prune/removal_cpu.cl) do one view a launch, one tile a work-item; GPUs (cl/prune/removal_gpu.cl) a set of views
a launch, a tile a work-group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.sweep import padded_area, sweep_limits
from potr_cl.raster.view_set import TILE, camera_struct
from potr_cl.stages.pruning.buffers import Ledger, PreparedSet
from potr_cl.views.engine import Ready

F64 = NDArray[np.float64]

#: The least threshold: smaller transmittances lose digits in float32, and the sweep divides by them.
_LEAST_THRESHOLD = 1e-30
_CHANNELS = 3
#: Effects of this a pixel and channel, in every tile of every view, still fit the 62 bits that the kernels can add.
_LARGEST_EFFECT = 16.0


@dataclass(frozen=True)
class SweepOptions:
    """Speed/accuracy trade-offs of a removal sweep.

    Attributes:
        tolerance: a tile is swept again once the importance removed from it, as a part of its area, exceeds this;
            that of large splats counts less (removed_counts of cl/prune/removal.clh). 0: whenever anything was removed
            from it; negative: always.
        turns: with n, a view is swept only in every n-th measurement after the first. Views that do not fit the memory
            budget are swept in each measurement.
        memory: bytes of device memory that the views may take; None: :func:`potr_cl.views.budget.default_memory`.
        transmittance_threshold: a pixel ends before its transmittance falls below this; None: where the rasterizer's
            rules end it. When a removal lets a pixel go on one splat longer, its colour jumps by up to the hundredfold
            of this.

    Raises:
        UsageError: a value is out of range.
    """

    tolerance: float = 0.02
    turns: int = 1
    memory: int | None = None
    transmittance_threshold: float | None = 1e-8

    def __post_init__(self) -> None:
        if not np.isfinite(self.tolerance):
            raise UsageError(f"the tile tolerance is {self.tolerance:g}, it must be a number")
        if self.turns < 1:
            raise UsageError(f"views cannot be swept every {self.turns} measurements: at least 1 is needed")
        if self.memory is not None and self.memory < 0:
            raise UsageError(f"the memory budget must not be negative ({self.memory} bytes)")
        if self.transmittance_threshold is not None and not _LEAST_THRESHOLD <= self.transmittance_threshold < 1:
            raise UsageError(
                f"a pixel cannot end at a transmittance of {self.transmittance_threshold:g}: at least "
                f"{_LEAST_THRESHOLD:g}, below 1"
            )

    @property
    def only_by_tolerance(self) -> bool:
        """Whether a tile's staleness alone decides when it is swept again: no turns."""
        return self.turns == 1


@dataclass(frozen=True)
class FixedPoint:
    """The units in which the kernels add up (cl/prune/removal.clh).

    Views of different sizes count the same: each is scaled to the size of the largest.

    Attributes:
        scale: a sum over a tile's pixels is multiplied by this (and its view's :meth:`weight`) before its fraction is
            cut off.
        bound: a tile's sums in the largest view are cut at this, so that absurd colours do not overflow the totals.
        pixels: of the largest view.
    """

    scale: float
    bound: float
    pixels: int
    views: int

    @classmethod
    def of_views(cls, cameras: Sequence[Camera]) -> FixedPoint:
        """The finest units in which the totals of these views cannot overflow."""
        area = max(padded_area(c.width, c.height) for c in cameras)
        # scale * views * tiles * bound <= 2^62, where bound is 48 a pixel: 60 bits and 12 say the same.
        scale = float(2.0 ** np.floor(60 - np.log2(12.0 * area * len(cameras))))
        pixels = max(c.width * c.height for c in cameras)
        return cls(scale, _CHANNELS * _LARGEST_EFFECT * TILE * TILE, pixels, len(cameras))

    def weight(self, pixels: int) -> float:
        """By how much the sums of a view of so many pixels are scaled up."""
        return self.pixels / pixels

    @property
    def units(self) -> tuple[float, float]:
        """ΔMSE and I of 1 in the totals."""
        importance = 1 / (self.scale * self.pixels * self.views)
        return importance / _CHANNELS, importance

    def values(self, totals: NDArray[np.int64]) -> tuple[F64, F64]:
        """ΔMSE and I, (N,) float64 each, of totals, (N, 2) int64."""
        one = self.scale * self.pixels * self.views
        effects = totals[:, 0] / one
        effects /= _CHANNELS
        return effects, totals[:, 1] / one


class Family(NamedTuple):
    """What the kernels of a family can do.

    Attributes:
        most_queues: on how many queues independent launches may run at the same time. A set's longest tile list keeps
            one work-group of a GPU busy when all others are done: other sets fill the gap.
        lists_tiles: whether the device itself can list the tiles that are stale.
        group: work-items of a work-group. PoCL would keep the private memory of more of them on a CPU's stack.
    """

    most_queues: int
    lists_tiles: bool
    group: int


_FAMILIES = {"cpu": Family(1, False, 1), "gpu": Family(4, True, 128)}


def family_of(device: Device) -> Family:
    """What a device's kernels can do."""
    return _FAMILIES[device.family]


@dataclass(frozen=True)
class TileLists:
    """Which tiles of several sets are swept, on the device.

    Attributes:
        tiles: uint32, the list of tiles to sweep, numbered within their set.
        stale: float32, staleness of the tiles, each set's from its first tile on.
        listed: uint32, how many tiles of each set the device has listed itself.
    """

    tiles: cl.Buffer
    stale: cl.Buffer
    listed: cl.Buffer


class SetKernels:
    """The removal kernels of one set of views; all arguments stay bound, because to bind them takes longer than a
    launch.

    Args:
        lists: of its tiles, perhaps among those of other sets.
        options: where pixels end. fixed_point: the totals' units.
        first_time: whether a sweep stores the target, and the picture if that is wanted, instead of comparing with it.
        place: of the set's counter in ``lists.listed``.
    """

    def __init__(
        self,
        ready: Ready[PreparedSet],
        ledger: Ledger,
        lists: TileLists,
        options: SweepOptions,
        fixed_point: FixedPoint,
        first_time: bool,
        place: int = 0,
    ) -> None:
        prepared, views, rasterizer = ready.work, ready.views, ready.subset.rasterizer
        device, threshold = rasterizer.device, options.transmittance_threshold
        (shapes, colours), (red, green, blue) = ready.geometry, rasterizer.background
        macros: dict[str, float | int] = {
            "ALPHA_CAP": float(rasterizer.rules.alpha_cap),
            "TRANSMITTANCE_THRESHOLD": rasterizer.rules.transmittance_threshold if threshold is None else threshold,
            **sweep_limits(device),
        }
        both: dict[str, Any] = {
            "offsets": views.offsets,
            "lengths": prepared.lengths,
            "intersections": views.intersections,
            "sums": prepared.sums,
        }
        swept: dict[str, Any]
        noted: dict[str, Any] = {}
        if device.family == "cpu":
            (view,) = views.views
            weight = fixed_point.weight(view.pixels)
            swept = {
                "alive": ledger.marks,
                "view": camera_struct(view.camera),
                "scale": fixed_point.scale * weight,
                "bound": fixed_point.bound / weight,
            }
            both["counts"] = prepared.counts
        else:
            picked = ledger.numbers is not None
            macros["PICKED"] = int(picked)
            both |= {
                "views": views.table,
                "view_count": len(views.views),
                "numbers": ledger.numbers if picked else views.table,  # which is not looked at
            }
            swept = {
                "stride": rasterizer.stride,
                "scale": fixed_point.scale,
                "most_pixels": fixed_point.pixels,
                "bound": fixed_point.bound,
            }
            noted = {
                "subtiles": views.subtiles,
                "tolerance": math.inf,
                "tiles": lists.tiles,
                "set": place,
                "listed": lists.listed,
            }
        source = f"prune/removal_{device.family}.cl"
        swept |= {
            "start": 0,
            "tiles": lists.tiles,
            "shapes": shapes,
            "colours": colours,
            "subtiles": views.subtiles,
            "red": red,
            "green": green,
            "blue": blue,
            "first_time": int(first_time),
            "target": prepared.target,
            "totals": ledger.totals,
        }
        # Only programs that draw look at the picture.
        none = {"picture": prepared.target} if device.family == "cpu" else {}
        self._removal = device.kernel(source, "removal", **macros).bind(**both, **swept, **none)
        self._later: Kernel | None = None
        if first_time and prepared.picture is not None:
            drawing = {"PICTURES": 1, "PICTURE_THRESHOLD": rasterizer.rules.transmittance_threshold}
            self._later = self._removal
            self._removal = device.kernel(source, "removal", **macros, **drawing)
            self._removal.bind(**both, **swept, picture=prepared.picture)
        self._staleness = device.kernel(source, "staleness", **macros).bind(
            alive=ledger.marks, first=prepared.first_tile, stale=lists.stale, **both, **noted
        )
        self._tiles, self._family = views.tiles, family_of(device)
        self._lists_above, self._start = math.inf, 0

    def sweep(self, start: int, count: int, queue: cl.CommandQueue | None = None) -> None:
        """Enqueue the sweep of so many of the set's tiles, those in the list of tiles from ``start`` on.

        Args:
            queue: another than the device's own.
        """
        if start != self._start:
            self._start = start
            self._removal.set(start=start)
        self._launch(self._removal, count, queue)

    def take_out(self) -> None:
        """Enqueue that the next sweep finds nothing of removed splats in the lists of views that are prepared anew."""
        if self._family.lists_tiles:  # else the sweep itself does that
            self._launch(self._staleness, self._tiles)

    def target_is_known(self) -> None:
        """From now on, sweeps compare with the target picture instead of storing it."""
        if self._later is not None:
            self._removal, self._later = self._later, None
        self._removal.set(first_time=0, start=self._start)

    def note_removal(self, queue: cl.CommandQueue | None = None, list_above: float = math.inf) -> None:
        """Enqueue what follows a removal: each tile's staleness grows by what it lost.

        Args:
            queue: another than the device's own.
            list_above: where the family :attr:`~Family.lists_tiles`: tiles that are staler than this are put into the
                list of tiles, from the set's first tile on, and are fresh then.
        """
        assert self._family.lists_tiles or list_above == math.inf
        if list_above != self._lists_above:
            self._lists_above = list_above
            self._staleness.set(tolerance=list_above)
        self._launch(self._staleness, self._tiles, queue)

    def _launch(self, kernel: Kernel, tiles: int, queue: cl.CommandQueue | None = None) -> None:
        group = self._family.group
        kernel.launch((tiles * group,), (group,), queue)
