"""Predicted removal effects against rendering without each splat in float64.

    python -m tools.study.removal_exactness

For splats spread over the whole range of importance: their ΔMSE over some training views as one sweep predicts it, and
as brute force finds it: every tile that a splat can touch is composited in float64 with and without it, once with each
pixel ending where it ended before the removal ("pixel ends held"), and once where the same rule would end it then ("as
rendered"). The rule that ends a pixel before the splat that would bring its transmittance below 1e-4 is a jump: a pixel
that ends one splat later can gain a hundredth of its light, and no formula for single removals sees that. So the sweep
and the brute force are also made with smaller limits than the rules'; "by the rules" then compares what such a sweep
predicts with what the rasterizer's own rule renders.

The noise floor is a thousandth of the smallest ΔMSE_MAX that a quality sets. Times are of the processor where the
device is one, else of the clock. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.reference.raster import project
from potr_cl.reference.removal import BruteForce
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.workloads import SCENES

#: A thousandth of ΔMSE_MAX at q = 1.
NOISE_FLOOR = 1e-3 * 10**-10.8
ABOVE = (0.0, NOISE_FLOOR, 100 * NOISE_FLOOR)
#: Transmittances at which pixels may end: the rules' first.
THRESHOLDS = (INRIA.transmittance_threshold, 1e-6, 1e-8)
REPEATS = 5
F64 = NDArray[np.float64]


def choose_splats(importance: F64, count: int) -> NDArray[np.int64]:
    """About ``count`` splats that the views see, evenly over the logarithm of importance."""
    seen = np.flatnonzero(importance > 0)
    by_importance = seen[np.argsort(importance[seen], kind="stable")]
    low, high = np.log(importance[by_importance[[len(seen) // 100, -1]]])
    at = np.searchsorted(np.log(importance[by_importance]), np.linspace(low, high, count))
    return np.unique(by_importance[at.clip(0, len(seen) - 1)])


def spent(device: Device) -> float:
    """Seconds: of the processor if it is the device, whatever else it does, else of the clock."""
    return time.process_time() if device.family == "cpu" else time.perf_counter()


def predicted(rasterizer: Rasterizer, cameras: Sequence[Camera], stop: float) -> tuple[F64, F64, float]:
    """ΔMSE, importance, and the seconds of a sweep, the best of some."""
    own = rasterizer.rules.transmittance_threshold
    with RemovalSweep(
        rasterizer, cameras, SweepOptions(transmittance_threshold=None if np.float32(stop) == np.float32(own) else stop)
    ) as removal:
        effect, importance = removal.measure()
        seconds = []
        for _ in range(REPEATS):
            removal.sweep_everything()
            started = spent(rasterizer.device)
            removal.measure()
            seconds.append(spent(rasterizer.device) - started)
    return effect, importance, min(seconds)


def measure(folder: Path, devices: Sequence[Device], views: int, splats: int) -> None:
    """Print a scene's rows."""
    scene = load_scene(folder / "point_cloud.ply")
    training = train_views(load_cameras(folder / "cameras.json"))
    cameras = training[:: max(1, len(training) // views)][:views]
    predictions = []
    for device in devices:
        with Rasterizer(device, scene) as rasterizer:
            predictions.append([predicted(rasterizer, cameras, stop) for stop in THRESHOLDS])
    chosen = choose_splats(predictions[0][0][1], splats)

    truth = np.zeros((2, len(THRESHOLDS), len(chosen)))
    for camera in cameras:
        view = BruteForce(project(scene, camera, INRIA), camera, INRIA)
        truth += view.effects(chosen, THRESHOLDS) / (3 * camera.width * camera.height * len(cameras))
    for device, by_stop in zip(devices, predictions, strict=True):
        for n, (stop, (effect, _, seconds)) in enumerate(zip(THRESHOLDS, by_stop, strict=True)):
            truths = {"pixel ends held": truth[0, n], "as rendered": truth[1, n]}
            if n:
                truths["by the rules"] = truth[1, 0]
            for label, true in truths.items():
                relative = np.abs(effect[chosen] - true) / np.maximum(true, 1e-300)
                cells = [folder.name, device.family, f"{stop:.0e}", f"{seconds / by_stop[0][2]:.2f}", label]
                for limit in ABOVE:
                    error = relative[true > limit]
                    cells.append(f"{np.median(error):.1e} / {np.quantile(error, 0.99):.1e} ({len(error)})")
                print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--splats", type=int, default=300)
    parser.add_argument("--families", nargs="+", choices=("cpu", "gpu"), help="of kernels; default: the device's own")
    parser.add_argument("--scenes", type=Path, default=SCENES, help="folder with lego and plush in it")
    args = parser.parse_args()
    families = args.families or [Device(args.device).family]
    devices = [Device(args.device, family=family) for family in families]
    print(f"{devices[0].info}; relative error of ΔMSE: median / 99th percentile (splats).\n")
    print("| scene | kernels | stop | time | truth | all | above the noise floor | above 100 times that |")
    print("|---|---|---|---|---|---|---|---|")
    for name in ("lego", "plush"):
        if (args.scenes / name).exists():
            measure(args.scenes / name, devices, args.views, args.splats)


if __name__ == "__main__":
    main()
