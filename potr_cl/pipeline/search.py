"""Encode to a size or to a quality: :func:`encode_to_target` finds the q whose file just meets a target.

It takes about as long as three encodes. Size and PSNR grow with q. In most scenes they grow at about the same rate, but
from different starting values. So the search goes like this:

1. It takes the q that a typical scene would need, and encodes roughly, with fewer pruning iterations. The result tells
   by how much this scene differs from a typical one.
2. It encodes in full with the q that follows from this.
3. It keeps the splats of that encode, and repeats only the later stages with a q close by: the re-fit and the
   quantiser, or only the quantiser if there is no re-fit.
4. What is still missing, perhaps one per cent, is made up by finer or coarser quantiser steps of the colours. The
   re-fit does not depend on these steps, so it need not be repeated.

If the result of 2 is too far off for 3, another q is encoded in full. A plain encode with the options that the search
returns makes the same file, as long as there is a re-fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType

from potr_cl.codec.blocks import GeometryOfBlocks
from potr_cl.codec.geometry import Geometry
from potr_cl.errors import UnreachableError, UsageError
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import CodedScene
from potr_cl.pipeline.encode import cameras_or_virtual, tell_left_out, tell_losses
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.fallback import with_fallback
from potr_cl.pipeline.growth import FASTEST, SLOWEST, FinenessAxis, Typical, meet, with_colour_steps, with_steps
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch, as_done
from potr_cl.pipeline.target import KINDS, Found, Target, Try
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.stages.code import Code
from potr_cl.stages.fit import Fit
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Progress, Stage, State, parameters
from potr_cl.workers.pool import Pool

#: A scout's pruning iterations, its steps of the re-fit and of the fit; and by how much what it finds is smaller than a
#: full encode's: the logarithm of bytes, and decibels; about, and where there is a re-fit.
_SCOUT_ITERATIONS, _SCOUT_STEPS, _SCOUT_FIT = 12, 2, 200
_SCOUT_MISSES = (-0.02, -0.55)
#: The highest q of a scout, and 1 less the lowest: the scene may be far from typical.
_SCOUT_END = 0.9
#: The value's way from a scout, in windows, from which on it tells how fast the value grows.
_FAR = 20
#: By how much the fineness (:class:`~potr_cl.pipeline.growth.FinenessAxis`) may differ from that of the q that the
#: splats are of: with a re-fit, which does what else there is to do again (a tenth costs 0.06 dB), and without, where
#: steps are all that changes.
_NEAR, _MOST_STEPS = 0.1, math.log(4 / 3)
#: How fast the value then grows, as a part of how it grows with q.
_NEAR_RATE, _STEPS_RATE = 0.7, 0.5
#: By how much the logarithm of the fineness of colours alone may differ (a tenth is 0.06 dB), and where all else has
#: been tried: in scenes so small that values leap.
_MOST_COLOUR_STEPS, _LAST_COLOUR_STEPS = 0.12, 0.5
#: How fast the size's logarithm and decibels grow with it.
_COLOUR_RATES = (0.12, 0.45)
#: Full encodes at most; one is the rule. And where there is nothing to prune or fit.
_ENCODES, _CHEAP_ENCODES = 5, 12
#: Tries of one kind with what a full encode has kept.
_TRIES = 3
#: The coder for tries of which only the pictures are looked at: the quickest.
_QUICK_CODER = {"entropy": "zstd", "zstd_level": 1}
#: Stands for the infinite PSNR of identical pictures, decibels.
_IDENTICAL = 200.0


def encode_to_target(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    target: Target,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
    tell: Callable[[str], None] | None = None,
    antialiased: bool | None = None,
    in_frame: bool = False,
    pool: Pool | None = None,
) -> Found:
    """Encode a scene so that it meets a target, as well (or as small) as that allows.

    Args:
        scene, cameras, progress, device, antialiased, in_frame, pool: as of :func:`potr_cl.pipeline.encode.encode`.
        target: what to reach.
        options: its q is not looked at; single parameters that are given stay as they are.
        tell: told a line for every step, and for every round of a fit.

    Raises:
        UnreachableError: no q meets the target.
        UsageError: options out of range, or a PSNR is asked for without cameras.
        DataError: a value too large to quantise.
        DeviceError: no device does the work.
    """
    options = options or EncodeOptions()
    options = options.changed(output=options.output.to_meet_a_target())
    scene = scene.rendered(antialiased)
    tell_losses(scene, options)
    watch = Stopwatch(progress, tell)
    cameras = cameras_or_virtual(scene, cameras, options, watch, in_frame, device)
    if target.min_psnr is not None and not cameras:
        raise UsageError("a PSNR can be reached with cameras only: without them there is no view to judge by")

    def work(device: Device, memory: int | None) -> Found:
        with _Search(
            scene, cameras or [], target, options.changed(memory=memory), watch, device, tell or (lambda _line: None),
            pool,
        ) as search:  # fmt: skip
            return search.run()

    found, _ = with_fallback(device or (Device() if pool is None else pool.first), options.memory, work)
    tell_left_out(scene, found.encoded)
    return found


@dataclass(frozen=True)
class _Candidate:
    """An encode that may become the result of the search.

    Attributes:
        thinned: the state before the stages that are repeated for another q.
        reduced: the state after them, before it is coded.
        options: the options that lead there.
        value: size or PSNR of the file that they give, as :class:`Target` compares it.
        encoded: that file; None if it was not needed to find the value.
    """

    thinned: State
    reduced: State
    options: EncodeOptions
    value: float
    encoded: Encoded | None


def _with_short_fit(options: EncodeOptions) -> EncodeOptions:
    """Options whose fit, where they have one, is as rough as all of a scout."""
    for stage in options.stages:
        if isinstance(stage, Fit) and stage.asked_for:
            short = _SCOUT_FIT if stage.steps == "auto" else min(stage.steps, _SCOUT_FIT)
            return options.changed(fit={"steps": short, "cycles": 1})
    return options


class _Search(AbstractContextManager["_Search"]):
    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        target: Target,
        options: EncodeOptions,
        watch: Stopwatch,
        device: Device,
        tell: Callable[[str], None],
        pool: Pool | None = None,
    ) -> None:
        self._pool = pool
        self._scene = scene
        self._cameras = cameras
        self._views = train_views(cameras) if cameras else []
        self._target = target
        self._options = options
        self._watch = watch
        self._device = device
        self._tell = tell
        self._tries: list[Try] = []
        self._encoded: dict[float, float] = {}  # values of full encodes
        kinds = [type(stage) for stage in options.stages]
        first = kinds.index(Refit) if Refit in kinds else kinds.index(Code)
        self._once, self._repeated = kinds[:first], [kind for kind in kinds[first:] if kind is not Code]
        by_size = target.max_bytes is not None
        self._typical = (
            Typical.sizes(options.preset, len(scene) * options.output.bytes_a_splat)
            if by_size
            else Typical.psnrs(options.preset)
        )
        self._axis = FinenessAxis(options)
        self._scouted: tuple[float, float] | None = None  # where, and the value of a full encode, about
        self._evaluator: Evaluator | None = None
        self._prepared: State | None = None
        self._used: Device | None = None  # by the stages that look at views

    def run(self) -> Found:
        target = self._target
        if target.min_psnr is not None:
            self._evaluator = Evaluator(
                self._device, self._scene, EvaluationViews.of(self._cameras), self._options.background, self._pool
            )
        q = self._scout(self._typical.quality(target.aim))
        reduces = bool(self._views) and self._options.look_at_views(self._scene)
        best: _Candidate | None = None
        for left in reversed(range(_ENCODES if reduces else _CHEAP_ENCODES)):
            found = self._encode(q)
            end = (q == 0 and found.value > target.aim) or (q == 1 and found.value < target.aim)
            if reduces and not end:
                found = self._approach(found, left == 0)
            if target.met(found.value) and (best is None or self._distance(found) < self._distance(best)):
                best = found
            if end or target.inside(found.value):
                break
            q = self._next()
            if best is None and (
                left == 1 or q in self._encoded
            ):  # the last try: the q that is most likely to meet the target
                q = 0.0 if target.max_bytes is not None else 1.0
            if q in self._encoded:
                break
        if best is None:
            hint = "; --unseen drop also removes what no view shows well" if is_virtual(self._views) else ""
            raise UnreachableError(f"cannot reach {target}: {self._extremes()}{hint}")
        encoded = best.encoded or self._code(best.reduced, best.options)
        return Found(encoded, best.options, best.value, self._tries)

    # ------------------------------------------------------------------------------------------ steps of the search

    def _scout(self, q: float) -> float:
        """The q to begin with, by a rough encode of one, if that takes less time than a full one."""
        rough = min(max(q, 1 - _SCOUT_END), _SCOUT_END)
        prune, steps = self._options.stage(Prune), self._options.stage(Refit).steps_on(self._device.family)
        fewer_steps = min(steps, _SCOUT_STEPS)
        options = self._options.changed(
            q=rough,
            prune={"iterations": min(prune.iterations, _SCOUT_ITERATIONS)},
            refit={"steps": fewer_steps, "at": ()},
        )
        options = _with_short_fit(options)
        fewer_looks = prune.on and options.prune.iterations < prune.iterations
        shorter_refit = self._fitted and fewer_steps < steps
        if not self._views or not (fewer_looks or shorter_refit):
            return q
        thinned = self._thin(options)
        self._mind_interrupts(thinned)
        options = as_done(options, thinned)
        value = self._evaluate("scout", rough, thinned, self._refit(thinned, options), options).value
        if shorter_refit:
            size, psnr = _SCOUT_MISSES
            value -= size if self._target.max_bytes is not None else psnr
        self._scouted = self._typical.value(rough), value
        return self._typical.quality(self._scouted[0] + self._target.aim - value)

    def _encode(self, q: float) -> _Candidate:
        """A full encode."""
        options = self._options.changed(q=q)
        thinned = self._thin(options)
        self._mind_interrupts(thinned)
        options = as_done(options, thinned)
        found = self._evaluate("encode", q, thinned, self._refit(thinned, options), options)
        self._encoded[q] = found.value
        return found

    def _mind_interrupts(self, thinned: State) -> None:
        """Fit no more where someone has interrupted a fit."""
        fitted = thinned.results.fitted
        if fitted is not None and fitted.ended_early:
            self._options = self._options.changed(fit=False)

    def _next(self) -> float:
        """The q to encode in full next, by what is known of others."""
        points = {self._typical.value(q): value for q, value in self._encoded.items()}
        return self._typical.quality(meet(points, self._target.aim, self._rate()))

    def _rate(self) -> float:
        """How fast the value grows, compared with a typical scene; 1 if the rough encode was too near to tell."""
        if self._scouted is None:
            return 1.0
        place, value = self._scouted
        other = max(self._encoded, key=lambda q: abs(self._typical.value(q) - place))
        way = self._typical.value(other) - place
        low, high = self._target.window
        if abs(way) < _FAR * (high - low):
            return 1.0
        return min(max((self._encoded[other] - value) / way, SLOWEST), FASTEST)

    def _approach(self, found: _Candidate, last: bool) -> _Candidate:
        """Come nearer to the aim by repeating only the later stages of a full encode.

        Args:
            found: the full encode.
            last: whether no other full encode may follow. If one may, nothing is done where ``found`` is too far off.
        """
        target, typical = self._target, self._typical
        reach, rate = (_NEAR, _NEAR_RATE) if self._fitted else (_MOST_STEPS, _STEPS_RATE)
        rate *= self._rate()
        start, best, q = found, found, found.options.q
        ends = [self._axis.quality(self._axis.fineness(q) + sign * reach) for sign in (-1, 1)]
        points = {typical.value(q): found.value}
        for _ in range(_TRIES):
            if self._colours_suffice(best.value):
                best = self._with_other_colours(best, _MOST_COLOUR_STEPS)
            if target.inside(best.value):
                return best
            wanted = typical.quality(meet(points, target.aim, rate))
            q = min(max(wanted, ends[0]), ends[1])
            known = typical.value(q) in points
            if q != wanted and (len(points) == 1 or known) and not last:
                return best
            if known:
                break
            near = self._again(start, q) if self._fitted else self._with_other_steps(start, q)
            points[typical.value(q)] = near.value
            best = min(best, near, key=self._distance)
        return self._with_other_colours(best, _LAST_COLOUR_STEPS)

    def _again(self, start: _Candidate, q: float) -> _Candidate:
        """The splats of a candidate, re-fitted and quantised as another q would have it."""
        chosen = start.options.parameters
        once = [kind for kind in self._once if kind is Prune or self._options.stage(kind).on]
        kept = {name: getattr(chosen, name) for kind in once for name in parameters(kind)}
        options = as_done(self._options.changed(q=q), start.thinned).with_parameters(**kept)
        return self._evaluate("refit", q, start.thinned, self._refit(start.thinned, options), options)

    def _with_other_steps(self, start: _Candidate, q: float) -> _Candidate:
        """A candidate that was not re-fitted, with the quantiser steps of another q."""
        return self._evaluate("steps", q, start.thinned, start.reduced, with_steps(start.options, q))

    def _with_other_colours(self, start: _Candidate, most: float) -> _Candidate:
        """The best of a few tries with finer or coarser quantiser steps of the colours.

        Args:
            start: the candidate to begin with.
            most: the largest change of a step's logarithm.
        """
        points, best = {0.0: start.value}, start
        if not self._options.output.steps:
            return best
        for _ in range(_TRIES):
            finer = meet(points, self._target.aim, self._colour_rate)
            finer = round(min(max(finer, -most), most), 4)
            options = with_colour_steps(start.options, self._options, finer)
            if finer in points or options == start.options or self._target.inside(best.value):
                break
            reduced, geometry = start.reduced, start.reduced.geometry
            if self._fitted and self._options.output.fixes_ac:
                # The re-fit has rounded to the steps.
                reduced = self._refit(start.thinned, options)
            elif isinstance(geometry, (Geometry, GeometryOfBlocks)):
                reduced = dataclasses.replace(reduced, geometry=geometry.with_colour_steps(options.parameters))
            found = self._evaluate("colours", start.options.q, start.thinned, reduced, options)
            points[finer] = found.value
            best = min(best, found, key=self._distance)
        return best

    def _colours_suffice(self, value: float) -> bool:
        """Whether other quantiser steps of the colours will probably reach the target."""
        given = self._options.code.sf_dc is not None and self._options.code.sf_sh is not None
        given = given or not self._options.output.steps
        low, high = self._target.window
        spare = (high - low) / 4
        reach = self._colour_rate * _MOST_COLOUR_STEPS
        return not given and not low <= value <= high and low + spare - reach <= value <= high - spare + reach

    @property
    def _colour_rate(self) -> float:
        return _COLOUR_RATES[self._target.max_bytes is None]

    # ------------------------------------------------------------------------------------------ parts of an encode

    @property
    def _fitted(self) -> bool:
        """Whether there is a re-fit. If so, it is repeated for another q."""
        return self._options.stage(Refit).looks_at(self._scene)

    def _thin(self, options: EncodeOptions) -> State:
        """The state after the stages that are not repeated for another q."""
        if self._prepared is None:
            state = State.of(self._scene, self._views)
            self._prepared = self._run(state, options, [kind for kind in self._once if kind.serves_others])
        return self._run(self._prepared, options, [kind for kind in self._once if not kind.serves_others])

    def _refit(self, thinned: State, options: EncodeOptions) -> State:
        """The state after the stages that are repeated for another q, before the coding."""
        return self._run(thinned, options, self._repeated)

    def _run(self, state: State, options: EncodeOptions, only: list[type[Stage]]) -> State:
        run = Run(options, self._watch, self._device, pool=self._pool)
        state = run.stages(state, only)
        self._used = run.device or self._used
        self._device = run.device or self._device
        return state

    def _code(self, state: State, options: EncodeOptions) -> Encoded:
        run = Run(options, self._watch, self._device, pool=self._pool)
        return dataclasses.replace(run.finished(run.stages(state, [Code])), device=self._used)

    def _evaluate(self, kind: str, q: float, thinned: State, reduced: State, options: EncodeOptions) -> _Candidate:
        encoded: Encoded | None
        if self._evaluator is None:
            encoded = self._code(reduced, options)
            value = math.log(encoded.nbytes)
        else:
            encoded = None
            pieces = self._code(reduced, options.changed(code=_QUICK_CODER)).pieces
            what = "evaluate tries"
            self._watch(what, 0.0)
            coded = CodedScene(options.output, b"".join(pieces), trust=True)
            with coded.on(self._evaluator.device) as candidate:
                psnr = self._evaluator.psnr(
                    candidate, coded=coded, progress=lambda done: self._watch(what, min(done, 0.99))
                )
            value = min(psnr, _IDENTICAL)
            self._watch(what, 1.0)
        self._tries.append(Try(kind, q, value))
        self._tell(f"{KINDS[kind].format(f'{q:g}')} {self._target.describe(value)}")
        return _Candidate(thinned, reduced, options, value, encoded)

    # ------------------------------------------------------------------------------------------ comparing

    def _distance(self, found: _Candidate) -> tuple[bool, float]:
        return not self._target.met(found.value), abs(found.value - self._target.aim)

    def _extremes(self) -> str:
        """What the lowest and the highest quality give, encoded if need be."""
        values = (self._encoded[q] if q in self._encoded else self._encode(q).value for q in (0.0, 1.0))
        low, high = map(self._target.describe, values)
        return f"quality 0 gives {low}, quality 1 gives {high}"

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._evaluator is not None:
            self._evaluator.__exit__(kind, error, trace)
