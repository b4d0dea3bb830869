"""What each splat is worth to the views: :func:`removal_effects`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    DeviceSource,
    SceneSource,
    cameras_of,
    colour_of,
    device_of,
    scene_of,
)
from potr_cl.api.views import views_or_placed
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.fallback import with_fallback
from potr_cl.pipeline.frame import check_frame
from potr_cl.pipeline.target import as_bytes
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep import FixedPoint, SweepOptions
from potr_cl.stages.stage import Progress

_Totals = list[NDArray[np.int64]]


@dataclass(frozen=True)
class RemovalEffects:
    """What :func:`removal_effects` measures, by splat, in float64.

    Attributes:
        delta_mse: (N,) by how much the mean squared error of the pictures (over all views, pixels and channels, against
            those of the whole scene) grows if that splat alone goes; colours from 0 to 1.
        importance: (N,) mean over all views and pixels of T α: what the splat contributes to them.
        views: names of the views.
        delta_mse_by_view, importance_by_view: (V, N) what each view contributes to the two, so that they are the sums
            over views; None unless they were asked for.
    """

    delta_mse: NDArray[np.float64]
    importance: NDArray[np.float64]
    views: list[str]
    delta_mse_by_view: NDArray[np.float64] | None = None
    importance_by_view: NDArray[np.float64] | None = None


def removal_effects(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    by_view: bool = False,
    virtual_views: int | None = None,
    memory: float | None = None,
    background: ColourSource = "black",
    device: DeviceSource = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool = False,
    progress: Progress | None = None,
) -> RemovalEffects:
    """Measure what pruning goes by: how much the pictures change if a splat goes, and how much it contributes to them.

    Both are sums of integers over views, tiles and pixels: the same scene, views and device give the same bits.

    Args:
        scene: or its file.
        cameras: of which the training views count; or their file; None: virtual ones are placed.
        by_view: whether to keep what each view contributes, 16 bytes for each view and splat.
        virtual_views, memory, background, device, trust, antialiased, cameras_anyway, progress: as of
            :func:`potr_cl.prune`.

    Raises:
        UsageError: no camera is a training view, or they do not seem to be in the scene's frame.
        DataError: a file is damaged.
        DeviceError: no device does the work.
    """
    colour, budget = colour_of(background), as_bytes(memory)
    given, what = cameras_of(cameras, virtual_views), scene_of(scene, trust, antialiased)
    check_frame(what, given, cameras_anyway)
    opened = device_of(device)
    tell: Progress = progress or (lambda _what, _done: None)
    views = train_views(views_or_placed(scene, what, given, virtual_views, opened, tell))
    groups = [[number] for number in range(len(views))] if by_view else [list(range(len(views)))]

    def work(device: Device, memory: int | None) -> _Totals:
        with Rasterizer(device, what, background=colour) as rasterizer:
            found: _Totals = []
            for group in groups:
                tell("removal effects", len(found) / len(groups))
                with RemovalSweep(rasterizer, views, SweepOptions(memory=memory), numbers=group) as sweep:
                    found.append(sweep.measure_totals())
            return found

    totals, _ = with_fallback(opened, budget, work)
    tell("removal effects", 1.0)
    values = FixedPoint.of_views(views).values
    names = [view.name for view in views]
    if not by_view:
        return RemovalEffects(*values(totals[0]), names)
    own = [values(each) for each in totals]
    return RemovalEffects(*values(sum(totals, np.zeros_like(totals[0]))), names, *map(np.stack, zip(*own, strict=True)))
