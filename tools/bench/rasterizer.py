"""Speed of the rasterizer.

    python -m tools.bench.rasterizer SCENE … [--json FILE]    frames a second, and the device's time by kernel
    python -m tools.bench.rasterizer [--largest N]            time against splats, pixels and overlap

Frames are those of a scene's training views, finished one by one with the picture left on the device; where the scene
has reference/metrics.json, gsplat's figure stands beside. Without a SCENE synthetic ones are drawn, with one number
varied at a time.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT
from tools.results import Results
from tools.workloads import best_of, read, scene_parser


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


def copy_bandwidth(device: Device) -> float:
    """Bytes a second of a copy within the device's memory, read and written bytes both counted."""
    size = min(device.info.largest_buffer, device.info.memory // 4, 1 << 30)
    with Memory(device) as memory:
        source, target = memory.allocate(size, "the copy"), memory.allocate(size, "the copy")

        def copy() -> None:
            cl.enqueue_copy(device.queue, target, source, byte_count=size)
            device.queue.finish()

        return 2 * size / best_of(4, copy)


def least_bytes(scene: Scene, camera: Camera, intersections: float) -> dict[str, float]:
    """What each kernel must at least move through memory: every input read once, every output written once."""
    splats, tiles = len(scene), -(-camera.width // 16) * -(-camera.height // 16)
    return {
        "project": splats * (44 + 12 * scene.sh.shape[1] + 56),
        "count_tiles": splats * 8 + tiles * 4,
        "scan_tiles": tiles * 12,
        "fill_tiles": splats * 12 + intersections * 8,
        "sort_tiles": intersections * 12,
        "subtile_masks": splats * 32 + intersections * 6,
        "composite": splats * 48 + intersections * 6 + camera.width * camera.height * 16,
        "composite_frame": splats * 48 + intersections * 4 + camera.width * camera.height * 16,
    }


def scenes(results: Results, folders: Sequence[Path], device: Device, passes: int, limit: int | None) -> None:
    """Frames a second, list lengths and kernels of scenes."""
    timed = Device(device.info, profiling=True, family=device.family)
    bandwidth = copy_bandwidth(device)
    table = results.table(
        "frames", "Frames of training views, picture left on the device",
        "scene; splats||,; pixels; tile intersections a view||,.0f; longest list||,; frames/s||.0f; median||.0f; "
        "gsplat's||.0f; ratio||.2f",
    )  # fmt: skip
    kernels = []
    for folder in folders:
        scene, cameras = read(folder)
        views = train_views(cameras)[:limit]
        with Rasterizer(device, scene, GSPLAT) as rasterizer, ExitStack() as prepared:
            times = frame_times(rasterizer, views, passes)
            some = [prepared.enter_context(rasterizer.prepare(view)) for view in views[:: max(len(views) // 8, 1)]]
            intersections = statistics.mean(view.intersection_count for view in some)
            longest = max(np.diff(device.download(v.offsets, (v.tiles + 1,), np.uint32)).max(initial=0) for v in some)
        metrics, rate = folder / "reference" / "metrics.json", 1 / statistics.mean(times)
        theirs = json.loads(metrics.read_text())["gsplat_fps_h200"] if metrics.exists() else None
        table.add(
            folder.name, len(scene), f"{views[0].width} x {views[0].height}", intersections, int(longest), rate,
            1 / statistics.median(times), theirs, theirs and rate / theirs,
        )  # fmt: skip
        kernels.append((folder.name, stage_times(timed, scene, views), least_bytes(scene, views[0], intersections)))
    for name, seconds, least in kernels:
        table = results.table(
            f"kernels_{name}", f"A frame of {name}; least: its bytes at a copy's {1e-9 * bandwidth:.0f} GB/s",
            "kernel; time|µs|.0f; least|µs|.1f",
        )  # fmt: skip
        for kernel, spent in seconds.items():
            table.add(kernel, 1e6 * spent, 1e6 * least[kernel] / bandwidth)


def synthetic_scene(splats: int, sigma: float, seed: int = 0) -> Scene:
    """Splats of degree 3 in a unit ball, ``sigma`` world units large, half transparent."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(splats, 3))
    means *= rng.random((splats, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    return Scene(
        means.astype(np.float32),
        rng.normal(np.log(sigma), 0.5, (splats, 3)).astype(np.float32),
        rng.normal(size=(splats, 4)).astype(np.float32),
        rng.normal(-1, 1, splats).astype(np.float32),
        rng.normal(scale=0.1, size=(splats, 16, 3)).astype(np.float32),
    )


def growth(results: Results, device: Device, largest: int) -> None:
    """Time of a frame against splats, pixels and splat size, one of them varied at a time."""
    counts = [n for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 5_000_000) if n <= largest]
    runs = [("splats", n, 0.5 * n ** (-1 / 3), 800) for n in counts]
    runs += [("pixels", min(300_000, largest), 0.0075, width) for width in (200, 400, 800, 1600, 3200)]
    runs += [("overlap", min(100_000, largest), sigma, 800) for sigma in (0.0025, 0.005, 0.01, 0.02, 0.04)]
    table = results.table(
        "growth", "Time of a frame of a synthetic scene",
        "varied; splats||,; pixels||,; splats a tile||,.0f; a frame|ms|.2f",
    )  # fmt: skip
    for varied, splats, sigma, width in runs:
        at = np.array([0, 0, 3.0])  # the ball fills the view
        camera = Camera("a", width, width, 1.3 * width, 1.3 * width, width / 2, width / 2, np.eye(3), at)
        with Rasterizer(device, synthetic_scene(splats, sigma), GSPLAT) as rasterizer:
            seconds = statistics.median(frame_times(rasterizer, [camera], 5))
            with rasterizer.prepare(camera) as view:
                table.add(varied, splats, width * width, view.intersection_count / view.tiles, 1e3 * seconds)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__, "*")
    parser.add_argument("--family", choices=("cpu", "gpu"), help="of kernels")
    parser.add_argument("--passes", type=int, default=5)
    parser.add_argument("--views", type=int, help="only the first so many training views")
    parser.add_argument("--largest", type=int, default=5_000_000, help="splats of synthetic scenes")
    args = parser.parse_args()
    device = Device(args.device, family=args.family)
    results = Results(device.info, args.json)
    if args.scenes:
        scenes(results, args.scenes, device, args.passes, args.views)
    else:
        growth(results, device, args.largest)


if __name__ == "__main__":
    main()
