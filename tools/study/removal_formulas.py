"""The two formulas of removal effects beside each other.

    python -m tools.study.removal_formulas

Back to front is what the package computes, PD = T alpha (B - c) with the colour behind B grown from the last splat on.
Prefix sums is the paper's, PD_k = P_k - P_{k+1} / (1 - alpha) + alpha / (1 - alpha) P_K, in a second sweep from front
to back once the final colour P_K is known (removal_prefix_sums_*.cl): lists and sums are the same, and on GPUs the
rest of the kernel. On CPUs back to front walks sub-tile by sub-tile and remembers alphas, prefix sums go splat by splat
and do not, so there only the errors compare formulas.

Compared: the error where an opaque splat stands behind many layers, the error on real scenes, both against removals in
float64 that leave the pixels' ends where they are, and the time of a sweep. On the scenes both formulas also share the
errors of splats whose alpha crosses 1/255 in float32 where it does not in float64. Times are of
the processor where the device is one, else of the clock. Prints Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.reference import raster as reference
from potr_cl.reference.removal import BruteForce
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.study.removal_exactness import NOISE_FLOOR, choose_splats, spent
from tools.workloads import SCENES

F64 = NDArray[np.float64]

#: The removal kernels by the paper's formula, for :class:`potr_cl.opencl.device.Device`.
PREFIX_SUMS = {
    f"prune/removal_{family}.cl": Path(__file__).with_name(f"removal_prefix_sums_{family}.cl")
    for family in ("cpu", "gpu")
}
#: Pixels end here, in the sweeps and in float64.
TRANSMITTANCE_THRESHOLD = 1e-8
LAYERS_IN_FRONT = (0, 10, 100, 300)
LAYERS_BEHIND = 19
TIMED_VIEWS = 5
REPEATS = 7


def devices(spec: str | None = None, family: Family | None = None) -> tuple[Device, Device]:
    """Back to front and prefix sums, in this order."""
    return Device(spec, family=family), Device(spec, family=family, variants=PREFIX_SUMS)


def measure(device: Device, scene: Scene, cameras: Sequence[Camera]) -> tuple[F64, F64]:
    """ΔMSE and importance of all splats of a whole scene, see
    :meth:`potr_cl.stages.pruning.removal.RemovalSweep.measure`.
    """
    with (
        Rasterizer(device, scene) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(transmittance_threshold=TRANSMITTANCE_THRESHOLD)) as removal,
    ):
        return removal.measure()


def truth(scene: Scene, camera: Camera, splats: NDArray[np.int64]) -> F64:
    """ΔMSE of single splats in float64 with the pixels' ends held."""
    held: F64 = BruteForce(reference.project(scene, camera, INRIA), camera, INRIA).effects(
        splats, [TRANSMITTANCE_THRESHOLD]
    )[0, 0]
    return held / (3 * camera.width * camera.height)


def column(in_front: int) -> tuple[Scene, Camera]:
    """Thin layers (alpha about 0.01) of random colours, one splat of alpha 0.99 among them, seen along their row."""
    layers = in_front + 1 + LAYERS_BEHIND
    logits = np.full(layers, -4.6, np.float32)
    logits[in_front] = 12
    means = np.zeros((layers, 3), np.float32)
    means[:, 0] = np.linspace(-2, 2, layers)
    quaternions = np.zeros((layers, 4), np.float32)
    quaternions[:, 0] = 1
    dc = np.random.default_rng(0).normal(size=(layers, 1, 3)).astype(np.float32)
    rotation = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    camera_centre = np.array([-8.0, 0, 0])
    camera = Camera("along", 16, 16, 60, 60, 8, 8, rotation, -rotation @ camera_centre)
    return Scene(means, np.full((layers, 3), 0.5, np.float32), quaternions, logits, dc), camera


def print_column_errors(pair: tuple[Device, Device]) -> None:
    print("Relative error of ΔMSE in a column of layers, one of alpha 0.99, the largest of each kind:\n")
    print("| layers in front | formula | in front | alpha 0.99 | behind |")
    print("|---|---|---|---|---|")
    for in_front in LAYERS_IN_FRONT:
        scene, camera = column(in_front)
        true = truth(scene, camera, np.arange(len(scene)))
        for label, device in zip(("back to front", "prefix sums"), pair, strict=True):
            error = np.abs(measure(device, scene, [camera])[0] / true - 1)
            kinds = (error[:in_front], error[in_front : in_front + 1], error[in_front + 1 :])
            cells = (f"{kind.max():.1e}" if len(kind) else "–" for kind in kinds)
            print(f"| {in_front} | {label} | {' | '.join(cells)} |")
    print()


def print_scene_errors(name: str, scene: Scene, camera: Camera, pair: tuple[Device, Device], count: int) -> None:
    effects, importances = zip(*(measure(device, scene, [camera]) for device in pair), strict=True)
    chosen = choose_splats(importances[0], count)
    true = truth(scene, camera, chosen)
    chosen, true = chosen[true > NOISE_FLOOR], true[true > NOISE_FLOOR]
    faint = true < np.median(true)
    for label, effect in zip(("back to front", "prefix sums"), effects, strict=True):
        error = np.abs(effect[chosen] / true - 1)
        cells = (f"{np.median(e):.1e} / {np.quantile(e, 0.99):.1e}" for e in (error, error[faint], error[~faint]))
        print(f"| {name} | {label} | {len(chosen)} | {' | '.join(cells)} |")


def time_sweeps(scene: Scene, cameras: Sequence[Camera], pair: tuple[Device, Device]) -> F64:
    """Seconds of a sweep over all tiles of all views, (repeats, 2), the formulas taking turns."""
    options = SweepOptions(-1, transmittance_threshold=TRANSMITTANCE_THRESHOLD)
    seconds = np.zeros((REPEATS + 1, 2))
    with ExitStack() as owned:
        rasterizers = [owned.enter_context(Rasterizer(device, scene)) for device in pair]
        removals = [owned.enter_context(RemovalSweep(rasterizer, cameras, options)) for rasterizer in rasterizers]
        for times in seconds:
            for i, (device, removal) in enumerate(zip(pair, removals, strict=True)):
                started = spent(device)
                removal.measure()
                times[i] = spent(device) - started
    return seconds[1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--splats", type=int, default=150)
    parser.add_argument("--family", choices=("cpu", "gpu"), help="of kernels; default: the device's own")
    parser.add_argument("--scenes", type=Path, default=SCENES, help="folder with lego and plush in it")
    args = parser.parse_args()
    pair = devices(args.device, args.family)
    print(f"{pair[0].info}, {pair[0].family} kernels\n")
    print_column_errors(pair)

    scenes = {}
    for name in ("lego", "plush"):
        if (args.scenes / name).exists():
            training = train_views(load_cameras(args.scenes / name / "cameras.json"))
            cameras = training[:: max(1, len(training) // TIMED_VIEWS)][:TIMED_VIEWS]
            scenes[name] = load_scene(args.scenes / name / "point_cloud.ply"), cameras
    print("Relative error of ΔMSE in one view above the noise floor, median / 99th percentile:\n")
    print("| scene | formula | splats | all | the half with the smaller ΔMSE | the other half |")
    print("|---|---|---|---|---|---|")
    for name, (scene, cameras) in scenes.items():
        print_scene_errors(name, scene, cameras[0], pair, args.splats)
    print(f"\nOne sweep over {TIMED_VIEWS} views, the least and the median of {REPEATS}:\n")
    print("| scene | back to front | prefix sums | prefix sums / back to front |")
    print("|---|---|---|---|")
    for name, (scene, cameras) in scenes.items():
        seconds = time_sweeps(scene, cameras, pair)
        least, median = seconds.min(axis=0), np.median(seconds, axis=0)
        cells = (f"{least[i]:.3f} s / {median[i]:.3f} s" for i in range(2))
        print(f"| {name} | {' | '.join(cells)} | {least[1] / least[0]:.2f} / {median[1] / median[0]:.2f} |")


if __name__ == "__main__":
    main()
