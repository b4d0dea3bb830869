"""Stages run one after the other on a device (:class:`Run`), each again if memory is short, and are timed."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.host.threads import in_background
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output
from potr_cl.pipeline.encoded import Encoded, SharedOut
from potr_cl.pipeline.fallback import for_views, with_fallback
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.placement.rays import unresolved
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import ResidentScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.fit import Sight, held_out_error
from potr_cl.stages.fitting.fitted import File, Fitted, LeftOut, TwoFiles
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Interlude, Progress, Stage, State, Workbench
from potr_cl.stages.unseen import Unresolved, as_they_were, part_of_area
from potr_cl.stages.views_between import priced
from potr_cl.views.targets import RenderedTargets
from potr_cl.workers.pool import Pool, Traffic

_log = logging.getLogger("potr_cl")


def added_up(*parts: Mapping[str, float]) -> dict[str, float]:
    """Seconds by stage of several stopwatches together."""
    found: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            found[stage] = found.get(stage, 0.0) + seconds
    return found


class Stopwatch:
    """Passes progress on, and notes how long each stage took. Time of a stage within another is not counted twice.

    Attributes:
        seconds: wall time by stage, in the order in which they began.
        tell: takes lines about the work.
    """

    def __init__(self, progress: Progress | None = None, tell: Callable[[str], None] | None = None) -> None:
        self._progress = progress
        self.tell: Callable[[str], None] = tell or _log.debug
        self._running: str | None = None
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: float) -> None:
        now = time.perf_counter()
        self.seconds.setdefault(stage, 0.0)
        self.seconds[self._running or stage] += now - self._last
        self._running, self._last = stage if done < 1 else None, now
        if self._progress is not None:
            self._progress(stage, done)


_NO_SMALLER = "on the views that were held out, a file with it was no better than one without"


@dataclass(frozen=True)
class Trial:
    """What the two files are made and judged with.

    Attributes:
        remaining: the stages after the fit, up to the one that makes the file.
        output: the kind of file.
        device: that judges.
        source: the uncompressed scene, as it may lie there.
        background: R, G, B behind the scene.
    """

    remaining: Callable[[State], State]
    output: Output
    device: Device
    source: Drawable
    background: tuple[float, float, float]

    def of(self, state: State) -> File:
        """The file that a state becomes, and how well it shows the views that a fit holds out."""
        coded = self.remaining(state).results.coded
        assert coded is not None, "the last stage makes the file"
        with (
            self.output.seen(b"".join(coded.pieces), self.device, trust=True) as seen,
            Rasterizer(self.device, self.source, background=self.background) as rasterizer,
        ):
            targets = RenderedTargets(rasterizer, state.views)
            error = held_out_error(self.device, seen, Sight(state.views, targets, state.added, self.background))
        return File(coded.nbytes, error)


def only_if_it_pays(before: State, after: State, trial: Trial) -> State:
    """The state after a fit, or that before it where a file with the fit would be no better.

    The fit judges itself before anything is rounded. What it gains can be lost again when the file is made:
    coefficients that were 0 are not any more, the re-fit of the colours would have mended most of what it mends, and
    errors far below those of rounding count for nothing. So where the gain is small, the remaining stages are run with
    the fit and without it. The views that the fit held out compare the two files: the re-fit has looked at them in
    both.

    Args:
        before, after: the fit. ``after`` is returned as it is where the fit was left out, was interrupted, gained much,
            or went on to photographs, which are judges of their own.
        trial: makes the files.

    Returns:
        One of the two; what both files came to is told with what the fit says of itself.

    Raises:
        As the stages.
    """
    told = after.results.fitted
    if not isinstance(told, Fitted) or not told.in_doubt or told.ended_early or told.photographs is not None:
        return after
    left_out = LeftOut(_NO_SMALLER)
    try:
        files = TwoFiles(trial.of(before.with_results(fitted=left_out)), trial.of(after))
    except DeviceMemoryError:  # where there is no room to compare files, the fit's own judgement has to do
        return after
    if files.pays:
        return after.with_results(fitted=dataclasses.replace(told, files=files))
    return before.with_results(fitted=dataclasses.replace(left_out, files=files))


class Run:
    """Runs stages one after the other, from the beginning or from any state that one of them has left.

    Args:
        options: the stages, and what they all share.
        watch: keeps the time and passes the progress on.
        device: the first to be tried; by default the best one there is, opened when a stage needs it.
        kept: the uncompressed scene on that device.
        pool: workers that views are shared out to, as long as the work is done on the pool's first device.
        follow: called with each stage and what it has left.

    Attributes:
        device: the one on which the last stage ran that needs views; None if none did.
    """

    def __init__(
        self,
        options: EncodeOptions,
        watch: Stopwatch,
        device: Device | None = None,
        kept: ResidentScene | None = None,
        pool: Pool | None = None,
        follow: Callable[[Stage, State], None] | None = None,
    ) -> None:
        self.device: Device | None = None
        self._follow = follow
        self._pool = pool
        self._before = Traffic() if pool is None else dataclasses.replace(pool.traffic)
        self._options, self._watch, self._given, self._kept = options, watch, device, kept
        if kept is not None and pool is not None:
            for other in pool.devices:
                kept.bring_to(other)

    def stages(self, state: State, only: Sequence[type[Stage]] | None = None) -> State:
        """Run the stages, or some of them, in their order.

        Raises:
            As :func:`potr_cl.pipeline.encode.encode`.
        """
        state = self._guarded(state)
        done = [stage for stage in self._options.stages if only is None or type(stage) in only]
        again = any(isinstance(stage, (Fit, Refit)) and stage.asked_for for stage in done)
        pictures = state.results.pictures
        waiting = list(done)
        try:
            for stage in done:
                if not self._is_wanted(stage, state):
                    continue
                if not stage.serves_others:
                    state, waiting = self._begun(waiting, state), []
                after = self._done(stage, state, again)
                pictures = after.results.pictures
                after = as_they_were(after)
                # What is before it is kept no longer than this: colours of a large scene take gigabytes.
                state = self._fit_that_pays(state, after) if isinstance(stage, Fit) else after
                if self._follow is not None:
                    self._follow(stage, state)
        except BaseException:
            if state.results.sought is not None:
                state.results.sought.stop()
            raise
        finally:
            if pictures is not None:
                pictures.close()
        return state

    def _begun(self, stages: Sequence[Stage], state: State) -> State:
        """The state once stages have begun what they can in the background."""
        device = self.device or self._given
        for stage in stages:
            if device is not None and stage.needs_views and self._is_wanted(stage, state):
                state = stage.begun(state, dataclasses.replace(self._bench(stage, state, False), device=device))
        return state

    def _is_wanted(self, stage: Stage, state: State) -> bool:
        if not stage.asked_for or not stage.needs_views:
            return stage.asked_for
        if not state.views or not stage.looks_at(state.scene):
            return False
        return not stage.serves_others or self._options.look_at_views(state.scene)

    def _guarded(self, state: State) -> State:
        """The state that knows what no view has resolved, where nothing may be lost of that."""
        prune = next((each for each in self._options.stages if isinstance(each, Prune)), Prune())
        placed = is_virtual(state.views) and prune.keep is None and prune.count is None
        wanted = prune.unseen == "protect" or (prune.unseen == "keep" and placed)
        known = state.results.unresolved is not None
        if not wanted or known or not state.views or not self._options.look_at_views(state.source):
            return state
        self._watch("place cameras", 0.0)

        def found(device: Device, memory: int | None) -> NDArray[np.bool_]:
            return unresolved(device, state.source, state.views)

        splats, _ = with_fallback(self.device or self._given or Device(), self._options.memory, found)
        self._watch("place cameras", 1.0)
        area = in_background(part_of_area, state.source, splats).result if splats.any() else float
        return state.with_results(unresolved=Unresolved(splats, area))

    def _fit_that_pays(self, before: State, after: State) -> State:
        """The state after a fit, or the one before it if a file says so."""
        device = self.device
        if device is None or after.results.fitted is None or not self._options.stage(Fit).compared:
            return after
        names = [type(stage) for stage in self._options.stages]
        remaining = names[names.index(Fit) + 1 :]
        source = before.source if self._kept is None else self._kept.drawable(device, before.source)

        def made(state: State) -> State:
            self._watch(Fit.name, 0.99)
            return Run(self._options, Stopwatch(), device, self._kept, self._pool).stages(state, remaining)

        trial = Trial(made, self._options.output, device, source, self._options.background)
        state = only_if_it_pays(before, after, trial)
        self._watch(Fit.name, 1.0)
        return state

    def _bench(self, stage: Stage, state: State, shown_again: bool) -> Workbench:
        options = as_done(self._options, state)
        return Workbench(
            priced(options.parameters, state),
            memory=options.memory,
            background=options.background,
            threads=options.threads,
            interludes=self._interludes(stage, state),
            metadata=lambda last: _metadata(last, as_done(options, last)),
            progress=self._watch,
            tell=self._watch.tell,
            output=options.output,
            kept=self._kept,
            photographs=next((each.ground_truth for each in options.stages if isinstance(each, Refit)), None),
            shown_again=shown_again,
        )

    def _done(self, stage: Stage, state: State, shown_again: bool) -> State:
        """The state after a stage; ``shown_again`` as of the workbench."""
        bench = self._bench(stage, state, shown_again)
        if not stage.needs_views:
            return stage.run(state, bench)

        def work(device: Device, memory: int | None) -> State:
            pool = self._pool if self._pool is not None and device is self._pool.first else None
            room = for_views(device, memory, len(state.source))
            return stage.run(state, dataclasses.replace(bench, device=device, memory=room, pool=pool))

        given = self.device or self._given or Device()
        after, self.device = with_fallback(given, self._options.memory, work)
        return after

    def _interludes(self, stage: Stage, state: State) -> tuple[Interlude, ...]:
        """What other stages want done while this one removes splats."""
        if stage.removes_in is None:
            return ()
        wanted = [each for other in self._options.stages if other.on for each in other.interludes(stage.removes_in)]
        return tuple(interlude for interlude in wanted if interlude.stage.looks_at(state.source))

    def finished(self, state: State) -> Encoded:
        """What the stages have made, as the file that it is."""
        coded = state.results.coded
        assert coded is not None, "the last stage makes the file"
        return Encoded(
            pieces=coded.pieces,
            nbytes=coded.nbytes,
            order=state.survivors[coded.order],
            pruned=state.results.pruned,
            unseen=state.results.unseen,
            fitted=state.results.fitted,
            refitted=state.results.refitted,
            photographs=state.results.photographs,
            between=state.results.between,
            device=self.device,
            seconds=self._watch.seconds,
            options=self._options,
            source_splats=len(state.source),
            shared=None if self._pool is None else SharedOut.by(self._pool, self._before),
            parameters=priced(as_done(self._options, state).parameters, state),
            left_out=0 if coded.sh_degree is None else state.scene.sh_degree - coded.sh_degree,
            importance=state.results.importance,
        )


def as_done(options: EncodeOptions, state: State) -> EncodeOptions:
    """The options as a state has followed them: only a fit that made up for splats has the others round finer.

    Whether a fit pays is known then, and not asked again where other qualities follow.
    """
    fitted = state.results.fitted
    if isinstance(fitted, LeftOut):
        return options.changed(fit=False)
    if isinstance(fitted, Fitted):
        return options.changed(fit={"compared": False, **({} if fitted.spared else {"finer": 0.0})})
    return options


def _metadata(state: State, options: EncodeOptions) -> bytes:
    """What the file says of how it was made."""
    parameters, views = priced(options.parameters, state), state.views
    by_name = {stage.name: stage for stage in options.stages if stage.on}
    prune = by_name.get("prune")
    by_threshold = isinstance(prune, Prune) and prune.count is None and prune.keep is None
    compacts = bool(views) and "compact" in by_name
    facts = {
        "q": options.q,
        "cameras": ("virtual" if is_virtual(views) else "given") if views else None,
        "beta": parameters.beta if views else None,
        "gamma": parameters.gamma,
        "delta_mse_max": parameters.delta_mse_max if by_threshold and state.results.pruned is not None else None,
        "lambda": parameters.lam if compacts else None,
        "alpha": parameters.alpha if compacts else None,
        "source_splats": len(state.source),
        "source_bytes": options.source_bytes,
    }
    return json.dumps(facts, separators=(",", ":")).encode()
