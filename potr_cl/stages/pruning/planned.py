"""The plan of views that suits a device and a scene, and a sweep by it: :func:`planned_sweep`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable, SceneBuffers
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.views import plan as plans
from potr_cl.views.budget import default_memory
from potr_cl.views.subsets import CopiedSplats, NamedSplats, SplatSource
from potr_cl.views.visibility import Visibility


@contextmanager
def planned_sweep(
    device: Device,
    drawable: Drawable,
    cameras: Sequence[Camera],
    options: SweepOptions,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    visibility: Visibility | None = None,
    numbers: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
    scene: Scene | None = None,
    spared: NDArray[np.bool_] | None = None,
) -> Iterator[RemovalSweep]:
    """A removal sweep over some views, as long as the context lasts.

    Args:
        device: that computes.
        drawable: the uncompressed scene, perhaps on the device.
        cameras, options, numbers, progress, spared: as of :class:`~potr_cl.stages.pruning.removal.RemovalSweep`.
        background: R, G, B behind the scene.
        visibility: what the views may draw, where each had better be looked at with that; None: with all splats.
        scene: the uncompressed scene on the host; None: it is there only if ``drawable`` is.

    Raises:
        DeviceError: the scene or a view does not fit the device.
    """
    scene = drawable if isinstance(drawable, Scene) else scene
    memory = default_memory(device) if options.memory is None else options.memory
    meant = range(len(cameras)) if numbers is None else numbers
    with ExitStack() as owned:
        source: Rasterizer | SplatSource
        plan = None
        if visibility is not None and isinstance(drawable, SceneBuffers) and _can_name(device, options):
            source = owned.enter_context(NamedSplats(drawable, visibility.groups.group_of, background))
            plan = plans.by_view(visibility, cameras, meant, memory, 16 * drawable.stride)
        elif visibility is not None and scene is not None:
            clusters = visibility.clusters(numbers)
            source = owned.enter_context(CopiedSplats(device, scene, drawable, background))
            if device.family == "cpu":
                plan = plans.as_drawn(source, cameras, clusters, memory, progress)
                progress = None  # that was most of it
            else:
                plan = plans.by_cluster(clusters, memory, scene.nbytes // max(len(scene), 1))
        else:
            source = owned.enter_context(Rasterizer(device, drawable, background=background))
        yield owned.enter_context(RemovalSweep(source, cameras, options, progress, numbers, plan, spared))


def _can_name(device: Device, options: SweepOptions) -> bool:
    """Whether splats can be named by their numbers: GPU kernels can, where staleness alone chooses tiles."""
    return device.family == "gpu" and options.only_by_tolerance
