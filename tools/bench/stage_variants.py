"""The variants of every stage with their times and errors (:func:`measure`), for tools.bench.encode."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, camera_centres, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, Family
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor, Precision
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.refitting.targets import RenderedTargets
from tests.reference import raster as reference
from tests.reference.removal import BruteForce
from tools.bench.pruning import Bench, skips
from tools.bench.tradeoffs import Row
from tools.workloads import best_of, scaled

F64 = NDArray[np.float64]

#: Compiler flags that trade accuracy for speed.
FLAGS: Mapping[str, tuple[str, ...]] = {
    "no flags": (),
    "mad": ("-cl-mad-enable",),
    "no signed zeros": ("-cl-no-signed-zeros",),
    "flush denormals": ("-cl-denorms-are-zero",),
    "unsafe": ("-cl-unsafe-math-optimizations",),
    "fast relaxed": ("-cl-fast-relaxed-math",),
}
#: Keys that a GPU's work-group sorts in local memory at a time; 2048 is the default.
CAPACITIES = (1024, 2048, 4096)
#: Pixels of a view, and splats, that are computed in float64.
PIXELS, SPLATS = 300, 150
#: As in the tests: pixels that come no nearer, relatively, to a threshold cannot flip, nor splats in another order.
CLEAR, TIE = 1e-4, 1e-6


def measure(info: DeviceInfo, load: Workload, quick: bool, stages: Sequence[str]) -> Iterator[Row]:
    """Every stage asked for, one after the other."""
    work: dict[str, Callable[[], Iterator[Row]]] = {
        "removal": lambda: removal_rows(info, load, quick),
        "prune": lambda: prune_rows(info, load, quick),
        "ridge": lambda: ridge_rows(info, load, quick),
        "re-fit": lambda: refit_rows(info, load, quick),
        "encode": lambda: encode_rows(info, load, quick),
    }
    if {"project", "tile lists", "sort", "composite"} & set(stages):
        yield from rasterizer_rows(info, load, quick, stages)
    if {"code", "decode"} & set(stages):
        yield from (row for row in code_rows(load, quick) if row.stage in stages)
    for stage, rows in work.items():
        if stage in stages:
            started = time.perf_counter()
            yield from rows()
            print(f"{stage}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)


def profiled(info: DeviceInfo, family: Family, flags: Sequence[str] = (), **macros: int) -> Device:
    """A device whose kernels are timed, with compiler flags and other values of the kernels' macros."""
    return Device(info, profiling=True, family=family, build_options=flags, macros=macros)


@dataclasses.dataclass
class Workload:
    """A scene and how much of it is enough.

    Attributes:
        train, test: views.
        views: of those, how many the kernels are measured on.
        repeats: of every measurement; the best counts.
        pruning: iterations of the schedule.
    """

    folder: Path
    scene: Scene
    train: list[Camera]
    test: list[Camera]
    views: int
    repeats: int
    pruning: int

    @staticmethod
    def of(folder: Path, quick: bool) -> Workload:
        """A scene's folder, or the excerpt's files put into one."""
        cameras = load_cameras(folder / "cameras.json")
        if quick:
            cameras = [scaled(camera, 0.5) for camera in cameras]
        train, test = train_views(cameras), test_views(cameras)
        scene = load_scene(folder / "point_cloud.ply")
        return Workload(folder, scene, train, test, 2 if quick else 5, 3 if quick else 7, 8 if quick else 48)

    @property
    def some(self) -> list[Camera]:
        """The views that kernels are measured on."""
        return self.train[:: max(len(self.train) // self.views, 1)][: self.views]


def families(info: DeviceInfo) -> tuple[Family, ...]:
    """The device's own kernel family first."""
    return ("cpu", "gpu") if info.family == "cpu" else ("gpu",)


def rasterizer_times(device: Device, load: Workload) -> dict[str, float]:
    """Seconds a view of every kernel: the best of some passes over the views."""
    with Rasterizer(device, load.scene, GSPLAT) as rasterizer:
        best: dict[str, float] = {}
        for number in range(load.repeats + 1):
            device.stage_times()
            for camera in load.some:
                rasterizer.render_device(camera)
            times = device.stage_times()
            if number:
                best = {
                    name: min(seconds / len(load.some), best.get(name, math.inf)) for name, seconds in times.items()
                }
    return best


def kernel_variants(info: DeviceInfo, quick: bool) -> Iterator[tuple[str, bool, Device]]:
    """Family and flags; on GPU kernels also the sort's capacity and their own exponential."""
    for family in families(info):
        for name, flags in FLAGS.items():
            if quick and name not in ("no flags", "mad", "fast relaxed"):
                continue
            yield f"{family}, {name}", family == info.family and not flags, profiled(info, family, flags)
        if family == "gpu":
            for capacity in CAPACITIES:
                if capacity != 2048 and 8 * capacity <= info.local_memory:
                    device = profiled(info, family, SORT_CAPACITY=capacity)
                    yield f"{family}, sorts {capacity} at a time", False, device
            default = profiled(info, family).native_exp2
            name = "polynomial" if default else "native exponential"
            yield f"{family}, {name}", False, profiled(info, family, NATIVE_EXP2=int(not default))


class RasterizerTruth:
    """One view in float64: splats on screen, and some pixels."""

    def __init__(self, load: Workload) -> None:
        self.camera = load.some[0]
        self.projected = reference.project(load.scene, self.camera, GSPLAT)
        rng = np.random.default_rng(0)
        self.pixels: list[tuple[int, int, F64]] = []
        for _ in range(4 * PIXELS):
            column, row = int(rng.integers(self.camera.width)), int(rng.integers(self.camera.height))
            pixel = reference.composite_pixel(self.projected, column, row, GSPLAT)
            if pixel.margin > CLEAR and pixel.gap > TIE:
                self.pixels.append((column, row, np.append(pixel.colour, pixel.transmittance)))
            if len(self.pixels) == PIXELS:
                break

    def errors(self, device: Device, scene: Scene) -> tuple[float, float, float, set[bytes]]:
        """Of centres, of order, of pixels; and the tile lists as a set."""
        with Rasterizer(device, scene, GSPLAT) as rasterizer, rasterizer.prepare(self.camera) as view:
            shapes = device.download(view.shapes, (rasterizer.stride, 8), np.float32)
            offsets = device.download(view.offsets, (view.tiles + 1,), np.uint32).astype(np.int64)
            intersections = device.download(view.intersections, (view.intersection_count,), np.uint32)
            image, transmittance = rasterizer.composite(view)
        listed = np.isin(self.projected.index, intersections)
        centres = np.abs(shapes[self.projected.index[listed], :2] - self.projected.centre[listed])
        inside = (self.projected.centre[listed] >= 0).all(axis=1)
        inside &= (self.projected.centre[listed] < (self.camera.width, self.camera.height)).all(axis=1)
        tiles = np.repeat(np.arange(view.tiles), np.diff(offsets))
        order = np.lexsort((intersections, shapes[intersections, 6], tiles))
        wrong = int(np.count_nonzero(intersections[order] != intersections))
        ours = np.concatenate([image, transmittance[..., None]], axis=2).astype(np.float64)
        pixel = max((float(np.abs(ours[row, column] - true).max()) for column, row, true in self.pixels), default=0.0)
        pairs = {pair.tobytes() for pair in np.stack([tiles, intersections], axis=1)}
        return float(centres[inside].max(initial=0)), wrong, pixel, pairs


def rasterizer_rows(info: DeviceInfo, load: Workload, quick: bool, stages: Sequence[str]) -> Iterator[Row]:
    """All kernels of the rasterizer."""
    truth = RasterizerTruth(load)
    first: set[bytes] | None = None
    kernels = {
        "project": ("project",),
        "tile lists": ("count_tiles", "scan_tiles", "fill_tiles"),
        "sort": ("sort_tiles",),
        "composite": ("composite", "composite_frame"),
    }
    for name, default, device in kernel_variants(info, quick):
        times = rasterizer_times(device, load)
        centre, wrong, pixel, pairs = truth.errors(device, load.scene)
        first = pairs if first is None else first
        errors = {"project": centre, "tile lists": len(first ^ pairs), "sort": wrong, "composite": pixel}
        for stage, parts in kernels.items():
            # A variant stands in the tables of the kernels that it changes.
            about = {"sorts": "sort", "polynomial": "composite", "native exponential": "composite"}
            only = next((kernel for word, kernel in about.items() if word in name), stage)
            if stage in stages and stage == only:
                yield Row(
                    stage, name, sum(times[part] for part in parts if part in times), float(errors[stage]), default
                )


def removal_rows(info: DeviceInfo, load: Workload, quick: bool) -> Iterator[Row]:
    """Family, flags, and where pixels end."""
    camera = load.some[0]
    flags = ("no flags", "mad", "fast relaxed") if quick else tuple(FLAGS)
    default = SweepOptions()
    # What each sweep is compared with ends its pixels in the same place.
    thresholds = sorted(
        {INRIA.transmittance_threshold, default.transmittance_threshold or INRIA.transmittance_threshold}, reverse=True
    )
    variants: list[tuple[str, bool, Device, SweepOptions]] = []
    for family in families(info):
        own = family == info.family
        for name in flags:
            flagged = profiled(info, family, FLAGS[name])
            variants.append((f"{family}, {name}", own and name == "no flags", flagged, default))
        plain = profiled(info, family)
        for threshold in thresholds:
            if threshold != (default.transmittance_threshold or INRIA.transmittance_threshold):
                ends = dataclasses.replace(default, transmittance_threshold=threshold)
                variants.append((f"{family}, pixels end at {threshold:.0e}", False, plain, ends))
    with Rasterizer(variants[0][2], load.scene) as rasterizer, RemovalSweep(rasterizer, [camera]) as removal:
        chosen = choose_splats(removal.measure()[1], SPLATS // 3 if quick else SPLATS)
    brute = BruteForce(reference.project(load.scene, camera, INRIA), camera, INRIA)
    truths = dict(zip(thresholds, brute.effects(chosen, thresholds)[0], strict=True))
    for label, is_default, device, options in variants:
        with Rasterizer(device, load.scene) as rasterizer, RemovalSweep(rasterizer, [camera], options) as removal:
            effect = removal.measure()[0][chosen]
            best = math.inf
            for _ in range(load.repeats):
                removal.sweep_everything()
                started = time.perf_counter()
                removal.measure()
                best = min(best, time.perf_counter() - started)
        true = truths[options.transmittance_threshold or INRIA.transmittance_threshold] / (
            3 * camera.width * camera.height
        )
        seen = true > 0
        error = float(np.median(np.abs(effect[seen] / true[seen] - 1)))
        yield Row("removal", label, best, error, is_default)


def choose_splats(importance: F64, count: int) -> NDArray[np.int64]:
    """About ``count`` splats that the views see, evenly over the logarithm of importance."""
    seen = np.flatnonzero(importance > 0)
    by_importance = seen[np.argsort(importance[seen], kind="stable")]
    low, high = np.log(importance[by_importance[[len(seen) // 100, -1]]])
    at = np.searchsorted(np.log(importance[by_importance]), np.linspace(low, high, count))
    return np.unique(by_importance[at.clip(0, len(seen) - 1)])


def prune_rows(info: DeviceInfo, load: Workload, quick: bool) -> Iterator[Row]:
    """What the schedule may skip, see tools.bench.pruning."""
    with Bench(load.folder, Device(info), quick, truth=False) as bench:
        default = SweepOptions()
        for row in skips(bench, (load.pruning, load.pruning // 2)):
            is_default = row["skipped"] == f"tolerance {default.tolerance:g}"
            error = 10 ** (-row["psnr_at_equal_count"] / 20)
            yield Row("prune", row["skipped"], row["seconds"], error, is_default)


def ridge_errors(scene: Scene, compacted: Scene, centres: F64, weights: Any, options: CompactionOptions) -> F64:
    """(K, 3) weighted colour errors above the optimum over the coefficients left free, of the splats that are seen.

    Relative to the largest coefficient or 1.
    """
    from tests.reference.ridge import YCOCG, Ridges, triangles  # needs scipy

    before, after = scene.sh @ YCOCG.T, compacted.sh @ YCOCG.T
    largest = np.maximum(np.abs(before).max(axis=1), 1)
    squares = np.add.reduceat(np.append(weights.weights.astype(np.float64) ** 2, 0), weights.offsets[:-1])
    errors = []
    for splats, triangle in triangles(scene.means.astype(np.float64), centres, weights, scene.sh_degree):
        found = np.zeros((len(splats), 3))
        for c in range(3):
            used = np.abs(after[splats, :, c]) > 1e-6 * np.abs(compacted.sh[splats]).max(axis=(1, 2))[:, None]
            used[:, 0] = True
            lam = options.lam * (options.chroma_factor if c else 1)
            excess = Ridges(triangle, before[splats, :, c], used, lam).excess(after[splats, :, c])[0]
            kept = np.isclose(after[splats, 1:, c], before[splats, 1:, c], rtol=1e-5, atol=1e-7).all(axis=1)
            found[:, c] = np.where(kept, 0, np.sqrt(excess / squares[splats]) / largest[splats, c])
        errors.append(found)
    return np.concatenate(errors)


def measured_weights(device: Device, scene: Scene, cameras: Sequence[Camera]) -> ViewWeights:
    """How much each splat shows in each view."""
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras) as sweep:
        sweep.measure()
        return ViewWeights.from_importances(len(scene), sweep.view_importances())


def ridge_rows(info: DeviceInfo, load: Workload, quick: bool) -> Iterator[Row]:
    """Precision of the least squares, and family."""
    views = load.train if quick else load.train[::2]
    chosen = np.random.default_rng(0).permutation(len(load.scene))[: 500 if quick else 20_000]
    scene, centres = load.scene.subset(np.sort(chosen)), camera_centres(views)
    weights = measured_weights(Device(info), scene, views)
    for family in families(info):
        device = profiled(info, family)
        for precision in get_args(Precision):
            # λ 0.01 and no column dropped: as hard as it gets.
            options = CompactionOptions(lam=0.01, alpha=1, precision=precision)
            compactor = Compactor(device)
            best = math.inf
            for _ in range(load.repeats + 1):
                device.stage_times()
                compacted = compactor.compact(scene, centres, weights, options)
                best = min(best, device.stage_times()["compact"])
            errors = ridge_errors(scene, compacted, centres, weights, options)
            default = precision == CompactionOptions.precision and family == info.family
            seconds = best * 1e6 / len(scene)
            yield Row("ridge", f"{family}, {precision}", seconds, float(np.quantile(errors, 0.9999)), default)


def refit_rows(info: DeviceInfo, load: Workload, quick: bool) -> Iterator[Row]:
    """Steps of conjugate gradients, and family, on the more important half of the splats."""
    views = load.train if quick else load.train[:: max(len(load.train) // 16, 1)]
    device = Device(info)
    with Rasterizer(device, load.scene) as rasterizer, RemovalSweep(rasterizer, views) as removal:
        importance = removal.measure()[1]
    kept = load.scene.subset(np.sort(np.argsort(importance)[len(importance) // 2 :]))
    default = EncodeOptions.for_preset("best").refit.steps
    for family in families(info)[: 1 if quick else 2]:
        device = Device(info, family=family)
        with Rasterizer(device, load.scene) as rasterizer:
            targets = RenderedTargets(rasterizer, views)
            for steps in (0, 1, 2, 4, 8, 16) if quick else (0, 1, 2, 4, 8, 16, 32, 64):
                options = RefitOptions(steps=steps, gain=0)
                times = []
                for _ in range(2):  # the first builds the kernels
                    started = time.perf_counter()
                    refitted = refit_colours(device, kept, views, targets, options)
                    times.append(time.perf_counter() - started)
                error = math.sqrt(refitted.errors[1])
                yield Row(
                    "re-fit", f"{family}, {steps} steps", times[-1], error, family == info.family and steps == default
                )


def code_rows(load: Workload, quick: bool) -> Iterator[Row]:
    """Entropy coders and levels, and decoding what they made."""
    coders = [*(EntropyCoder("zstd", level) for level in (1, 9, 19, 22)), EntropyCoder()]
    for coder in coders:
        parameters = EncodeOptions.for_preset("best" if coder.name == "bundles" else "paper").parameters
        coded = code_scene(load.scene, parameters, load.train, entropy=coder)
        data = b"".join(coded.pieces)
        name = f"{coder.name} {coder.level}" if coder.name == "zstd" else coder.name
        for stage, work in (
            ("code", lambda c=coder, p=parameters: code_scene(load.scene, p, load.train, entropy=c)),
            ("decode", lambda d=data: decode(d)),
        ):
            seconds = best_of(1 if stage == "code" else load.repeats, work)
            yield Row(stage, name, seconds, len(data), coder == EncodeOptions.for_preset("best").code.coder)


def encode_rows(info: DeviceInfo, load: Workload, quick: bool) -> Iterator[Row]:
    """Presets, iterations, stages left out: time, bytes and PSNR over the test views."""
    device = Device(info)
    variants: dict[str, dict[str, Any]] = {
        "paper": {"preset": "paper"},
        "fast": {"preset": "fast"},
        "best": {"preset": "best"},
        "paper, 12 iterations": {"preset": "paper", "prune": {"iterations": 12}},
        "paper, 4 iterations": {"preset": "paper", "prune": {"iterations": 4}},
        "paper, every removal effect anew": {"preset": "paper", "prune": {"tolerance": -1}},
        "paper, no compaction": {"preset": "paper", "compact": False},
        "paper, no pruning": {"preset": "paper", "prune": False},
        "paper, neither": {"preset": "paper", "prune": False, "compact": False},
        "paper, re-fit of 8 steps": {"preset": "paper", "refit": {"steps": 8}},
        "best, re-fit of 4 steps": {"preset": "best", "refit": {"steps": 4}},
        "best, re-fit of 16 steps": {"preset": "best", "refit": {"steps": 16}},
    }
    with Evaluator(device, load.scene, EvaluationViews.of([*load.train, *load.test]), (0.0, 0.0, 0.0)) as evaluator:
        for number, (name, changes) in enumerate(variants.items()):
            options = EncodeOptions.for_preset(**changes)
            for _ in range(2 if quick or number == 0 else 1):  # the first builds the kernels
                started = time.perf_counter()
                encoded = encode(load.scene, load.train, options, device=device)
                seconds = time.perf_counter() - started
            psnr = evaluator.psnr(decode(b"".join(encoded.pieces)))
            yield Row("encode", name, seconds, 10 ** (-psnr / 20), name == "best", encoded.nbytes)
