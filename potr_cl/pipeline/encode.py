"""A whole encode: :func:`encode` looks at what it is given, and has the stages run in their order."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.mapped import bounded
from potr_cl.model.camera import Camera, train_views, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.fallback import with_fallback
from potr_cl.pipeline.frame import FrameCheck, check_frame
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch
from potr_cl.placement.virtual import place_cameras
from potr_cl.raster.resident import ResidentScene
from potr_cl.stages.stage import Progress, Stage, State
from potr_cl.workers.pool import Pool

_log = logging.getLogger("potr_cl")


@dataclass(frozen=True)
class Kept:
    """What an encode has kept of a scene of N splats.

    Attributes:
        splats: (n,) int64, their numbers, ascending.
        importance: (N,) float32, what views show of each splat; None: that was not measured.
    """

    splats: NDArray[np.int64]
    importance: NDArray[np.float32] | None


def encode(
    scene: Scene,
    cameras: Sequence[Camera] | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
    antialiased: bool | None = None,
    kept: ResidentScene | None = None,
    in_frame: bool = False,
    pool: Pool | None = None,
    tell: Callable[[str], None] | None = None,
    finer: Kept | None = None,
    follow: Callable[[Stage, State], None] | None = None,
) -> Encoded:
    """Encode a scene.

    Args:
        scene: clean (:meth:`potr_cl.model.scene.Scene.cleaned`), at least one splat.
        cameras: the training views among them decide which splats may go, and how coarse centres may be. None: virtual
            ones are placed if the options ask for anything that looks at views; if not, γ alone decides about centres.
        options: defaults to quality 0.5 of preset best.
        progress: called with a stage's name and the part of it that is done.
        device: computes; by default the best one there is. If its memory is too small, less is kept in it, and if that
            is not enough, a CPU does the work. A warning says so.
        antialiased: whether to take it as an antialiased scene; None: as what it says that it is.
        kept: the scene on the device, if it will be needed there afterwards.
        in_frame: whether :func:`potr_cl.pipeline.frame.check_frame` has found the cameras to be in the scene's frame.
        pool: workers that views are shared out to, of which ``device`` is the first; None: the device does all.
        tell: told a line for every round of a fit.
        finer: of the next finer level of detail, where this is to be a coarser one: only splats that it has kept may
            be, but colours are re-fitted to the whole scene's pictures all the same. None: all may be kept.
        follow: called with each stage and what it has left.

    Raises:
        UsageError: options out of range, cameras without a training view, or cameras that are probably not in the
            scene's frame (:func:`potr_cl.model.agreement.judge_cameras`; ``options.cameras_anyway`` takes them).
        DataError: a value too large to quantise.
        DeviceError: no device does the work.
    """
    options = options or EncodeOptions()
    scene = scene.rendered(antialiased)
    tell_losses(scene, options)
    with ExitStack() as stack:
        stack.enter_context(bounded(options.memory))
        check = FrameCheck(scene, cameras, options.cameras_anyway or in_frame)
        watch = Stopwatch(stack.enter_context(check.beside(progress)), tell)
        if options.look_at_views(scene):
            device = device or (Device() if pool is None else pool.first)
        cameras = cameras_or_virtual(scene, cameras, options, watch, in_frame=True, device=device)
        if kept is None and cameras and device is not None and options.look_at_views(scene):
            others = () if pool is None else pool.devices
            kept = stack.enter_context(ResidentScene(device, scene, options.memory, others))
        run = Run(options, watch, device, kept, pool, follow)
        start = State.of(scene, train_views(cameras) if cameras else [])
        if finer is not None:
            start = start.keeping(finer.splats).with_results(importance=finer.importance)
        encoded = run.finished(run.stages(start))
    tell_left_out(scene, encoded)
    return encoded


def tell_losses(scene: Scene, options: EncodeOptions) -> None:
    """Say in one line what of the scene the kind of file that is asked for cannot hold."""
    losses = options.output.losses(scene)
    if losses:
        _log.warning("%s cannot hold all of this scene: %s", options.output.format.name, "; ".join(losses))


def tell_left_out(scene: Scene, encoded: Encoded) -> None:
    """Say in one line which SH degrees are missing in a file whose format has to keep them for all splats or none."""
    if encoded.left_out:
        first, last = scene.sh_degree - encoded.left_out + 1, scene.sh_degree
        _log.warning(
            "the %s file has no SH coefficients of degree %s: all of them together are not worth their bytes; a higher "
            "quality or a larger size keeps them",
            encoded.options.output.format.name,
            f"{first} to {last}" if first < last else f"{last}",
        )


def cameras_or_virtual(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    options: EncodeOptions,
    watch: Stopwatch,
    in_frame: bool = False,
    device: Device | None = None,
    count: int | None = None,
) -> Sequence[Camera] | None:
    """The cameras; or virtual ones (``count``, or as many as the scene asks for), if there are none and a stage needs
    views.

    Where a stage fits to photographs, views with a lens look at no more than theirs show.

    Raises:
        UsageError: the training views are probably not in the scene's frame; but with ``options.cameras_anyway``.
    """
    check_frame(scene, cameras, options.cameras_anyway or in_frame)
    if cameras is None and options.look_at_views(scene):
        watch("place cameras", 0.0)
        cameras, _ = with_fallback(
            device or Device(), options.memory, lambda opened, _: place_cameras(scene, count, device=opened)
        )
        watch("place cameras", 1.0)
    if cameras is not None and any(getattr(stage, "ground_truth", None) is not None for stage in options.stages):
        return within_photographs(cameras)
    return cameras
