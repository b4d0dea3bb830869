"""Scenes encoded with levels of detail: :func:`encode_levels`.

A level is one run of the stages: with a number of splats to keep, and smaller views. It keeps some of the splats that
the next finer level has kept, begins with them as they are in the full scene, and is fitted and re-fitted to the full
scene's pictures. What views show of each splat of the scene the finest one has measured for all.

What is kept of each level is the file that it became, and the scene that this holds, which takes the host's memory as
soon as it is made; with a bound on memory only while the files become one. All together they are no more than twice the
finest.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.host.threads import in_background
from potr_cl.levels.errors import MeasuredErrors, measuring_views
from potr_cl.levels.plan import MOST_BY_ITSELF, counts_of_levels, scaled, views_of_level
from potr_cl.levels.seams import scales_shown
from potr_cl.levels.slots import Slot, side_by_side, slots
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.pipeline.encode import Kept, encode
from potr_cl.pipeline.encoded import Encoded, LevelMade
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Stopwatch, added_up
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.resident import ResidentScene
from potr_cl.stages.fit import STEPS, Fit
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import Progress, Stage, State
from potr_cl.workers.pool import Pool

_log = logging.getLogger("potr_cl")

#: The part of a usual fit's steps that a level is fitted for where no fit is asked for.
_FITTED: dict[Family, float] = {"cpu": 0.5, "gpu": 0.6}
#: By how many times a step of its fit looks at more views in each coarser level, from one view on: on a GPU at as many
#: pixels, where a CPU would take three times as long in all. And the least and the most views.
_BATCH: dict[Family, float] = {"cpu": math.sqrt(2), "gpu": 2.0}
_LEAST_BATCH: dict[Family, int] = {"cpu": 2, "gpu": 4}
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
    output = options.output
    single = options.changed(output=output.of_level(), levels=1)
    makers = _Levels(scene, cameras, single, options.wanted_levels, kept, in_frame, tell)
    with slots(device, pool, scene.nbytes, options) as found:
        if kept is not None:
            for slot in found[1:]:
                assert slot.device is not None
                kept.bring_to(slot.device)
        side_by_side(makers.make, found, progress)
    made = [makers.made[level] for level in range(len(makers.made))]
    first, files, counts = made[0], [each.data for each in made], makers.counts()
    seconds = added_up(*(each.seconds for each in made))
    watch = Stopwatch(progress)
    watch("levels", 0.0)
    opened = first.device or device

    scales, views, between = [1.0], train_views(cameras) if cameras else [], list[Camera]()
    if len(files) > 1 and opened is not None:
        between = measuring_views(scene, views)
        scales = scales_shown(opened, makers.read, len(files), between, options.background)
    errors = MeasuredErrors(opened, views, scene, options.background, options.memory, between, scales)
    pieces = output.levelled(files, errors, makers.read)
    levels = [LevelMade(*each) for each in zip(counts, scales, strict=True)]
    if judge and cameras is not None and opened is not None:
        for k, scale in enumerate(scales):
            if k:
                watch("levels", k / len(files))
            judged = EvaluationViews.of(scaled(cameras, scale))
            with Evaluator(opened, kept or scene, judged, options.background, pool, remember=False) as evaluator:
                levels[k] = replace(levels[k], psnr=evaluator.psnr(makers.read(k)))
    watch("levels", 1.0)
    return replace(
        first, pieces=pieces, nbytes=output.size(pieces), options=options, levels=tuple(levels),
        seconds=added_up(seconds, watch.seconds),
    )  # fmt: skip


class _Levels:
    """The levels of a scene, each of which can be made as soon as it is known which splats the next finer one keeps.

    Args:
        single: options of a file of one level. wanted: levels.
        scene, cameras, kept, in_frame, tell: as of :func:`encode_levels`.

    Attributes:
        made: by level.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera] | None,
        single: EncodeOptions,
        wanted: int | str,
        kept: ResidentScene | None,
        in_frame: bool,
        tell: Callable[[str], None] | None,
    ) -> None:
        self._scene, self._cameras, self._single, self._wanted = scene, cameras, single, wanted
        self._kept, self._in_frame, self._tell = kept, in_frame, tell or _log.debug
        most = MOST_BY_ITSELF if isinstance(wanted, str) else wanted
        self._left: list[Future[Kept]] = [Future() for _ in range(most)]
        self.made: dict[int, Encoded] = {}
        self._read: dict[int, Future[Scene]] = {}

    def counts(self) -> list[int]:
        """How many splats each level has, once the finest has all that it keeps."""
        found = counts_of_levels(len(self._left[0].result().splats), self._wanted)
        if len(found) > 1 and (self._cameras is None or not self._single.stage(Prune).on):
            raise UsageError("coarser levels of detail are pruned: leave out --no-prune, or give --levels 1")
        return found

    def read(self, level: int) -> Scene:
        """What readers see of a level: each has half the splats of the one before, all together no more than twice the
        first.
        """
        return self._reading(level).result()

    def _reading(self, level: int) -> Future[Scene]:
        if level not in self._read:
            self._read[level] = in_background(self._single.output.read, self.made[level].data, True)
        return self._read[level]

    def make(self, level: int, slot: Slot, progress: Progress) -> bool:
        """Make a level; whether there is one of that number."""
        if level >= len(self._left):
            return False
        try:
            return self._made(level, slot, progress)
        except BaseException as error:
            if not self._left[level].done():
                self._left[level].set_exception(error)  # who waits for it ends, too
            raise

    def _made(self, level: int, slot: Slot, progress: Progress) -> bool:
        how, cameras, finer, tell = self._single, self._cameras, None, self._tell
        if level:
            counts = self.counts()
            if level >= len(counts):
                return False
            finer = self._left[level - 1].result()
            assert cameras is not None
            _log.info("level %d of %d: %s splats", level, len(counts) - 1, f"{counts[level]:,}")
            family = None if slot.device is None else slot.device.family
            how, cameras = coarser(how, level, counts[level], family), views_of_level(cameras, level)
            tell = partial(_told_of, tell, level)
        last = Fit if not level and how.stage(Fit).asked_for else Prune

        def follow(stage: Stage, state: State) -> None:
            if isinstance(stage, last):
                slot.share()
                self._left[level].set_result(Kept(state.survivors, state.results.importance))

        made = encode(
            self._scene, cameras, how, progress, slot.device, kept=self._kept, in_frame=self._in_frame or level > 0,
            pool=slot.pool, tell=tell, finer=finer, follow=follow,
        )  # fmt: skip
        self.made[level] = made
        if not self._left[level].done():  # nothing was removed
            self._left[level].set_result(Kept(np.sort(made.order), made.importance))
        if how.memory is None and len(self.counts()) > 1:
            self._reading(level)  # meanwhile others are made
        return True


def _told_of(tell: Callable[[str], None], level: int, line: str) -> None:
    tell(f"level {level}: {line}")


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
        batch = min(max(round(_BATCH[family] ** level), _LEAST_BATCH[family]), _MOST_BATCH)
        fit = {"steps": round(_FITTED[family] * STEPS[family]), "compared": False, "batch": batch}
    merge = {"on": options.preset != "paper"}
    return options.changed(prune=prune, merge=merge, fit=fit, refit={"ground_truth": None, "prior": _PRIOR})
