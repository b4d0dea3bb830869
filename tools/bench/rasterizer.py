"""Speed of the rasterizer.

    python -m tools.bench.rasterizer frames SCENE … | growth

frames: frames a second of a scene's training views, finished one by one with the picture left on the device, and the
device's time a stage. A SCENE is a folder with point_cloud.ply and cameras.json; where it has reference/metrics.json,
gsplat's figure stands beside.
growth: time against the number of splats, of pixels, and the overlap, on synthetic scenes.

Prints Markdown for docs/benchmarks, or JSON with --json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT


def frame_times(rasterizer: Rasterizer, cameras: list[Camera], passes: int) -> list[float]:
    """Seconds of every frame of ``passes`` rounds over the views, after one that is not counted."""
    times = []
    for number in range(passes + 1):
        for camera in cameras:
            started = time.perf_counter()
            rasterizer.render_device(camera)
            if number:
                times.append(time.perf_counter() - started)
    return times


def stage_times(scene: Scene, cameras: list[Camera], spec: str | None, family: str | None) -> dict[str, float]:
    """Mean seconds a frame that the device spends in each kernel."""
    device = Device(spec, profiling=True, family=family)  # type: ignore[arg-type]
    with Rasterizer(device, scene, GSPLAT) as rasterizer:
        frame_times(rasterizer, cameras, 0)
        device.stage_times()
        frame_times(rasterizer, cameras, 0)
        sums = device.stage_times()
    return {name: seconds / len(cameras) for name, seconds in sums.items()}


def copy_bandwidth(device: Device) -> float:
    """Bytes a second of a copy within the device's memory, read and written bytes both counted."""
    size = min(device.info.largest_buffer, device.info.memory // 4, 1 << 30)
    best = np.inf
    with Memory(device) as memory:
        source, target = memory.allocate(size, "the copy"), memory.allocate(size, "the copy")
        for _ in range(5):
            device.queue.finish()
            started = time.perf_counter()
            cl.enqueue_copy(device.queue, target, source, byte_count=size)
            device.queue.finish()
            best = min(best, time.perf_counter() - started)
    return 2 * size / best


def least_bytes(scene: Scene, camera: Camera, intersections: float) -> dict[str, float]:
    """What each kernel must at least move through memory: every input read once, every output written once."""
    splats = len(scene)
    tiles = -(-camera.width // 16) * -(-camera.height // 16)
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


def bench_scene(folder: Path, spec: str | None, family: str | None, passes: int, limit: int | None) -> dict[str, Any]:
    """Frames a second, time a stage and list lengths of one scene."""
    scene = load_scene(folder / "point_cloud.ply")
    cameras = train_views(load_cameras(folder / "cameras.json"))[:limit]
    device = Device(spec, family=family)  # type: ignore[arg-type]
    with Rasterizer(device, scene, GSPLAT) as rasterizer, ExitStack() as prepared:
        times = frame_times(rasterizer, cameras, passes)
        views = [prepared.enter_context(rasterizer.prepare(camera)) for camera in cameras[:: max(len(cameras) // 8, 1)]]
        intersections = statistics.mean(view.intersection_count for view in views)
        longest = max(int(np.diff(device.download(v.offsets, (v.tiles + 1,), np.uint32)).max(initial=0)) for v in views)
    metrics = folder / "reference" / "metrics.json"
    return {
        "scene": folder.name,
        "device": str(device.info),
        "splats": len(scene),
        "pixels": [cameras[0].width, cameras[0].height],
        "frames": len(times),
        "frames_per_second": 1 / statistics.mean(times),
        "median_frames_per_second": 1 / statistics.median(times),
        "gsplat_frames_per_second": json.loads(metrics.read_text())["gsplat_fps_h200"] if metrics.exists() else None,
        "intersections": intersections,
        "longest_list": longest,
        "stage_seconds": stage_times(scene, cameras, spec, family),
        "least_bytes": least_bytes(scene, cameras[0], intersections),
        "bandwidth": copy_bandwidth(device),
    }


def print_scenes(results: list[dict[str, Any]]) -> None:
    """Markdown tables of :func:`bench_scene`."""
    print(f"Device: {results[0]['device']}\n")
    print(
        "| scene | splats | pixels | tile intersections a view | longest list | frames/s | median | gsplat's | ratio |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for r in results:
        theirs = r["gsplat_frames_per_second"]
        print(
            f"| {r['scene']} | {r['splats']:,} | {r['pixels'][0]} x {r['pixels'][1]} | {r['intersections']:,.0f} | "
            f"{r['longest_list']:,} | {r['frames_per_second']:.0f} | {r['median_frames_per_second']:.0f} | "
            + (f"{theirs:.0f} | {r['frames_per_second'] / theirs:.2f} |" if theirs else "| |")
        )
    stages = list(results[0]["stage_seconds"])
    print(
        f"\nMicroseconds a frame on the device, by kernel; in brackets the least that its bytes take at "
        f"{1e-9 * results[0]['bandwidth']:.0f} GB/s, what a copy reaches:\n"
    )
    print("| scene | " + " | ".join(stages) + " | all kernels | frame |")
    print("|---" * (len(stages) + 3) + "|")
    for r in results:
        seconds = r["stage_seconds"]
        print(
            f"| {r['scene']} | "
            + " | ".join(f"{1e6 * seconds[s]:.0f} ({1e6 * r['least_bytes'][s] / r['bandwidth']:.1f})" for s in stages)
            + f" | {1e6 * sum(seconds.values()):.0f} | {1e6 / r['frames_per_second']:.0f} |"
        )


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


def synthetic_camera(width: int) -> Camera:
    """Square, at distance 3 from the ball, which fills it."""
    return Camera(
        "synthetic", width, width, 1.3 * width, 1.3 * width, width / 2, width / 2, np.eye(3), np.array([0, 0, 3.0])
    )


def bench_growth(spec: str | None, largest: int) -> list[dict[str, Any]]:
    """Time of a frame against splats, pixels and splat size, one of them varied at a time."""
    device = Device(spec)
    counts = [n for n in (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 5_000_000) if n <= largest]
    runs = [("splats", n, 0.5 * n ** (-1 / 3), 800) for n in counts]
    runs += [("pixels", 300_000, 0.0075, width) for width in (200, 400, 800, 1600, 3200)]
    runs += [("overlap", 100_000, sigma, 800) for sigma in (0.0025, 0.005, 0.01, 0.02, 0.04)]
    results = []
    for varied, splats, sigma, width in runs:
        with Rasterizer(device, synthetic_scene(splats, sigma), GSPLAT) as rasterizer:
            times = frame_times(rasterizer, [synthetic_camera(width)], 5)
            with rasterizer.prepare(synthetic_camera(width)) as view:
                results.append(
                    {
                        "varied": varied,
                        "splats": splats,
                        "pixels": width * width,
                        "overlap": view.intersection_count / view.tiles,
                        "seconds": statistics.median(times),
                    }
                )
    return results


def print_growth(results: list[dict[str, Any]]) -> None:
    """Markdown table of :func:`bench_growth`."""
    print("| varied | splats | pixels | splats a tile | ms a frame |\n|---|---|---|---|---|")
    for r in results:
        print(f"| {r['varied']} | {r['splats']:,} | {r['pixels']:,} | {r['overlap']:,.0f} | {1e3 * r['seconds']:.2f} |")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--json", action="store_true")
    parts = parser.add_subparsers(dest="part", required=True)
    frames = parts.add_parser("frames")
    frames.add_argument("scenes", nargs="+", type=Path)
    frames.add_argument("--family", choices=("cpu", "gpu"))
    frames.add_argument("--passes", type=int, default=5)
    frames.add_argument("--views", type=int, help="only the first so many training views")
    growth = parts.add_parser("growth")
    growth.add_argument("--largest", type=int, default=5_000_000, help="splats")
    arguments = parser.parse_args()
    if arguments.part == "frames":
        results = [
            bench_scene(s, arguments.device, arguments.family, arguments.passes, arguments.views)
            for s in arguments.scenes
        ]
    else:
        results = bench_growth(arguments.device, arguments.largest)
    if arguments.json:
        print(json.dumps(results, indent=1))
    elif arguments.part == "frames":
        print_scenes(results)
    else:
        print_growth(results)


if __name__ == "__main__":
    main()
