"""The CPU compositing kernel beside a C loop.

    python -m tools.study.composite_yardstick SCENE [--views N]

On every CPU runtime that is installed: (pixel, splat) pairs a second of the compositing kernel alone, against
composite_yardstick.c built by the system's C compiler with its best vectorisation, on the same lists and threads;
and the share of the machine's measured peak of fused multiply-adds.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import compiler_fault, list_devices
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT

SOURCE = Path(__file__).with_suffix(".c")
# All of -ffast-math that does not reorder sums: 2^x rounds by adding and subtracting a large number.
FLAGS = [
    *("-O3", "-march=native", "-mprefer-vector-width=512", "-fopenmp", "-ffp-contract=fast"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fno-rounding-math"),
]
#: Floating-point operations of one pair in the inner loop, a fused multiply-add counted as two: exponent 3, 2^x 16,
#: clamps and tests 4, transmittance 4, colours 7.
OPERATIONS = 34
REPEATS = 7


def build(folder: Path) -> ctypes.CDLL:
    """Compile and load the C loop."""
    library = folder / "yardstick.so"
    compiler = os.environ.get("CC", "cc")
    subprocess.run([compiler, *FLAGS, "-shared", "-fPIC", str(SOURCE), "-lm", "-o", str(library)], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.composite.restype = ctypes.c_int64
    loaded.peak.restype = ctypes.c_double
    return loaded


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def peak(library: ctypes.CDLL, threads: int) -> float:
    """Operations a second of the fused multiply-add loop, the best of several runs."""
    sink = np.zeros(threads, np.float32)
    best = 0.0
    for _ in range(REPEATS):
        started = time.perf_counter()
        done = library.peak(ctypes.c_int64(3_000_000), ctypes.c_int(threads), _pointer(sink))
        best = max(best, done / (time.perf_counter() - started))
    return best


def measure(library: ctypes.CDLL, device: Device, scene: Scene, cameras: list[Camera]) -> tuple[float, float, float]:
    """Seconds of the kernel and of the C loop, each the best run of every view, and the pairs evaluated."""
    with Rasterizer(device, scene, GSPLAT) as rasterizer:
        kernel_seconds = loop_seconds = pairs = 0.0
        for camera in cameras:
            with rasterizer.prepare(camera) as view:
                splats = view.shapes.size // 32
                shapes = device.download(view.shapes, (splats, 8), np.float32)
                colours = device.download(view.colours, (splats, 4), np.float32)
                offsets = device.download(view.offsets, (view.tiles + 1,), np.uint32)
                intersections = device.download(view.intersections, (view.intersection_count,), np.uint32)
                image = np.zeros((camera.height, camera.width, 3), np.float32)
                transmittance = np.zeros((camera.height, camera.width), np.float32)
                kernel_best = loop_best = np.inf
                for _ in range(REPEATS):  # in turns, so that a busy machine slows both
                    device.stage_times()
                    ours, _ = rasterizer.composite(view)
                    kernel_best = min(kernel_best, device.stage_times()["composite"])
                    started = time.perf_counter()
                    done = library.composite(
                        *(_pointer(a) for a in (shapes, colours, offsets, intersections)),
                        *(ctypes.c_int(n) for n in (view.columns, view.rows, camera.width, camera.height)),
                        ctypes.c_float(GSPLAT.alpha_cap),
                        ctypes.c_float(GSPLAT.transmittance_threshold),
                        _pointer(image),
                        _pointer(transmittance),
                    )
                    loop_best = min(loop_best, time.perf_counter() - started)
                difference = float(np.quantile(np.abs(ours - image), 0.999))
                assert difference < 1e-4, f"the C loop's picture differs by {difference}"
                kernel_seconds += kernel_best
                loop_seconds += loop_best
                pairs += done
    return kernel_seconds, loop_seconds, pairs


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with point_cloud.ply and cameras.json")
    parser.add_argument("--views", type=int, default=6)
    arguments = parser.parse_args()
    scene = load_scene(arguments.scene / "point_cloud.ply")
    cameras = train_views(load_cameras(arguments.scene / "cameras.json"))
    cameras = cameras[:: max(len(cameras) // arguments.views, 1)][: arguments.views]
    with tempfile.TemporaryDirectory() as folder:
        library = build(Path(folder))
        threads = len(os.sched_getaffinity(0))
        ceiling = peak(library, threads)
        print(f"{threads} threads, measured peak {1e-9 * ceiling:.0f} GFLOP/s of fused multiply-adds\n")
        print("| runtime | vector | kernel, Gpairs/s | share of peak | C loop, Gpairs/s | kernel / C |")
        print("|---|---|---|---|---|---|")
        for info in list_devices():
            if info.family != "cpu" or compiler_fault(info) is not None:
                continue
            device = Device(info, profiling=True)
            kernel, loop, pairs = measure(library, device, scene, cameras)
            print(
                f"| {info.platform}, {info.version} | {device.vector_width} | {1e-9 * pairs / kernel:.2f} | "
                f"{pairs * OPERATIONS / kernel / ceiling:.0%} | {1e-9 * pairs / loop:.2f} | {loop / kernel:.2f} |",
                flush=True,
            )
        print(f"\n{pairs / len(cameras):,.0f} pairs a view")


if __name__ == "__main__":
    main()
