"""Scenes encoded with levels of detail: :func:`encode_levels`.

A level is one run of the stages: with a number of splats to keep, and smaller views. It keeps some of the splats that
the next finer level has kept, as they are in the full scene, and their colours are re-fitted to the full scene's
pictures. Levels are made one after the other, so no more memory is taken than by one of them; what is kept of each is
the file that it became.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.levels.errors import MeasuredErrors
from potr_cl.levels.plan import counts_of_levels, scale_of_level, views_of_level
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded, LevelMade
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Stopwatch, added_up
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.resident import ResidentScene
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Progress
from potr_cl.workers.pool import Pool

_log = logging.getLogger("potr_cl")


def encode_levels(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    options: EncodeOptions,
    progress: Progress | None = None,
    device: Device | None = None,
    *,
    kept: ResidentScene | None = None,
    in_frame: bool = False,
    pool: Pool | None = None,
    tell: Callable[[str], None] | None = None,
    judge: bool = False,
) -> Encoded:
    """Encode a scene with the levels of detail that the options ask for.

    Args:
        scene, options, progress, device, kept, in_frame, pool, tell: as of :func:`potr_cl.pipeline.encode.encode`.
        cameras: given or virtual ones.
        judge: whether to measure each level in the pictures in which it is shown.

    Returns:
        The file of all levels. What is said of its splats and its stages is said of the finest level.

    Raises:
        As :func:`potr_cl.pipeline.encode.encode`.
        UsageError: there are no views to make coarser levels by.
    """
    output, wanted = options.output, options.wanted_levels
    single = options.changed(output=output.of_level(), levels=1)

    def one(views: Sequence[Camera] | None, how: EncodeOptions, finer: Encoded | None = None) -> Encoded:
        return encode(
            scene, views, how, progress, device, kept=kept, in_frame=in_frame or finer is not None, pool=pool,
            tell=tell, among=None if finer is None else np.sort(finer.order),
        )  # fmt: skip

    first = made = one(cameras, single)
    counts = counts_of_levels(len(first.order), wanted)
    if len(counts) > 1 and (cameras is None or not options.stage(Prune).on):
        raise UsageError("coarser levels of detail are pruned: leave out --no-prune, or give --levels 1")
    files, seconds = [first.data], dict(first.seconds)
    for level, count in enumerate(counts[1:], 1):
        assert cameras is not None
        _log.info("level %d of %d: %s splats", level, len(counts) - 1, f"{count:,}")
        made = one(views_of_level(cameras, level), _coarser(single, count), made)
        files.append(made.data)
        seconds = added_up(seconds, made.seconds)
    watch = Stopwatch(progress)
    watch("levels", 0.0)
    opened = first.device or device
    errors = MeasuredErrors(opened, train_views(cameras) if cameras else [], scene, options.background, options.memory)
    pieces = output.levelled(files, errors)
    levels = [LevelMade(count, scale_of_level(k)) for k, count in enumerate(counts)]
    if judge and cameras is not None and opened is not None:
        for k, data in enumerate(files):
            if k:
                watch("levels", k / len(files))
            views = EvaluationViews.of(views_of_level(cameras, k))
            with Evaluator(opened, kept or scene, views, options.background, pool, remember=False) as evaluator:
                levels[k] = replace(levels[k], psnr=evaluator.psnr(single.output.read(data, trust=True)))
    watch("levels", 1.0)
    return replace(
        first, pieces=pieces, nbytes=output.size(pieces), options=options, levels=tuple(levels),
        seconds=added_up(seconds, watch.seconds),
    )  # fmt: skip


def _coarser(options: EncodeOptions, count: int) -> EncodeOptions:
    """The options of a level of so many splats: those of photographs' size are not looked at."""
    prune: dict[str, Any] = {"keep": None, "count": count}
    if options.stage(Prune).unseen == "protect":
        prune["unseen"] = "keep"
    return options.changed(prune=prune, refit={"ground_truth": None})
