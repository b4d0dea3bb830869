"""Speed, accuracy and effect of the SH energy compaction: python -m tools.bench_compaction PART … [options]

Parts:
  speed     synthetic splats, each seen by --views views; needs no files
  accuracy  run time against error on a real scene's own systems, with float64 for the optimum
  curves    sparsity, magnitude and test PSNR against lambda and alpha, and at half the resolution, on a real scene
Prints Markdown. Real scenes: --scene FOLDER with point_cloud.ply and cameras.json, and images for PSNR.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from potr_cl.cameras import Camera, camera_centres, test_views, train_views
from potr_cl.compaction import CompactionOptions, Compactor, Precision, ViewWeights
from potr_cl.device import Device
from potr_cl.formats import load_cameras, load_scene
from potr_cl.quantize import quantize_sh, to_ycocg
from potr_cl.rasterizer import Rasterizer
from potr_cl.removal import RemovalSweep
from potr_cl.scene import SH_COEFFICIENTS, FloatArray, Scene
from tests.ridge_reference import YCOCG, weighted_basis
from tests.scenes import random_scene
from tools.large_scene import DEFAULT_SCENE

F64 = NDArray[np.float64]

#: Colour error that counts as rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6


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


def _threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _heading(device: Device) -> None:
    print(f"\n{device.info}, {device.family} kernels of {device.vector_width} lanes; {platform.machine()}, ", end="")
    print(f"{_threads()} CPU thread(s)\n")


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
    print("| degree | method | k splats/s, kernel | with transfers | k operations a splat | Gflop/s |")
    print("|---|---|---|---|---|---|")
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(views, 3))
    centres *= 6 / np.linalg.norm(centres, axis=1, keepdims=True)
    offsets = views * np.arange(splats + 1, dtype=np.int64)
    weights = ViewWeights(
        offsets,
        np.tile(np.arange(views, dtype=np.int32), splats),
        rng.exponential(10, size=views * splats).astype(np.float32),
    )
    compactor = Compactor(device)
    for degree in (3, 2, 1):
        scene = random_scene(splats, degree)
        precisions: list[Precision] = _precisions(device) if degree == 3 else ["orthogonal"]
        for precision in precisions:
            options = CompactionOptions(precision=precision)
            _, kernel, whole = _timed(device, compactor, scene, centres, weights, options)
            flops = operations(views, degree)["orthogonal" if precision == "orthogonal" else "scaled"]
            print(
                f"| {degree} | {precision} | {splats / kernel / 1e3:.0f} | {splats / whole / 1e3:.0f} "
                f"| {flops / 1e3:.0f} | {flops * splats / kernel / 1e9:.1f} |",
                flush=True,
            )


def _measured_weights(device: Device, scene: Scene, cameras: list[Camera]) -> ViewWeights:
    rasterizer = Rasterizer(device, scene)
    sweep = RemovalSweep(rasterizer, cameras)
    sweep.measure()
    weights = ViewWeights.from_importances(len(scene), sweep.view_importances())
    sweep.free()
    rasterizer.free()
    return weights


def _excesses(
    scene: Scene, compacted: Scene, centres: F64, weights: ViewWeights, options: CompactionOptions, splats: int
) -> Iterator[tuple[float, float, float]]:
    """Per splat: squared objective above the optimum, the optimum, and what :data:`ROUNDING` makes of it.

    The optimum is over the coefficients that the result left free, by QR in float64; the excess is exact, the squared
    norm of the difference to the optimum under the system's own matrix, not a difference of two objectives.
    """
    seen = np.flatnonzero(np.diff(weights.offsets))
    chosen = np.random.default_rng(1).permutation(seen)[:splats]
    m = scene.sh.shape[1]
    ridge = np.eye(m)
    ridge[0, 0] = 0
    for k in chosen:
        run = slice(weights.offsets[k], weights.offsets[k + 1])
        w = weights.weights[run].astype(np.float64)
        basis = weighted_basis(scene.means[k].astype(np.float64), centres[weights.views[run]], w, scene.sh_degree)
        before, after = YCOCG @ scene.sh[k].T, YCOCG @ compacted.sh[k].T
        excess = optimum = 0.0
        for c in range(3):
            lam = options.lam * (options.chroma_factor if c else 1)
            used = np.abs(after[c]) > 1e-6 * np.abs(after).max()
            used[0] = True
            right = np.concatenate([basis[:, 1:] @ before[c, 1:], np.zeros(m)])
            stacked = np.concatenate([basis, np.sqrt(lam) * ridge])[:, used]
            q, r = np.linalg.qr(stacked)
            best = np.linalg.lstsq(r, q.T @ right, rcond=1e-15)[0]
            ours = after[c, used]
            ours[0] -= before[c, 0]
            excess += float(np.sum((r @ (ours - best)) ** 2))
            optimum += float(np.sum((stacked @ best - right) ** 2))
        yield excess, optimum, float(ROUNDING**2 * np.sum(w * w))


def _accuracy(device: Device, folder: Path, splats: int) -> None:
    scene, _ = load_scene(folder / "point_cloud.ply").cleaned()
    views = train_views(load_cameras(folder / "cameras.json"))
    centres = camera_centres(views)
    weights = _measured_weights(device, scene, views)
    print(f"## Accuracy: {folder.name}, {splats} of {len(scene)} splats, ", end="")
    print(f"{np.diff(weights.offsets).mean():.0f} views a splat")
    _heading(device)
    print("| λ | α | method | k splats/s | above the optimum by > 0.1 % | 99.99th percentile | worst |")
    print("|---|---|---|---|---|---|---|")
    for lam, alpha in ((1.0, 0.9), (1.0, 1.0), (0.01, 0.9), (0.01, 1.0)):
        for precision in _precisions(device):
            options = CompactionOptions(lam=lam, alpha=alpha, precision=precision)
            compacted, kernel, _ = _timed(device, Compactor(device), scene, centres, weights, options)
            excess, optimum, rounding = np.array(list(_excesses(scene, compacted, centres, weights, options, splats))).T
            relative = np.maximum(excess - rounding, 0) / np.maximum(optimum, 1e-300)
            print(
                f"| {lam:g} | {alpha:g} | {precision} | {len(scene) / kernel / 1e3:.0f} "
                f"| {100 * np.mean(relative > 1e-3):.3f} % | {np.quantile(relative, 0.9999):.1e} "
                f"| {relative.max():.1e} |",
                flush=True,
            )


def _quantized(sh: FloatArray, sf_sh: float) -> tuple[FloatArray, float, float]:
    """SH through the quantiser and back, share of AC coefficients that are zero, mean magnitude of the others."""
    back = np.empty_like(sh)
    zeros = coefficients = 0
    magnitude = 0.0
    for k in range(sh.shape[1]):
        y, co, cg = (quantize_sh(c, sf_sh) / sf_sh for c in to_ycocg(sh[:, k].astype(np.float64)))
        back[:, k] = np.stack([y - cg + co, y + cg, y - cg - co], axis=1)
        if k:
            zeros += sum(int(np.count_nonzero(c == 0)) for c in (y, co, cg))
            magnitude += sum(float(np.abs(c).sum()) for c in (y, co, cg))
            coefficients += 3 * len(y)
    return back, zeros / coefficients, magnitude / max(coefficients - zeros, 1)


def _photo(camera: Camera) -> F64:
    assert camera.image_path is not None
    pixels: F64 = np.asarray(Image.open(camera.image_path)).astype(np.float64) / 255
    return pixels[..., :3] * pixels[..., 3:] if pixels.shape[2] == 4 else pixels


def _psnr(images: list[Any], targets: list[Any]) -> float:
    return float(np.mean([-10 * np.log10(np.mean((a - b) ** 2)) for a, b in zip(images, targets, strict=True)]))


def _halved(camera: Camera) -> Camera:
    intrinsics = {name: getattr(camera, name) / 2 for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=camera.width // 2, height=camera.height // 2, **intrinsics)


def _curves(device: Device, folder: Path, every: int) -> None:
    scene, _ = load_scene(folder / "point_cloud.ply").cleaned()
    cameras = load_cameras(folder / "cameras.json")
    views, tests = train_views(cameras), test_views(cameras)[::every]
    centres = camera_centres(views)
    rasterizer = Rasterizer(device, scene)
    photos = [_photo(c) for c in tests]
    sf_sh = CompactionOptions().sf_sh

    def renders() -> list[Any]:
        return [np.clip(rasterizer.render(c)[0], 0, 1) for c in tests]

    originals = renders()
    print(f"## Effect: {folder.name}, {len(scene)} splats, none pruned, SF_SH = {sf_sh:g}, {len(tests)} test views")
    _heading(device)
    print(f"Uncompressed: {_psnr(originals, photos):.3f} dB against the photographs.\n")
    print("| | AC zeros | mean non-zero | PSNR, photographs | PSNR, uncompressed |")
    print("|---|---|---|---|---|")

    def row(label: str, sh: FloatArray) -> None:
        quantized, zeros, magnitude = _quantized(sh, sf_sh)
        device.free(rasterizer.replace_sh(quantized))
        images = renders()
        print(
            f"| {label} | {100 * zeros:.2f} % | {magnitude:.4f} | {_psnr(images, photos):.3f} "
            f"| {_psnr(images, originals):.2f} |",
            flush=True,
        )

    row("no compaction", scene.sh)
    weights = _measured_weights(device, scene, views)
    compactor = Compactor(device)

    def compact(label: str, **options: Any) -> None:
        chosen = replace(CompactionOptions(), **options)
        row(label, compactor.compact(scene, centres, weights, chosen).sh)

    for alpha in (1.0, 0.9, 0.7):
        for power in np.arange(-4, 5.1):
            compact(f"α = {alpha:g}, λ = 10^{power:g}", alpha=alpha, lam=10.0**power)
    compact("α = 0.9, λ = 1, one pass", two_pass=False)
    compact("α = 0.9, λ = 1, RGB", colour_model="rgb")
    compact("α = 0.9, λ = 1 for chroma too", chroma_factor=1.0)
    compact("α = 0.9, λ = 1, visibility", weighting="visibility")
    compact("α = 0.9, λ = 100, visibility", lam=100.0, weighting="visibility")
    rasterizer.free()

    half = _measured_weights(device, scene, [_halved(c) for c in views])
    print("\n| λ (α = 0.9) | AC zeros | weights from views of half the size |")
    print("|---|---|---|")
    for lam in (0.1, 1.0, 10.0):
        options = CompactionOptions(lam=lam)
        shares = [_quantized(compactor.compact(scene, centres, w, options).sh, sf_sh)[1] for w in (weights, half)]
        print(f"| {lam:g} | {100 * shares[0]:.2f} % | {100 * shares[1]:.2f} % |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=["speed", "accuracy", "curves"])
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--family", choices=["cpu", "gpu"], help="kernels to run; by default the device's own")
    parser.add_argument("--splats", type=int, default=20_000, help="of the synthetic scene, or to check")
    parser.add_argument("--views", type=int, default=100, help="of the synthetic scene")
    parser.add_argument("--scene", type=Path, default=DEFAULT_SCENE.parent, help="folder of a real scene")
    parser.add_argument("--every", type=int, default=1, help="render every so many-th test view")
    args = parser.parse_args()
    device = Device(args.device, profiling=True, family=args.family)
    for part in args.parts:
        if part == "speed":
            _speed(device, args.splats, args.views)
        elif part == "accuracy":
            _accuracy(device, args.scene, args.splats)
        else:
            _curves(device, args.scene, args.every)


if __name__ == "__main__":
    main()
