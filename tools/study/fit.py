"""What a fit of all parameters buys: bytes and PSNR of whole encodes, by how far the scene is pruned before it.

    python -m tools.study.fit SCENE … [--courses COURSE … | --ladder Q …] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json. A course says what is done to it before the re-fit and the
coder: "q0.1/1000" prunes it as q = 0.1 would, and fits it in 1000 steps; "q0.3/500,q-0.1/1000" prunes, fits, prunes
what is left and fits again. What follows, "@0.3@0.5", are the qualities of the re-fit and the coder: the work before
them is done once for all. After a "+", options of the fit: "q0.1/1000+last=0.2@0.3", "+groups=means:dc" moves these
parameters only, "+between=3" has it look at three views between for each training view. "encode/1000@0.3" is an encode
as users have it, with --fit 1000: it removes more splats by itself and decides whether the fit pays;
"encode/1000+cycles=2@0.3" has other options of the stage. PSNR is the mean over the test views against the uncompressed
scene's renders; bytes at equal PSNR are against the scene without a fit at the --plain qualities, interpolated in the
logarithm of the bytes. PSNR before and after the fit are of what is not yet coded.

--ladder Q … measures instead what each part of the fit brings: encodes with all of it, then each time without one part;
--parts N … only some of these.

--fraction F takes all pictures smaller, --every N takes every N-th training view, and --iterations N prunes in fewer
iterations: for a CPU, not for publication. --limit S begins nothing new after so many seconds.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.camera import test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.stages.code import Code
from potr_cl.stages.fit import STEPS as FIT_STEPS
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import RATES
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import State
from potr_cl.stages.views_between import Between
from tools.results import Column, Results, Table
from tools.study.rate_distortion import size_at
from tools.workloads import read, scaled, scene_parser

#: How far each quality's scene is pruned: as this much less than its q would.
SHIFTS = (0.2, 0.4, 0.6)
QUALITIES = (0.3, 0.5, 0.7)
PLAIN = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
STEPS = FIT_STEPS["gpu"]
COLUMNS = (
    Column("scene"),
    Column("course"),
    Column("q", format="g"),
    Column("splats", format=",d"),
    Column("bytes", format=",d"),
    Column("PSNR", "dB", ".2f"),
    Column("before and after the fit", "dB", "{:.2f} / {:.2f}"),
    Column("bytes at equal PSNR", "%", "+.1f"),
    Column("prune", "s", ".2f"),
    Column("fit", "s", ".2f"),
    Column("re-fit and code", "s", ".2f"),
)


@dataclass(frozen=True)
class Course:
    """What is done to a scene.

    Attributes:
        text: as it was given, without the qualities.
        parts: by turns, the q whose threshold pruning takes, or None for that of the encode, and the steps of the fit.
        fit: further options of the fit.
        qualities: of the re-fit and the coder.
    """

    text: str
    parts: tuple[tuple[float | None, int], ...]
    fit: dict[str, Any]
    qualities: tuple[float, ...]

    @staticmethod
    def of(text: str) -> Course:
        """Read from a command line.

        Raises:
            ValueError: it is no course.
        """
        text, *qualities = text.split("@")
        steps, *changes = text.split("+")
        parts = [part.split("/") for part in steps.split(",")]
        options: dict[str, Any] = {}
        for change in changes:
            name, value = change.split("=")
            if name == "groups":
                options["rates"] = only(value.split(":"))
            else:
                options[name] = float(value) if "." in value else int(value)
        turns = tuple((None if q == "encode" else float(q.removeprefix("q")), int(n)) for q, n in parts)
        return Course(text, turns, options, tuple(map(float, qualities)))


def only(groups: Sequence[str]) -> Rates:
    """The fit's rates, but 0 for all parameters that are not named."""
    names = {each.name for each in dataclasses.fields(Rates)}
    if unknown := set(groups) - names:
        raise ValueError(f"the fit has no {', '.join(sorted(unknown))}: it has {', '.join(sorted(names))}")
    return _without(*(names - set(groups)))


def _without(*groups: str) -> Rates:
    """The fit's rates, but 0 for these parameters."""
    return dataclasses.replace(RATES, **dict.fromkeys(groups, 0.0))


#: Parts of the fit by what they are called: without them it has these options.
_PARTS: dict[str, dict[str, Any]] = {
    "everything": {},
    "coefficients chosen by the re-fit alone": {"choosing": 0.0},
    "shapes rounded at once": {"rounding": 0.0},
    "positions stay": {"rates": _without("means")},
    "scales stay": {"rates": _without("log_scales")},
    "rotations stay": {"rates": _without("quaternions")},
    "opacities stay": {"rates": _without("opacity_logits")},
    "colours stay": {"rates": _without("dc", "ac")},
    "steps of the quantiser as without a fit": {"finer": 0.0},
    "splats removed once, not twice": {"cycles": 1},
    "no splats removed for it": {"further": 0.0},
    "no views between of its own": {"between": 0},
}


def ladder(qualities: Sequence[float], numbers: Sequence[int] | None = None) -> list[Course]:
    """Encodes as users have them with a fit, and each time without one part of it; or some of them, by number."""
    courses = [Course(part, ((None, STEPS),), options, tuple(qualities)) for part, options in _PARTS.items()]
    return courses if numbers is None else [courses[number] for number in numbers]


def usual_courses() -> list[Course]:
    """Each quality with each shift; what is pruned alike is pruned once."""
    by_pruned: dict[float, list[float]] = {}
    for q in QUALITIES:
        for shift in SHIFTS:
            by_pruned.setdefault(round(q - shift, 3), []).append(q)
    return [Course.of(f"q{p:g}/{STEPS}" + "".join(f"@{q:g}" for q in qs)) for p, qs in sorted(by_pruned.items())]


def threshold(q: float, preset: Any) -> float:
    """ΔMSE_MAX as a quality has it, also beyond 0 and 1, where it goes on in the same way."""
    low, high = (HyperParameters.from_quality(end, preset).delta_mse_max for end in (0.0, 1.0))
    return float(low * (high / low) ** q)


@dataclass(frozen=True)
class _Fitted:
    """What a course has made of a scene: seconds, and PSNR before and after the last fit."""

    state: State
    prune: float
    fit: float
    psnrs: list[float] | None


class Bench(Owner):
    """One scene on one device.

    Args:
        folder: of the scene.
        device: to compute on.
        args: the command line.
    """

    def __init__(self, folder: Path, device: Device, args: argparse.Namespace) -> None:
        self.name = folder.resolve().name
        self._device = device
        self._options = EncodeOptions(preset=args.preset)
        if args.iterations:
            self._options = self._options.changed(prune={"iterations": args.iterations})
        self._scene, cameras = read(folder)
        cameras = [scaled(camera, args.fraction) if args.fraction != 1 else camera for camera in cameras]
        self._kept = KeptScene(device, self._scene)
        self._judge = Evaluator(device, self._scene, EvaluationViews.of(test_views(cameras)), (0.0, 0.0, 0.0))
        views = train_views(cameras)[:: args.every]
        self._start, _ = self._run(State.of(self._scene, views), self._options, [Between])
        self._plain: list[dict[str, Any]] = []

    def _run(self, state: State, options: EncodeOptions, only: Sequence[Any]) -> tuple[State, float]:
        began = time.perf_counter()
        state = Run(options, Stopwatch(), self._device, self._kept).stages(state, list(only))
        return state, time.perf_counter() - began

    def measure(self, course: Course, table: Table) -> None:
        """Encode, and put a row for each quality into the table."""
        known: _Fitted | None = None
        for q in course.qualities:
            if known is None or course.parts[0][0] is None:
                known = self._fitted(course, q)
            options = self._options.changed(q=q)
            if course.parts[0][0] is None:
                options = options.changed(fit={"steps": course.parts[0][1], **course.fit})
            coded, seconds = self._run(known.state, options, [Refit, Code])
            data = b"".join(coded.learnt["code"].pieces)
            found = {"bytes": len(data), "psnr": self._judge.psnr(decode(data, trust=True))}
            if known.psnrs is None:
                self._plain.append(found)
            same = size_at(self._plain, "psnr", found["psnr"]) if self._plain else None
            saved = 100 * (len(data) / same - 1) if same else None
            table.add(
                self.name, course.text, q, len(coded.scene), len(data), found["psnr"], known.psnrs, saved,
                known.prune, known.fit, seconds,
            )  # fmt: skip

    def _fitted(self, course: Course, q: float) -> _Fitted:
        state, prune, fit, psnrs = self._start, 0.0, 0.0, None
        for pruned_as, steps in course.parts:
            options = self._options.changed(q=q, fit={"steps": steps, **course.fit})
            if pruned_as is not None:
                options = options.changed(prune={"delta_mse_max": threshold(pruned_as, options.preset)})
            state, seconds = self._run(state, options, [Prune])
            prune += seconds
            if pruned_as is not None:  # the fit takes what it is given, and keeps what comes of it
                learnt = {name: each for name, each in state.learnt.items() if name != "price"}
                state = dataclasses.replace(state, learnt=learnt)
            if steps:
                before = self._judge.psnr(state.scene)
                state, seconds = self._run(state, options, [Fit])
                fit += seconds
                psnrs = [before, self._judge.psnr(state.scene)]
        return _Fitted(state, prune, fit, psnrs)

    def close(self) -> None:
        """Give the device's memory back."""
        self._judge.close()
        self._kept.close()


def main() -> None:
    parser = scene_parser(__doc__)
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--courses", nargs="+", type=Course.of, default=usual_courses())
    chosen.add_argument("--ladder", nargs="+", type=float, metavar="Q")
    parser.add_argument("--parts", nargs="+", type=int, metavar="N", help="of the ladder, from 0; all by default")
    parser.add_argument("--plain", nargs="*", type=float, default=PLAIN, metavar="Q")
    parser.add_argument("--preset", default="best")
    parser.add_argument("--fraction", type=float, default=1.0, metavar="F")
    parser.add_argument("--every", type=int, default=1, metavar="N")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--limit", type=float, default=np.inf, metavar="SECONDS")
    args = parser.parse_args()
    device = Device(args.device)
    name, title = "courses", "Whole encodes with a fit of all parameters"
    if args.ladder:
        name, title = "ladder", "What each part of the fit brings: whole encodes with all of it, and without one part"
    table = Results(device.info, args.json).table(name, title, *COLUMNS)
    began = time.perf_counter()
    with ExitStack() as stack:
        benches = [stack.enter_context(Bench(folder, device, args)) for folder in args.scenes]
        plain = [Course.of(f"q{q:g}/0@{q:g}") for q in args.plain]
        for course in [*plain, *(ladder(args.ladder, args.parts) if args.ladder else args.courses)]:
            for bench in benches:
                if time.perf_counter() - began > args.limit:
                    return
                bench.measure(course, table)


if __name__ == "__main__":
    main()
