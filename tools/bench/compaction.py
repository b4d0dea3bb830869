"""Speed and accuracy of the SH energy compaction.

    python -m tools.bench.compaction PART … [options]

Parts:
  speed     synthetic splats, each seen by --views views; needs no files
  accuracy  every splat's own system of real scenes against float64, by default with the default method
Prints Markdown. Real scenes: --scene FOLDER … with point_cloud.ply and cameras.json. Effects on sparsity and pictures:
tools.study.compaction_curves.
"""

from __future__ import annotations

import argparse
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import camera_centres, train_views
from potr_cl.model.scene import SH_COEFFICIENTS, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.reference.ridge import YCOCG, Mask, Ridges, triangles, usable_columns_of
from potr_cl.reference.scenes import random_scene
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor, Precision
from potr_cl.stages.compaction.view_weights import ViewWeights
from tools.make.large_scene import DEFAULT_SCENE
from tools.results import threads
from tools.study.compaction_curves import measured_weights

F64 = NDArray[np.float64]

#: Colour error that counts as rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6
#: Device memory that takes a whole scene at once.
_WHOLE = 1 << 33


def operations(views: int, degree: int) -> dict[str, float]:
    """Floating-point operations a splat of the two families of methods, the terms that grow fastest only.

    A multiply-add counts as two. Per view: direction and basis, and the triangle's update. Per channel and pass: the
    factorisation. ``orthogonal`` needs twice the operations of ``scaled`` in each.
    """
    m = SH_COEFFICIENTS[degree]
    basis = 12 + 4 * m
    pairs = m * (m + 1) // 2
    elimination = sum((j + 1) * (m - j) for j in range(m))
    return {
        "scaled": views * (basis + 2 * pairs) + 6 * (m**3 / 3 + 4 * m * m),
        "orthogonal": views * (basis + 4 * pairs) + 6 * (4 * elimination + 4 * m * m),
    }


def _heading(device: Device) -> None:
    print(f"\n{device.info}, {device.family} kernels of {device.vector_width} lanes; {platform.machine()}, ", end="")
    print(f"{threads()} CPU thread(s)\n")


def _timed(
    device: Device, compactor: Compactor, scene: Scene, centres: F64, weights: ViewWeights, options: CompactionOptions
) -> tuple[Scene, float, float]:
    """The result, seconds in the kernel and seconds in all, the best of three runs after one to warm up."""
    compacted = compactor.compact(scene, centres, weights, options)
    device.stage_times()
    kernel = whole = np.inf
    for _ in range(3):
        started = time.perf_counter()
        compactor.compact(scene, centres, weights, options)
        whole = min(whole, time.perf_counter() - started)
        kernel = min(kernel, device.stage_times()["compact"])
    return compacted, kernel, whole


def _precisions(device: Device) -> list[Precision]:
    known: tuple[Precision, ...] = get_args(Precision)
    return [p for p in known if p != "fp64" or "cl_khr_fp64" in device.info.handle.extensions]


def _speed(device: Device, splats: int, views: int) -> None:
    print(f"## Speed: {splats} synthetic splats, {views} views each")
    _heading(device)
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(views, 3))
    centres *= 6 / np.linalg.norm(centres, axis=1, keepdims=True)
    offsets = views * np.arange(splats + 1, dtype=np.int64)
    weights = ViewWeights(
        offsets,
        np.tile(np.arange(views, dtype=np.int32), splats),
        rng.exponential(10, size=views * splats).astype(np.float32),
    )
    # In one batch kernels do not overlap, so that their times add up; in many all is as fast as it gets.
    whole_scene, batches = Compactor(device, min(_WHOLE, device.info.memory)), Compactor(device)
    print("| degree | method | k splats/s, kernel | with transfers | k operations a splat | Gflop/s |")
    print("|---|---|---|---|---|---|")
    for degree in (3, 2, 1):
        scene = random_scene(splats, degree)
        precisions: list[Precision] = _precisions(device) if degree == 3 else ["orthogonal"]
        for precision in precisions:
            options = CompactionOptions(precision=precision)
            _, kernel, _ = _timed(device, whole_scene, scene, centres, weights, options)
            _, _, whole = _timed(device, batches, scene, centres, weights, options)
            flops = operations(views, degree)["orthogonal" if precision == "orthogonal" else "scaled"]
            print(
                f"| {degree} | {precision} | {splats / kernel / 1e3:.0f} | {splats / whole / 1e3:.0f} "
                f"| {flops / 1e3:.0f} | {flops * splats / kernel / 1e9:.1f} |",
                flush=True,
            )
    print("\n| MiB on the device at a time (degree 3, orthogonal) | k splats/s with transfers |\n|---|---|")
    scene = random_scene(splats, 3)
    for mebibytes in (16, 32, 64, 128, 256, 512):
        compactor = Compactor(device, mebibytes << 20)
        _, _, whole = _timed(device, compactor, scene, centres, weights, CompactionOptions())
        print(f"| {mebibytes} | {splats / whole / 1e3:.0f} |", flush=True)
    host = np.empty_like(weights.weights)
    started = time.perf_counter()
    for _ in range(3):
        np.copyto(host, weights.weights)
    rate = 3 * host.nbytes / (time.perf_counter() - started)
    print(f"\nOne CPU thread copies {rate / 1e9:.1f} GB/s of the same arrays.")


@dataclass
class _Check:
    """Every channel of the splats that were checked: (K, 3) unless said otherwise.

    Attributes:
        splats: (K,) their numbers.
        above: relative excess over the optimum of the coefficients that the result left free, less :data:`ROUNDING`.
        total: the same, all channels together, (K,).
        against: objective of the result over that of the whole method in float64, less :data:`ROUNDING`.
        support: whether other coefficients are free than float64 leaves.
        kept: whether the channel kept its coefficients, and has others than DC.
        growth: largest AC coefficient over max(1, norm of the original ones).
    """

    splats: NDArray[np.int64]
    above: F64
    total: F64
    against: F64
    support: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    growth: F64


def _check(
    scene: Scene,
    compacted: Scene,
    weights: ViewWeights,
    options: CompactionOptions,
    systems: list[tuple[NDArray[np.int64], F64]],
) -> _Check:
    parts = []
    for splats, triangle in systems:
        before, after = (s.sh[splats].astype(np.float64) @ YCOCG.T for s in (scene, compacted))
        usable = usable_columns_of(triangle, options.alpha)
        squares = np.array([np.sum(weights.weights[slice(*weights.offsets[k : k + 2])] ** 2.0) for k in splats])
        rounding = ROUNDING**2 * squares
        columns: list[tuple[F64, F64, F64, Mask, Mask, F64]] = []
        for c in range(3):
            lam = options.lam * (options.chroma_factor if c else 1)
            old, new = before[..., c], after[..., c]
            # The way to R, G, B and back leaves a rounding error where a coefficient is zero.
            free = np.abs(new) > 1e-6 * np.abs(compacted.sh[splats]).max(axis=2)
            free[:, 0] = True
            excess, optimum = Ridges(triangle, old, free, lam).excess(new)

            used = usable.copy()
            first = Ridges(triangle, old, used, lam).solution()
            used[:, 1:] &= np.floor(0.5 + first[:, 1:] * options.sf_sh) != 0
            second = Ridges(triangle, old, used, lam)
            x = second.solution()
            best = second.excess(x)[1]
            columns.append(
                (
                    excess,
                    optimum,
                    np.maximum(excess + optimum - rounding, 0) / np.maximum(best, 1e-300),
                    (free != used).any(axis=1),
                    (np.abs(new - old) <= 1e-6 * np.abs(old).max(axis=1, keepdims=True)).all(axis=1)
                    & (old[:, 1:] != 0).any(axis=1),
                    np.abs(new[:, 1:]).max(axis=1) / np.maximum(np.linalg.norm(old, axis=1), 1),
                )
            )
        excess, optimum, against, support, kept, growth = (np.stack(c, axis=1) for c in zip(*columns, strict=True))
        above = np.maximum(excess - rounding[:, None], 0) / np.maximum(optimum, 1e-300)
        total = np.maximum(excess.sum(axis=1) - rounding, 0) / np.maximum(optimum.sum(axis=1), 1e-300)
        parts.append((splats, above, total, against, support, kept, growth))
    return _Check(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def _accuracy(device: Device, folder: Path, every: int, precisions: list[Precision]) -> None:
    scene, _ = load_scene(folder / "point_cloud.ply").cleaned()
    views = train_views(load_cameras(folder / "cameras.json"))
    centres = camera_centres(views)
    weights = measured_weights(device, scene, views)
    systems = [
        (splats[::every], triangle[::every])
        for splats, triangle in triangles(scene.means.astype(np.float64), centres, weights, scene.sh_degree)
    ]
    checked, seen = sum(len(s) for s, _ in systems), int(np.count_nonzero(np.diff(weights.offsets)))
    print(f"## Accuracy: {folder.name}, {checked} of the {seen} splats that a view sees (of {len(scene)}), ", end="")
    print(f"{np.diff(weights.offsets).mean():.0f} views a splat")
    _heading(device)
    print(
        "| λ | α | method | splats above the optimum by > 0.1 % | 99.99th percentile | worst | channels kept "
        "| channels that leave others free than float64 | their objective over float64's: median, 99th percentile "
        "| largest AC coefficient / max(1, norm) |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    parameters = EncodeOptions.for_preset("paper").parameters
    violators: list[str] = []
    for lam, alpha in ((1.0, 0.9), (parameters.lam, parameters.alpha), (0.01, 1.0)):
        for precision in precisions:
            options = CompactionOptions(lam=lam, alpha=alpha, sf_sh=parameters.sf_sh, precision=precision)
            compacted = Compactor(device).compact(scene, centres, weights, options)
            assert np.isfinite(compacted.sh).all()
            check = _check(scene, compacted, weights, options, systems)
            beyond = check.total > 1e-3
            changed = check.against[check.support & ~check.kept]
            print(
                f"| {lam:.3g} | {alpha:.3g} | {precision} | {np.count_nonzero(beyond)} = {100 * np.mean(beyond):.4f} % "
                f"| {np.quantile(check.total, 0.9999):.1e} | {check.total.max():.1e} "
                f"| {np.count_nonzero(check.kept)} | {np.count_nonzero(check.support & ~check.kept)} = "
                f"{100 * np.mean(check.support & ~check.kept):.4f} % "
                f"| {np.median(changed) if len(changed) else 1:.5f}, "
                f"{np.quantile(changed, 0.99) if len(changed) else 1:.5f} | {check.growth.max():.3g} |",
                flush=True,
            )
            channels = (check.above > 1e-3) & beyond[:, None]
            if beyond.any():
                violators.append(
                    f"λ = {lam:.3g}, α = {alpha:.3g}, {precision}: {channels.sum()} channels of {beyond.sum()} splats "
                    f"above, of which {(channels & check.kept).sum()} kept their coefficients"
                )
            for i in np.flatnonzero(beyond)[:20]:
                k = check.splats[i]
                run = slice(*weights.offsets[k : k + 2])
                violators.append(
                    f"splat {k}, {check.total[i]:.1e} above, "
                    f"{run.stop - run.start} views, weights {weights.weights[run].min():.1e} to "
                    f"{weights.weights[run].max():.1e}; channels above: {channels[i].sum()}, of these kept: "
                    f"{(channels[i] & check.kept[i]).sum()}"
                )
    print("\n" + "\n".join(f"- {line}" for line in violators))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=["speed", "accuracy"])
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--family", choices=["cpu", "gpu"], help="kernels to run; by default the device's own")
    parser.add_argument("--splats", type=int, default=20_000, help="of the synthetic scene")
    parser.add_argument("--views", type=int, default=100, help="of the synthetic scene")
    parser.add_argument("--scene", type=Path, nargs="+", default=[DEFAULT_SCENE.parent], help="folders of real scenes")
    parser.add_argument("--every", type=int, default=1, help="check every so many-th splat")
    parser.add_argument("--precisions", nargs="+", choices=get_args(Precision), default=["orthogonal"])
    args = parser.parse_args()
    device = Device(args.device, profiling=True, family=args.family)
    if "speed" in args.parts:
        _speed(device, args.splats, args.views)
    if "accuracy" in args.parts:
        for folder in args.scene:
            _accuracy(device, folder, args.every, args.precisions)


if __name__ == "__main__":
    main()
