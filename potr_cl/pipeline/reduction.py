"""From the scene to fewer splats with sparser colours: pruning; compaction and re-fits of the colours on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import standpoints
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compaction.ridge import Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import Pruned, PruningOptions
from potr_cl.stages.refitting.refit import RefitOptions, RenderedTargets, refit_colours

#: Called with the stage's name and the part of it that is done, 0 to 1.
Progress = Callable[[str, float], None]


def reduce_scene(
    scene: Scene,
    cameras: Sequence[Camera],
    options: EncodeOptions,
    progress: Progress | None = None,
    device: Device | None = None,
) -> tuple[Scene, Pruned | None]:
    """Remove splats and make the colours of the others sparse, as far as the options say.

    Args:
        scene: uncompressed; its renders are the target.
        cameras: only the training views among them are looked at.
        options: the hyper-parameters of pruning and compaction count here.
        progress: told how far the stages are.
        device: the best one there is by default.

    Returns:
        The splats that are left, in their order, and what pruning did (None if it was left out).

    Raises:
        UsageError: options out of range, or no training view.
        DeviceError: the scene does not fit the device.
    """
    report = progress or (lambda stage, done: None)
    schedule = PruningOptions(
        options.parameters.delta_mse_max,
        options.iterations,
        a=options.mapping_a,
        count=options.count,
        decay=options.decay,
    )
    for name, parts in (("compact_at", (options.compact_at,)), ("refit_at", options.refit_at)):
        for part in parts:
            if not 0 <= part <= 1:
                raise UsageError(f"{name} is {part:g}, it must lie between 0 and 1")
    how = options.compaction
    views = train_views(cameras)
    report("prepare views", 0.0)
    device = device or Device()
    rasterizer = Rasterizer(device, scene, background=options.background)
    removal: RemovalSweep | None = None
    sh = scene.sh
    compacted = not options.compact or scene.sh_degree == 0

    def compact() -> None:
        nonlocal sh, compacted
        assert removal is not None
        report("compact", 0.0)
        weights = ViewWeights.from_importances(len(scene), removal.view_importances())
        sh = Compactor(device).compact(scene, standpoints(views, scene.means), weights, how).sh
        compacted = True
        report("compact", 1.0)

    def refit() -> None:
        nonlocal sh
        report("refit", 0.0)
        assert removal is not None
        left = np.flatnonzero(removal.alive)
        source = Rasterizer(device, scene, background=options.background)
        try:
            refitted = refit_colours(
                device,
                replace(scene.subset(left), sh=sh[left]),
                views,
                RenderedTargets(source, views),
                RefitOptions(steps=options.refit_at_steps, memory=options.sweep.memory),
                background=options.background,
                progress=lambda done, steps: report("refit", 0.99 * done / steps),
            )
        finally:
            source.free()
        sh = sh.copy()
        sh[left] = refitted.sh
        report("refit", 1.0)

    refits = {max(round(part * options.iterations), 1) for part in options.refit_at}

    def after_iteration(iteration: int) -> None:
        assert removal is not None
        if not compacted and iteration + 1 >= options.compact_at * options.iterations:
            compact()
            removal.replace_sh(sh)
        if iteration + 1 in refits:
            refit()
            removal.replace_sh(sh)

    try:
        removal = RemovalSweep(
            rasterizer, views, options.sweep, lambda done, count: report("prepare views", done / count)
        )
        pruned: Pruned | None = None
        survivors = np.arange(len(scene))
        if options.prune:
            report("prune", 0.0)
            pruned = prune_scene(
                removal,
                schedule,
                lambda done, kept: report("prune", min(done / options.iterations, 0.99)),
                after_iteration,
            )
            report("prune", 1.0)
            survivors = pruned.survivors
        if not compacted:
            if pruned is None:
                removal.measure()
            compact()
        kept = scene.subset(survivors)
        return Scene(kept.means, kept.log_scales, kept.quaternions, kept.opacity_logits, sh[survivors]), pruned
    finally:
        if removal is not None:
            removal.free()
        rasterizer.free()
