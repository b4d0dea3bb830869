"""Encode to a size or to a quality: the q whose file just meets a target, with work shared between tries.

1. A survey prunes once, from q = 1 downwards, in few iterations: it tells about how many splats each q keeps, and
   which.
2. Estimates for single q cost seconds: the survey's splats, compacted and quantised; a fast entropy stage for the size,
   few views for the PSNR. They lead to a q.
3. That q is encoded in full. What the estimates were wrong by is known then.
4. What is missing is made up by the quantiser alone, whose steps are taken from a neighbouring q: seconds again. If
   that is not enough, estimates put right by 3 lead to another q and another full encode.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.bitstream import EntropyCoder
from potr_cl.cameras import Camera, train_views
from potr_cl.compaction import Compactor, ViewWeights
from potr_cl.decoder import decode
from potr_cl.device import Device
from potr_cl.encoder import Encoded, Reduced, Stopwatch, code, needs_views, reduce
from potr_cl.errors import UnreachableError, UsageError
from potr_cl.fallback import on_device
from potr_cl.judging import Judge, JudgingViews
from potr_cl.options import EncodeOptions
from potr_cl.pruning import PruningOptions, choose
from potr_cl.rasterizer import Rasterizer
from potr_cl.reduction import Progress
from potr_cl.removal import RemovalSweep
from potr_cl.scene import Scene
from potr_cl.streams import code_scene
from potr_cl.virtual_cameras import place_cameras, standpoints

#: The survey's stages, in steps of q, and the pruning iterations of each.
_STAGE = 0.25
_ITERATIONS = 3
#: Views that an estimate of the PSNR looks at.
_FEW_VIEWS = 24
#: By how much the fineness (:class:`_Axis`) of the quantiser may differ from that of everything else: steps by a third.
_MOST_STEPS = math.log(4 / 3)
#: The highest of zstd's levels that costs no time to speak of, and the logarithm of what is about gained beyond.
_QUICK_LEVEL, _LEVEL_GAIN = 9, -0.08
#: Full encodes at most; one or two are the rule.
_ENCODES = 4
#: Stands for the infinite PSNR of identical pictures, decibels.
_IDENTICAL = 200.0
#: Values that one solution for q may ask for.
_STEPS = 12
#: The fineness between two qualities that is too little to tell them apart, by estimates and by real values.
_SAME_BY_ESTIMATE, _SAME = 0.015, 0.001


@dataclass(frozen=True)
class Target:
    """What to reach; one of the two.

    Attributes:
        max_bytes: the file shall have at most so many bytes, and at least 98 % of them.
        min_psnr: the mean PSNR in decibels over the judging views, against the uncompressed scene's renders, shall be
            this at least, and at most 0.1 more.

    Raises:
        UsageError: not exactly one, or out of range.
    """

    max_bytes: int | None = None
    min_psnr: float | None = None

    def __post_init__(self) -> None:
        if (self.max_bytes is None) == (self.min_psnr is None):
            raise UsageError("give either a size or a PSNR to reach")
        if self.max_bytes is not None and self.max_bytes < 1:
            raise UsageError(f"a file of at most {self.max_bytes} bytes: at least 1 is needed")
        if self.min_psnr is not None and not 0 < self.min_psnr < math.inf:
            raise UsageError(f"a PSNR of at least {self.min_psnr:g} dB: it must be a positive number")

    @property
    def window(self) -> tuple[float, float]:
        """The values with which the search is content: logarithms of sizes, or decibels."""
        if self.max_bytes is not None:
            return math.log(0.98 * self.max_bytes), math.log(self.max_bytes)
        assert self.min_psnr is not None
        return self.min_psnr, self.min_psnr + 0.1

    @property
    def aim(self) -> float:
        """The value to aim at: the middle of the window."""
        return sum(self.window) / 2

    @property
    def slope(self) -> float:
        """About how much the value grows with the fineness (:class:`_Axis`)."""
        return 0.55 if self.max_bytes is not None else 6.5

    def met(self, value: float) -> bool:
        """Whether a value keeps the promise, if not by how little."""
        low, high = self.window
        return value <= high if self.max_bytes is not None else value >= low

    def plain(self, value: float) -> float:
        """A value as bytes or decibels."""
        return round(math.exp(value)) if self.max_bytes is not None else value

    def describe(self, value: float) -> str:
        """A value for people."""
        return f"{self.plain(value):,} bytes" if self.max_bytes is not None else f"{value:.2f} dB"

    def __str__(self) -> str:
        return f"at most {self.max_bytes:,} bytes" if self.max_bytes is not None else f"at least {self.min_psnr:g} dB"


@dataclass(frozen=True)
class Try:
    """One step of a search.

    Attributes:
        kind: "estimate", "encode" (in full), or "steps" (other quantiser steps for the last full encode).
        q: of the encode; of the quantiser for "steps".
        value: see :meth:`Target.plain`.
    """

    kind: str
    q: float
    value: float


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        encoded: the file that meets the target.
        options: that it was encoded with: q, and quantiser steps of their own where they differ from that q's.
        value: that was reached; see :meth:`Target.plain`.
        tries: all steps, in order.
    """

    encoded: Encoded
    options: EncodeOptions
    value: float
    tries: list[Try]


def encode_to_target(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    target: Target,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
    tell: Callable[[str], None] | None = None,
) -> Found:
    """Encode a scene so that it meets a target, as well (or as small) as that allows.

    Args:
        scene, cameras, progress, device: as :func:`potr_cl.encoder.encode` takes them.
        target: what to reach.
        options: its q is not looked at; single parameters that are given stay as they are.
        tell: told a line for every step.

    Raises:
        UnreachableError: no q meets the target.
        UsageError: options out of range, or a PSNR is asked for without cameras.
        DataError: a value too large to quantise.
        DeviceError: no device does the work.
    """
    options = options or EncodeOptions.for_preset("best")
    watch = Stopwatch(progress)
    if cameras is None and needs_views(scene, options):
        watch("place cameras", 0.0)
        cameras = place_cameras(scene)
        watch("place cameras", 1.0)
    if target.min_psnr is not None and not cameras:
        raise UsageError("a PSNR can be reached with cameras only: without them there is no view to judge by")

    def work(device: Device, options: EncodeOptions) -> Found:
        search = _Search(scene, cameras or [], target, options, watch, device, tell or (lambda _line: None))
        try:
            return search.run()
        finally:
            search.free()

    found, _ = on_device(device or Device(), options, work)
    return found


class _Survey:
    """One pruning from q = 1 downwards, as far as it is asked for, and how much each splat shows where at the start."""

    def __init__(
        self, scene: Scene, views: Sequence[Camera], options: EncodeOptions, watch: Stopwatch, device: Device
    ) -> None:
        self._options = options
        self._splats = len(scene)
        self._alive = np.arange(len(scene), dtype=np.int64)
        self._removed: list[NDArray[np.int64]] = []
        self._stages: list[tuple[float, int]] = []  # the logarithm of ΔMSE_MAX, and how many splats it leaves
        self._next_q = 1.0
        self._watch = watch
        self._rasterizer: Rasterizer | None = Rasterizer(device, scene, background=options.background)
        self._removal = RemovalSweep(
            self._rasterizer, views, options.sweep, lambda done, count: watch("prepare views", done / count)
        )
        self._effects = self._removal.measure()
        self.weights: ViewWeights | None = None
        if (options.compact or options.refit) and scene.sh_degree > 0:
            self.weights = ViewWeights.from_importances(len(scene), self._removal.view_importances())

    def survivors(self, q: float) -> NDArray[np.int64]:
        """About the splats that quality q keeps, ascending."""
        options = dataclasses.replace(self._options, q=q)
        if not options.prune:
            return self._alive
        wanted = _log(options.parameters.delta_mse_max)
        while self._rasterizer is not None and (
            not self._stages or (self._next_q >= 0 and wanted > self._stages[-1][0])
        ):
            self._prune_further()
        thresholds, counts = zip(*[(-1e9, self._splats), *self._stages], strict=True)
        count = round(float(np.interp(wanted, thresholds, counts)))
        order = np.concatenate([*self._removed, self._alive])
        return np.sort(order[len(order) - max(count, 1) :])

    def _prune_further(self) -> None:
        limit = dataclasses.replace(self._options, q=self._next_q).parameters.delta_mse_max
        schedule = PruningOptions(limit, _ITERATIONS, count=self._options.count)
        for iteration in range(_ITERATIONS):
            self._watch("survey", min(1 - self._next_q + _STAGE * iteration / _ITERATIONS, 0.99))
            gone = choose(*self._effects, self._alive, _ITERATIONS - iteration, schedule)[: len(self._alive) - 1]
            if not len(gone):
                break
            self._removed.append(gone)
            self._alive = np.setdiff1d(self._alive, gone, assume_unique=True)
            self._removal.remove(gone)
            self._effects = self._removal.measure()
        self._watch("survey", 1.0)
        self._stages.append((_log(limit), len(self._alive)))
        self._next_q -= _STAGE

    def free(self) -> None:
        """Give the device memory back; what is known stays known."""
        if self._rasterizer is not None:
            self._removal.free()
            self._rasterizer.free()
            self._rasterizer = None


def _log(value: float) -> float:
    return math.log(max(value, 1e-300))


class _Search:
    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        target: Target,
        options: EncodeOptions,
        watch: Stopwatch,
        device: Device,
        tell: Callable[[str], None],
    ) -> None:
        self._scene = scene
        self._cameras = cameras
        self._views = train_views(cameras) if cameras else []
        self._target = target
        self._options = options
        self._watch = watch
        self._device = device
        self._tell = tell
        self._tries: list[Try] = []
        self._estimates: dict[float, float] = {}
        self._encoded: dict[float, float] = {}  # values of full encodes
        self._axis = _Axis(options)
        self._survey: _Survey | None = None
        self._judge: Judge | None = None

    def run(self) -> Found:
        target, options = self._target, self._options
        if self._views and needs_views(self._scene, options):
            self._watch("prepare views", 0.0)
            self._survey = _Survey(self._scene, self._views, options, self._watch, self._device)
        if target.min_psnr is not None:
            self._judge = Judge(self._device, self._scene, JudgingViews.of(self._cameras), options.background)
        low, high = target.window
        best: Found | None = None
        encoded = self._encoded
        q = 0.5
        for left in reversed(range(_ENCODES)):
            # Between what is known to be too little and too much.
            bounds = (
                max((p for p in encoded if encoded[p] < target.aim), default=0.0),
                min((p for p in encoded if encoded[p] >= target.aim), default=1.0),
            )
            first = min(max(q, bounds[0]), bounds[1])
            q, _ = _solve(self._expected, target.aim, target, self._axis, first, *bounds, same=_SAME_BY_ESTIMATE)
            if q in encoded and best is None:  # the last hope
                q = 0.0 if target.max_bytes is not None else 1.0
            if q in encoded:
                break
            reduced, found = self._encode(q)
            encoded[q] = found.value
            found = self._adjust(reduced, found, left == 0)
            if target.met(found.value) and (best is None or self._rank(found) < self._rank(best)):
                best = found
            if low <= found.value <= high or (q == 0 and found.value > high) or (q == 1 and found.value < low):
                break
        if best is None:
            raise UnreachableError(f"{target} cannot be reached: {self._extremes()}")
        return dataclasses.replace(best, tries=self._tries)

    def _rank(self, found: Found) -> tuple[bool, float]:
        return not self._target.met(found.value), abs(found.value - self._target.aim)

    def _expected(self, q: float) -> float:
        """The estimate for a q, put right by what those were wrong by that were encoded in full."""
        estimate = self._estimate(q)
        if not self._encoded:
            slow = self._judge is None and self._quick_coder() != self._options.entropy
            return estimate + (_LEVEL_GAIN if slow else 0.0)
        known = sorted(self._encoded)
        errors = [self._encoded[p] - self._estimate(p) for p in known]
        return estimate + float(np.interp(self._axis.fineness(q), [self._axis.fineness(p) for p in known], errors))

    def _extremes(self) -> str:
        said = []
        for q in (0.0, 1.0):
            about = "" if q in self._encoded else "about "
            value = self._encoded[q] if q in self._encoded else self._expected(q)
            said.append(f"quality {q:g} gives {about}{self._target.describe(value)}")
        return ", ".join(said)

    def _estimate(self, q: float) -> float:
        if q not in self._estimates:
            self._watch("estimate", 0.0)
            scene, options = self._scene, dataclasses.replace(self._options, q=q)
            if self._survey is not None:
                survivors = self._survey.survivors(q)
                scene = scene.subset(survivors)
                # A re-fit gives up coefficients too, and is as small as a compaction, but loses much less.
                if self._survey.weights is not None and (options.compact or self._judge is None):
                    weights = _of_splats(self._survey.weights, survivors)
                    eyes = standpoints(self._views, self._scene.means)
                    scene = Compactor(self._device).compact(scene, eyes, weights, options.compaction)
            self._estimates[q] = self._note("estimate", q, self._quick_value(scene, options, _FEW_VIEWS))
        return self._estimates[q]

    def _quick_value(self, scene: Scene, options: EncodeOptions, most_views: int | None = None) -> float:
        """The value without the time that the real entropy stage takes."""
        self._watch("estimate", 0.0)
        coded = code_scene(scene, options.parameters, self._views, b"", self._quick_coder(), options.threads)
        return self._value(coded.pieces, most_views)

    def _quick_coder(self) -> EntropyCoder:
        if self._judge is not None:
            return EntropyCoder("zstd", 1)
        coder = self._options.entropy
        if coder.name == "zstd" or (coder.name == "context" and self._options.parameters.version == 1):
            return EntropyCoder("zstd", min(coder.level, _QUICK_LEVEL))
        return coder

    def _value(self, pieces: list[bytes], most_views: int | None = None) -> float:
        self._watch("estimate", 0.0)
        if self._judge is None:
            value = math.log(sum(map(len, pieces)))
        else:
            value = min(self._judge.psnr(decode(b"".join(pieces)), most_views), _IDENTICAL)
        self._watch("estimate", 1.0)
        return value

    def _note(self, kind: str, q: float, value: float) -> float:
        self._tries.append(Try(kind, q, value))
        said = {"estimate": f"quality {q:g}: about", "encode": f"quality {q:g}:", "steps": f"steps of quality {q:g}:"}
        self._tell(f"{said[kind]} {self._target.describe(value)}")
        return value

    def _encode(self, q: float) -> tuple[Reduced, Found]:
        """A full encode."""
        if self._survey is not None:
            self._survey.free()
        options = dataclasses.replace(self._options, q=q)
        reduced = reduce(self._scene, self._views, options, self._watch, self._device)
        return reduced, self._finish("encode", q, reduced, options)

    def _finish(self, kind: str, q: float, reduced: Reduced, options: EncodeOptions) -> Found:
        encoded = code(self._scene, reduced, self._views, options, self._watch)
        return Found(encoded, options, self._note(kind, q, self._value(encoded.pieces)), [])

    def _adjust(self, reduced: Reduced, found: Found, last: bool) -> Found:
        """Come nearer to the aim with other quantiser steps, if that suffices or nothing else is left to do."""
        low, high = self._target.window
        q = found.options.q
        first, best = q, found
        for _ in range(2):
            if low <= best.value <= high:
                break
            # A fast entropy stage is off by much, but by much the same for all steps.
            error = best.value - self._quick_value(reduced.scene, best.options)

            def value(steps: float, error: float = error) -> float:
                return self._quick_value(reduced.scene, _with_steps(found.options, steps)) + error

            ends = (self._axis.quality(self._axis.fineness(q) + sign * _MOST_STEPS) for sign in (-1, 1))
            first, expected = _solve(value, self._target.aim, self._target, self._axis, first, *ends)
            if not (low <= expected <= high or last):
                break
            other = self._finish("steps", first, reduced, _with_steps(found.options, first))
            if self._rank(other) >= self._rank(best):
                break
            best = other
        return best

    def free(self) -> None:
        """Give all device memory back."""
        for owner in (self._survey, self._judge):
            if owner is not None:
                owner.free()


def _with_steps(options: EncodeOptions, q: float) -> EncodeOptions:
    """The options with the quantiser's parameters of another q, as far as they are not given on their own."""
    parameters = dataclasses.replace(options, q=q).parameters
    names = [field.name for field in dataclasses.fields(parameters)]
    steps = [name for name in names if name.startswith("sf_") or name in ("beta", "gamma")]
    return dataclasses.replace(options, **{name: getattr(parameters, name) for name in steps})


def _of_splats(weights: ViewWeights, splats: NDArray[np.int64]) -> ViewWeights:
    """The view weights of some of the splats, in their order."""
    counts = np.diff(weights.offsets)[splats]
    offsets = np.concatenate([[0], np.cumsum(counts)])
    entries = np.arange(offsets[-1]) + np.repeat(weights.offsets[splats] - offsets[:-1], counts)
    return ViewWeights(offsets, weights.views[entries], weights.weights[entries])


class _Axis:
    """Qualities by the logarithm of the quantiser's fineness: sizes and PSNR grow more evenly with it than with q."""

    def __init__(self, options: EncodeOptions) -> None:
        self._options = dataclasses.replace(options, sf_sh=None)

    def fineness(self, q: float) -> float:
        """Of a quality from 0 to 1."""
        return math.log(dataclasses.replace(self._options, q=q).parameters.sf_sh)

    def quality(self, fineness: float) -> float:
        """The nearest q from 0 to 1, rounded to what matters."""
        low, high = 0.0, 1.0
        for _ in range(20):
            middle = (low + high) / 2
            low, high = (middle, high) if self.fineness(middle) < fineness else (low, middle)
        return round(high if fineness > self.fineness(0) else 0.0, 5)


def _solve(
    value: Callable[[float], float],
    aim: float,
    target: Target,
    axis: _Axis,
    first: float,
    low: float = 0.0,
    high: float = 1.0,
    same: float = _SAME,
) -> tuple[float, float]:
    """The q at which a growing function meets the aim (``low`` or ``high`` if that lies beyond), and its value."""
    points: dict[float, float] = {}
    window = target.window
    tolerance = (window[1] - window[0]) / 4
    q = first
    for step in range(_STEPS):
        points[q] = value(q)
        if abs(points[q] - aim) <= tolerance:
            break
        below = [p for p in points if points[p] < aim]
        above = [p for p in points if points[p] >= aim]
        if below and above:
            a, b = max(below), min(above)
            if axis.fineness(b) - axis.fineness(a) < same:
                break  # or it does not grow everywhere: this is as near as it gets
            # Along a line, but now and then in the middle: where the curve bends, one of the two would stay for long.
            part = (aim - points[a]) / (points[b] - points[a]) if step % 3 < 2 else 0.5
            q = axis.quality(axis.fineness(a) + (axis.fineness(b) - axis.fineness(a)) * min(max(part, 0.05), 0.95))
        else:
            # Somewhat further than the slope tells, so that the aim comes to lie between two points, and ever further.
            nearest = max(below) if below else min(above)
            way = 1.1 * 2**step * (aim - points[nearest]) / target.slope
            q = min(max(axis.quality(axis.fineness(nearest) + math.copysign(max(abs(way), 0.05), way)), low), high)
        if q in points:
            break
    best = min(points, key=lambda p: abs(points[p] - aim))
    return best, points[best]
