"""How fast are the fit's steps?

    python -m tools.bench.fit SCENE … [--keep 0.35] [--steps 200] [--device NAME] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json. Its splats are pruned to a part (or, with --every, every so
many are taken, which takes no time), and the fit's steps look at the training views: steps a second, by views a step,
and what the device does in that time, kernel by kernel. tools.stress.run measures how exact the derivatives are.

Times are the clock's on GPUs, and of processors together on CPUs, which other work may share.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import numpy as np

from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.adam import Adam, Limits, Rates
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.fitting.fit import batches
from potr_cl.views.targets import RenderedTargets, Room, TargetPictures
from tools.results import Column, Results
from tools.workloads import in_turn, read, reduced, scene_parser

#: Steps so small that the scene, and with it the work, stays what it is.
_RATES = Rates(1e-9, 1e-9, 1e-9, 1e-9, 1e-9, 1e-9)
_LIMITS = Limits((-200.0, 200.0), (-200.0, 200.0))
#: Kernels by what they are part of; all others prepare views.
_PARTS = {"derivatives": "sums over pixels", "chain": "to parameters", "adam": "step", "activate": "step"}
#: Repetitions that times are the least of.
_REPEATS = 3


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--keep", type=float, default=0.35, help="part of the splats (default %(default)s)")
    parser.add_argument("--every", type=int, help="take every so many of the splats instead of pruning")
    parser.add_argument("--steps", type=int, default=200, help="that are timed (default %(default)s)")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 16], help="views a step")
    parser.add_argument("--views", type=int, help="the first so many training views only")
    args = parser.parse_args()
    device = Device(args.device, profiling=True)
    plain = Device(args.device)
    results = Results(device.info, args.json)
    parts = ("views", *dict.fromkeys(_PARTS.values()))
    steps = results.table(
        "steps", "Steps of the fit", "scene; splats||,d; pixels of a view||,d; views a step; steps a second||.1f",
        *(Column(f"of a step: {part}", "ms", ".2f") for part in parts),
    )  # fmt: skip
    for folder in args.scenes:
        scene, cameras = read(folder)
        train = train_views(cameras)[: args.views]
        load = scene, _left(scene, train, args, plain), train
        for batch in args.batches:
            steps.add(
                folder.name, len(load[1]), train[0].width * train[0].height, batch,
                *_steps(plain, device, load, batch, args.steps),
            )  # fmt: skip


Load = tuple[Scene, Scene, list[Camera]]


def _left(scene: Scene, train: Sequence[Camera], args: argparse.Namespace, device: Device) -> Scene:
    if args.every:
        return scene.subset(np.arange(0, len(scene), args.every))
    count = round(args.keep * len(scene))
    changes = {"prune": {"count": count}, "compact": False, "refit": False, "between": {"views": 0}}
    return reduced(scene, train, EncodeOptions.for_preset("fast", **changes), device).scene


def _least(device: Device, work: Callable[[], None]) -> float:
    """Seconds of some work, after a run that is not counted."""

    def whole() -> None:
        work()
        device.queue.finish()

    return min(in_turn({"": whole}, _REPEATS)[""][device.info.kind == "cpu"])


def _steps(plain: Device, profiled: Device, load: Load, batch: int, count: int) -> tuple[float, ...]:
    """Steps a second without profiling, and milliseconds a step of each part of the device's work with it."""
    scene, left, train = load
    count = max(count // batch, 1)
    found: dict[str, float] = {}
    rate = 0.0
    for device in (plain, profiled):
        with (
            Rasterizer(device, scene) as whole,
            PictureDerivatives(device, left) as derivatives,
            TargetPictures(device, train, Room(8e9), RenderedTargets(whole, train)) as pictures,
            Adam(device, left, derivatives.rasterizer.parameters, derivatives.columns, _RATES, _LIMITS) as adam,
        ):
            for number in range(len(train)):
                pictures.of([number])
            order = batches(range(len(train)), batch, 0)

            def some(steps: int) -> None:
                for _ in range(steps):
                    numbers = next(order)  # noqa: B023 (called before the loop goes on)
                    derivatives.add([train[n] for n in numbers], pictures.of(numbers), unit=8.0)
                    adam.step(derivatives.gradient, 1.0)

            if device is plain:
                rate = count / _least(device, lambda: some(count))
                continue
            some(1)
            device.queue.finish()
            device.stage_times()
            some(count)
            device.queue.finish()
            for name, seconds in device.stage_times().items():
                part = _PARTS.get(name, "views")
                found[part] = found.get(part, 0.0) + 1e3 * seconds / count
    return rate, *(found.get(part, 0.0) for part in ("views", *dict.fromkeys(_PARTS.values())))


if __name__ == "__main__":
    main()
