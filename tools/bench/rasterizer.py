"""Speed of the rasterizer: frames a second, and the device's time by kernel.

    python -m tools.bench.rasterizer SCENE … [--json FILE]

Frames are those of a scene's training views, finished one by one with the picture left on the device; where the scene
has reference/metrics.json, gsplat's figure stands beside. (tools.make.large_scene makes scenes of any size.)
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT
from tools.results import Results
from tools.workloads import read, scene_parser


def frame_times(rasterizer: Rasterizer, cameras: Sequence[Camera], passes: int) -> list[float]:
    """Seconds of every frame of ``passes`` rounds over the views, after one that is not counted."""
    times = []
    for number in range(passes + 1):
        for camera in cameras:
            started = time.perf_counter()
            rasterizer.render_device(camera)
            if number:
                times.append(time.perf_counter() - started)
    return times


def stage_times(device: Device, scene: Scene, cameras: Sequence[Camera]) -> dict[str, float]:
    """Mean seconds a frame that a device with profiling spends in each kernel."""
    with Rasterizer(device, scene, GSPLAT) as rasterizer:
        for _ in range(2):  # the first builds the kernels
            device.stage_times()
            frame_times(rasterizer, cameras, 0)
        return {name: seconds / len(cameras) for name, seconds in device.stage_times().items()}


def scenes(results: Results, folders: Sequence[Path], device: Device, passes: int, limit: int | None) -> None:
    """Frames a second, list lengths and kernels of scenes."""
    timed = Device(device.info, profiling=True, family=device.family)
    table = results.table(
        "frames", "Frames of training views, picture left on the device",
        "scene; splats||,; pixels; tile intersections a view||,.0f; longest list||,; frames/s||.0f; median||.0f; "
        "gsplat's||.0f; ratio||.2f",
    )  # fmt: skip
    kernels = {}
    for folder in folders:
        scene, cameras = read(folder)
        views = train_views(cameras)[:limit]
        with Rasterizer(device, scene, GSPLAT) as rasterizer, ExitStack() as prepared:
            times = frame_times(rasterizer, views, passes)
            some = [
                prepared.enter_context(rasterizer.prepare_set([view])) for view in views[:: max(len(views) // 8, 1)]
            ]
            intersections = statistics.mean(view.capacity for view in some)
            longest = max(np.diff(device.download(v.offsets, (v.tiles + 1,), np.uint32)).max(initial=0) for v in some)
        metrics, rate = folder / "reference" / "metrics.json", 1 / statistics.mean(times)
        theirs = json.loads(metrics.read_text())["gsplat_fps_h200"] if metrics.exists() else None
        table.add(
            folder.name, len(scene), f"{views[0].width} x {views[0].height}", intersections, int(longest), rate,
            1 / statistics.median(times), theirs, theirs and rate / theirs,
        )  # fmt: skip
        kernels[folder.name] = stage_times(timed, scene, views)
    for name, seconds in kernels.items():
        table = results.table(f"kernels_{name}", f"A frame of {name}, kernel by kernel", "kernel; time|µs|.0f")
        for kernel, spent in seconds.items():
            table.add(kernel, 1e6 * spent)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--family", choices=("cpu", "gpu"), help="of kernels")
    parser.add_argument("--passes", type=int, default=5)
    parser.add_argument("--views", type=int, help="only the first so many training views")
    args = parser.parse_args()
    device = Device(args.device, family=args.family)
    scenes(Results(device.info, args.json), args.scenes, device, args.passes, args.views)


if __name__ == "__main__":
    main()
