"""Scenes encoded with levels of detail: :func:`encode_levels`.

A level is one run of the stages: with a number of splats to keep, and smaller views. It keeps some of the splats that
the next finer level has kept, begins with them as they are in the full scene, and is fitted and re-fitted to the full
scene's pictures. What views show of each splat of the scene the finest one has measured for all.

Levels are made one after the other, and what is kept of each is the file that it became; while these become one, the
scenes that they hold are kept, too: together no more than twice the finest.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from potr_cl.errors import UsageError
from potr_cl.levels.errors import MeasuredErrors, measuring_views
from potr_cl.levels.plan import counts_of_levels, scaled, views_of_level
from potr_cl.levels.seams import scales_shown
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded, LevelMade
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Stopwatch, added_up
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.resident import ResidentScene
from potr_cl.stages.fit import STEPS, Fit
from potr_cl.stages.fitting.fit import FitOptions
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Progress
from potr_cl.workers.pool import Pool

_log = logging.getLogger("potr_cl")

#: The part of a usual fit's steps that a level is fitted for where no fit is asked for.
_FITTED = 0.25
#: Views that a step of its fit looks at, for each at the next finer level: on a GPU as many pixels, where a CPU would
#: take three times as long in all; and the most.
_BATCH: dict[Family, float] = {"cpu": math.sqrt(2), "gpu": 2.0}
_MOST_BATCH = 32
#: How strongly the re-fit holds colours to the fit's. With the usual 0.1 a small city's levels lose 2 to 4 dB in views
#: that nobody gave, with this next to nothing, and given ones 0.4 dB (docs/benchmarks/levels.md).
_PRIOR = 3.0
#: The most iterations of the pruning before it, which makes up for what fewer of them do worse.
_ITERATIONS = 16


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
            tell=tell, finer=finer,
        )  # fmt: skip

    first = made = one(cameras, single)
    counts = counts_of_levels(len(first.order), wanted)
    if len(counts) > 1 and (cameras is None or not options.stage(Prune).on):
        raise UsageError("coarser levels of detail are pruned: leave out --no-prune, or give --levels 1")
    files, seconds = [first.data], dict(first.seconds)
    for level, count in enumerate(counts[1:], 1):
        assert cameras is not None
        _log.info("level %d of %d: %s splats", level, len(counts) - 1, f"{count:,}")
        family = None if made.device is None else made.device.family
        made = one(views_of_level(cameras, level), coarser(single, level, count, family), made)
        files.append(made.data)
        seconds = added_up(seconds, made.seconds)
    watch = Stopwatch(progress)
    watch("levels", 0.0)
    opened = first.device or device

    @cache  # each has half the splats of the one before: all together take no more than twice the first
    def read(level: int) -> Scene:
        return single.output.read(files[level], trust=True)

    scales, views, between = [1.0], train_views(cameras) if cameras else [], list[Camera]()
    if len(files) > 1 and opened is not None:
        between = measuring_views(scene, views)
        scales = scales_shown(opened, read, len(files), between, options.background)
    errors = MeasuredErrors(opened, views, scene, options.background, options.memory, between, scales)
    pieces = output.levelled(files, errors, read)
    levels = [LevelMade(*each) for each in zip(counts, scales, strict=True)]
    if judge and cameras is not None and opened is not None:
        for k, scale in enumerate(scales):
            if k:
                watch("levels", k / len(files))
            judged = EvaluationViews.of(scaled(cameras, scale))
            with Evaluator(opened, kept or scene, judged, options.background, pool, remember=False) as evaluator:
                levels[k] = replace(levels[k], psnr=evaluator.psnr(read(k)))
    watch("levels", 1.0)
    return replace(
        first, pieces=pieces, nbytes=output.size(pieces), options=options, levels=tuple(levels),
        seconds=added_up(seconds, watch.seconds),
    )  # fmt: skip


def coarser(options: EncodeOptions, level: int, count: int, family: Family | None) -> EncodeOptions:
    """The options of a level of so many splats: those of photographs' size are not looked at.

    Gaps are closed, and it is fitted in any case, if only for a while: few splats in small pictures have to be wider
    and more opaque than those of the full scene, which colours alone cannot make up for. But not with preset paper.

    Args:
        options: of the finest level.
        level: from 1 on.
        count: of the splats.
        family: of the device; None: there is none.
    """
    prune: dict[str, Any] = {"keep": None, "count": count}
    if options.stage(Prune).unseen == "protect":
        prune["unseen"] = "keep"
    fit: dict[str, Any] = {}
    if family is not None and options.preset != "paper" and not options.stage(Fit).asked_for:
        prune["iterations"] = min(options.stage(Prune).iterations, _ITERATIONS)
        batch = min(round(FitOptions.batch * _BATCH[family] ** level), _MOST_BATCH)
        fit = {"steps": round(_FITTED * STEPS[family]), "compared": False, "batch": batch}
    merge = {"on": options.preset != "paper"}
    return options.changed(prune=prune, merge=merge, fit=fit, refit={"ground_truth": None, "prior": _PRIOR})
