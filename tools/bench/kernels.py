"""Processor time of each kernel of a pruning and of a re-fit.

    python -m tools.bench.kernels SCENE …

For CPU devices on machines that do other work too: a launch's time is that of the process, and of REPEATS runs of the
same work the least. Each SCENE is a folder with point_cloud.ply and cameras.json. Prints Markdown: milliseconds a
launch, which is one view or, of vectors, all of them.
"""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import Kernel
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions, prune
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.refitting.targets import RenderedTargets
from tools.results import Column, Results
from tools.workloads import read, scene_parser

ITERATIONS = 8
DELTA_MSE_MAX = 1e-9
STEPS = 4
REPEATS = 3


class TimedDevice(Device):
    """A device that waits for each launch.

    Attributes:
        launches: kernel and seconds of the process, in their order.
    """

    def __init__(self, spec: str | None) -> None:
        self.launches: list[tuple[str, float]] = []
        super().__init__(spec)

    def launch(
        self,
        kernel: Kernel,
        items: tuple[int, ...],
        group: tuple[int, ...] | None = None,
        queue: cl.CommandQueue | None = None,
    ) -> None:
        (queue or self.queue).finish()
        start = time.process_time()
        super().launch(kernel, items, group, queue)
        (queue or self.queue).finish()
        self.launches.append((kernel.name, time.process_time() - start))


def pruning(device: Device, scene: Scene, cameras: list[Camera]) -> Scene:
    """Prune; what is left."""
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras, SweepOptions()) as removal:
        pruned = prune(removal, len(scene), PruningOptions(DELTA_MSE_MAX, ITERATIONS))
    return scene.subset(pruned.survivors)


def refit(device: Device, scene: Scene, left: Scene, cameras: list[Camera]) -> None:
    """Re-fit what is left to the whole scene's pictures."""
    with Rasterizer(device, scene) as rasterizer:
        refit_colours(
            device, left, cameras, RenderedTargets(rasterizer, cameras), RefitOptions(steps=STEPS, drop=1e-10, gain=0)
        )


def least_times(device: TimedDevice, work: Callable[[], object]) -> dict[str, tuple[int, float]]:
    """Launches of each kernel and their seconds, each launch's least of all runs."""
    runs = []
    for _ in range(REPEATS):
        device.launches = []
        work()
        runs.append(device.launches)
    seconds = np.array([[taken for _, taken in run] for run in runs]).min(axis=0)
    sums: dict[str, tuple[int, float]] = defaultdict(lambda: (0, 0.0))
    for (name, _), taken in zip(runs[0], seconds, strict=True):
        count, total = sums[name]
        sums[name] = count + 1, total + float(taken)
    return sums


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--views", type=int, default=4, help="training views, spread evenly (default %(default)s)")
    args = parser.parse_args()
    device = TimedDevice(args.device)
    table = Results(device.info, args.json).table(
        "kernels",
        f"Processor time of the kernels, the least of {REPEATS} runs on {args.views} views",
        Column("scene"),
        Column("stage"),
        Column("kernel"),
        Column("launches"),
        Column("of processors a launch", "ms", ".2f"),
    )
    for folder in args.scenes:
        scene, cameras = read(folder)
        views = train_views(cameras)
        cameras = [views[k] for k in np.linspace(0, len(views) - 1, args.views).round().astype(int)]
        left = pruning(device, scene, cameras)
        stages: dict[str, Callable[[], object]] = {
            "prune": functools.partial(pruning, device, scene, cameras),
            "re-fit": functools.partial(refit, device, scene, left, cameras),
        }
        for stage, work in stages.items():
            for name, (count, taken) in sorted(least_times(device, work).items(), key=lambda item: -item[1][1]):
                table.add(folder.name, stage, name, count, 1e3 * taken / count)


if __name__ == "__main__":
    main()
