"""Run time against error of all stages, on every OpenCL device.

    python -m tools.bench.encode [SCENE …] [--device NAME] [--quick] [--stage NAME …] [--json FILE]

For each stage of kernels the variants that exist: kernel family, compiler flags, precision, steps; each with its time
on a scene and its error: what tools.stress.run measures, in a few of its cases. (Whole encodes of any options:
tools.study.rate_distortion; entropy coders: tools.bench.codec.) A variant is on the Pareto front if no other of its
stage is at least as good in time and error and better in one by more than 5 %, the noise. Scenes: lego and plush by
default; --quick takes the bundled excerpt at half size and the best device.

Every device runs in a process of its own. Times of the rasterizer's kernels and of the ridge are the device's own, the
others the clock's. Each is the best of some.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import get_args

import numpy as np

from potr_cl.model.camera import Camera, camera_centres, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, Family, choose_device, list_devices
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor, Precision
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views.targets import RenderedTargets
from tests.reference.scenes import random_splats, tilted_camera
from tools.bench.rasterizer import stage_times
from tools.results import Results
from tools.stress.cases import Case, layered
from tools.stress.platforms import families
from tools.stress.solvers import ridge_errors
from tools.stress.views import check_rasterizer
from tools.workloads import SCENES, best_of, excerpt, in_process, log, read, scaled, scene_parser

#: Part by which a time or an error must be lower to be lower.
NOISE = 0.05
#: Compiler flags that trade accuracy for speed.
FLAGS: Mapping[str, tuple[str, ...]] = {
    "no flags": (),
    "mad": ("-cl-mad-enable",),
    "no signed zeros": ("-cl-no-signed-zeros",),
    "flush denormals": ("-cl-denorms-are-zero",),
    "unsafe": ("-cl-unsafe-math-optimizations",),
    "fast relaxed": ("-cl-fast-relaxed-math",),
}
#: What errors of kernels are measured in: many splats, and many layers over each other.
CASES = (
    Case("400 splats", random_splats(400, 3, seed=1), tilted_camera(1, 83, 61)),
    dataclasses.replace(layered(100), rules=GSPLAT),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """One variant of one stage: its time and its error (STAGES).

    Attributes:
        default: whether this is what the package does on this device.
    """

    stage: str
    variant: str
    seconds: float
    error: float
    default: bool = False


def on_front(row: Row, rows: Sequence[Row]) -> bool:
    """Whether no other variant is at least as good in both and, beyond what is noise, better in one."""
    pairs = [((other.seconds, row.seconds), (other.error, row.error)) for other in rows]
    return not any(all(a <= b for a, b in p) and any(a < b / (1 + NOISE) for a, b in p) for p in pairs)


@dataclasses.dataclass
class Workload:
    """A scene on a device, and how much of it is enough.

    Attributes:
        train: views. some: of those, the ones that kernels are measured on.
        repeats: of every measurement; the best counts.
    """

    info: DeviceInfo
    scene: Scene
    train: list[Camera]
    quick: bool

    @staticmethod
    def of(info: DeviceInfo, folder: Path, quick: bool) -> Workload:
        scene, cameras = read(folder)
        cameras = [scaled(camera, 0.5) for camera in cameras] if quick else cameras
        return Workload(info, scene, train_views(cameras), quick)

    @property
    def some(self) -> list[Camera]:
        count = 2 if self.quick else 5
        return self.train[:: max(len(self.train) // count, 1)][:count]

    @property
    def repeats(self) -> int:
        return 3 if self.quick else 7

    def profiled(self, family: Family, flags: Sequence[str] = ()) -> Device:
        """A device whose kernels are timed, with compiler flags."""
        return Device(self.info, profiling=True, family=family, build_options=flags)

    def flagged(self, family: Family) -> Iterator[tuple[str, bool, Device]]:
        """Compiler flags: name, whether they are the default, device."""
        for name, flags in FLAGS.items():
            if not self.quick or name in ("no flags", "mad", "fast relaxed"):
                yield f"{family}, {name}", family == self.info.family and not flags, self.profiled(family, flags)


# ----------------------------------------------------------------------------------------------------- kernels

#: The kernels of each stage, and the measure of its error.
KERNELS = {
    "project": (("project",), "project: alpha"),
    "tile lists": (("count_tiles", "scan_tiles", "fill_tiles"), "tile lists"),
    "sort": (("sort_tiles",), "sort"),
    "composite": (("composite", "composite_frame"), "composite"),
}


def view_rows(load: Workload) -> Iterator[Row]:
    """What a view needs, and a sweep of removal over it: family and flags."""
    for name, default, device in (each for family in families(load.info) for each in load.flagged(family)):
        found = [check_rasterizer(device, case)[0] for case in CASES]
        errors = {measure: max(each[measure][0] for each in found) for measure in found[0]}
        runs = [stage_times(device, load.scene, load.some) for _ in range(load.repeats)]
        for stage, (kernels, measure) in KERNELS.items():
            seconds = sum(min(run.get(kernel, 0.0) for run in runs) for kernel in kernels)
            yield Row(stage, name, seconds, errors[measure], default)
        with Rasterizer(device, load.scene) as rasterizer, RemovalSweep(rasterizer, load.some[:1]) as removal:

            def sweep(removal: RemovalSweep = removal) -> None:
                removal.sweep_everything()
                removal.measure()

            yield Row("removal", name, best_of(load.repeats, sweep), errors["removal: effect"], default)


def ridge_rows(load: Workload) -> Iterator[Row]:
    """Precision of the least squares, and family."""
    views = load.train if load.quick else load.train[::2]
    chosen = np.random.default_rng(0).permutation(len(load.scene))[: 500 if load.quick else 20_000]
    scene, centres = load.scene.subset(np.sort(chosen)), camera_centres(views)
    with Rasterizer(Device(load.info), scene) as rasterizer, RemovalSweep(rasterizer, views) as sweep:
        sweep.measure()
        weights = ViewWeights.from_importances(len(scene), sweep.view_importances())
    for family in families(load.info):
        device = load.profiled(family)
        for precision in get_args(Precision):
            # λ 0.01 and no column dropped: as hard as it gets.
            options = CompactionOptions(lam=0.01, alpha=1, precision=precision)
            compactor, best = Compactor(device), math.inf
            for _ in range(load.repeats + 1):
                device.stage_times()
                compacted = compactor.compact(scene, centres, weights, options)
                best = min(best, device.stage_times()["compact"])
            errors = ridge_errors(scene, compacted, centres, weights, options)
            default = precision == CompactionOptions.precision and family == load.info.family
            error = float(np.quantile(errors, 0.9999))
            yield Row("ridge", f"{family}, {precision}", best * 1e6 / len(scene), error, default)


def refit_rows(load: Workload) -> Iterator[Row]:
    """Steps of conjugate gradients, and family, on the more important half of the splats."""
    views = load.train if load.quick else load.train[:: max(len(load.train) // 16, 1)]
    with Rasterizer(Device(load.info), load.scene) as rasterizer, RemovalSweep(rasterizer, views) as removal:
        importance = removal.measure()[1]
    kept = load.scene.subset(np.sort(np.argsort(importance)[len(importance) // 2 :]))
    default = EncodeOptions.for_preset("best").refit.steps_on(load.info.family)
    for family in families(load.info)[: 1 if load.quick else 2]:
        device = Device(load.info, family=family)
        with Rasterizer(device, load.scene) as rasterizer:
            targets = RenderedTargets(rasterizer, views)
            for steps in (0, 1, 2, 4, 6, 12, 16) if load.quick else (0, 1, 2, 4, 6, 8, 12, 16, 32, 64):
                errors: list[float] = []

                def work(device: Device = device, targets: RenderedTargets = targets, steps: int = steps) -> None:
                    refitted = refit_colours(device, kept, views, targets, RefitOptions(steps=steps, gain=0))
                    errors.append(math.sqrt(refitted.errors[1]))  # noqa: B023 (called before the loop goes on)

                is_default = family == load.info.family and steps == default
                yield Row("re-fit", f"{family}, {steps} steps", best_of(1, work), errors[-1], is_default)


#: By stage: what the time is of, what the error is, and what measures it.
STAGES: dict[str, tuple[str, str, Callable[[Workload], Iterator[Row]]]] = {
    "project": ("a view's projection", "largest error of a splat's alpha", view_rows),
    "tile lists": ("a view's tile lists", "255 alpha - 1 of what a list lacks", view_rows),
    "sort": ("a view's depth sort", "intersections out of order", view_rows),
    "composite": ("a view's compositing", "largest error of a pixel", view_rows),
    "removal": ("a sweep over all tiles of a view", "largest relative error of ΔMSE", view_rows),
    "ridge": ("the kernel, a million splats", "colour error above the optimum, 99.99th percentile", ridge_rows),
    "re-fit": ("the solver", "RMS error on training views", refit_rows),
}


def run(index: int, folder: Path, quick: bool, stages: Sequence[str]) -> list[Row]:
    """Some stages on one device and scene."""
    load = Workload.of(list_devices()[index], folder, quick)
    rows: list[Row] = []
    for work in dict.fromkeys(STAGES[stage][2] for stage in stages):
        rows += work(load)
        log(f"{folder.name}: {work.__name__} done")
    return [row for row in rows if row.stage in stages]


def report(results: Results, title: str, rows: Sequence[Row]) -> None:
    """A table a stage."""
    for stage, (what, error, _) in STAGES.items():
        own = [row for row in rows if row.stage == stage]
        if own:
            columns = f"variant; seconds of {what}||.3g; {error}||.3g; default; on the Pareto front"
            table = results.table(f"{title}: {stage}", f"{title}: {stage}", columns)
            for row in sorted(own, key=lambda r: r.seconds):
                marks = ["yes" if mark else "" for mark in (row.default, on_front(row, own))]
                table.add(row.variant, row.seconds, row.error, *marks)


def main() -> None:
    parser = scene_parser(__doc__, "*")
    parser.add_argument("--quick", action="store_true", help="the excerpt at half size, fewer variants")
    parser.add_argument("--stage", action="append", choices=tuple(STAGES), dest="stages")
    args = parser.parse_args()
    infos = [choose_device(args.device)] if args.device or args.quick else list_devices()
    results = Results(infos[0], args.json)
    with tempfile.TemporaryDirectory() as scratch:
        folders = args.scenes or ([] if args.quick else list(filter(Path.exists, (SCENES / "lego", SCENES / "plush"))))
        for folder in folders or [excerpt(Path(scratch) / "excerpt")]:
            for info in infos:
                title = f"{folder.name}, {info}"
                try:
                    rows = in_process(run, info.index, folder, args.quick, args.stages or list(STAGES))
                    report(results, title, rows)
                except BrokenProcessPool:
                    print(f"\n{title}: the process has ended")


if __name__ == "__main__":
    main()
