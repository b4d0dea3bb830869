"""What the SH energy compaction does to sparsity and pictures.

    python -m tools.study.compaction_curves FOLDER … --json curves.json       measure; keep the figures
    python -m tools.study.compaction_curves --from curves.json [--png FILE]   tables and plot of figures that were kept

Each FOLDER holds point_cloud.ply and cameras.json. Of each scene, as it is and pruned at quality 0.5: share of AC
coefficients that are quantised to 0, mean magnitude of the others in steps of the quantiser, and PSNR over all test
views, against λ and α and without single parts of the method; and the same sparsity from training views of half the
size. PSNR is against the renders of the uncompressed scene, of the same splats uncompacted and unquantised, and against
the photographs where they are there. Only SH coefficients are quantised. Prints Markdown.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import quantize_sh, to_ycocg
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.model.camera import Camera, camera_centres, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compaction.ridge import CompactionOptions, Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from tools.workloads import reduced, scaled

ALPHAS = (1.0, 0.9, 0.7)
POWERS = tuple(range(-5, 6))
#: Shares of zeros that the curves are compared at, by interpolation.
SHARES = (0.8, 0.9, 0.95, 0.97)
#: Single parts of the method left out, and the end of the curves.
PARTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("α = 0.9, λ = 1, one pass", {"two_pass": False}),
    ("α = 0.9, λ = 1, RGB", {"colour_model": "rgb"}),
    ("α = 0.9, λ = 1 for chroma too", {"chroma_factor": 1.0}),
    ("α = 0.9, λ = 1, visibility", {"weighting": "visibility"}),
    ("α = 0.9, λ = 100, visibility", {"weighting": "visibility", "lam": 100.0}),
    ("λ = ∞", {"lam": 1e20}),
)
#: Macros of cl/raster/project.cl: a quarter of its low-pass filter, which is to a view of half the size what the whole
#: is to one of full size.
QUARTER_LOW_PASS = {"LOW_PASS": 0.3 / 4, "LOW_PASS_SQUARED": 0.09 / 16}


def measured_weights(device: Device, scene: Scene, cameras: Sequence[Camera]) -> ViewWeights:
    """How much each splat shows in each view."""
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras) as sweep:
        sweep.measure()
        return ViewWeights.from_importances(len(scene), sweep.view_importances())


def quantized(sh: FloatArray, sf_sh: float) -> tuple[FloatArray, NDArray[np.float64], float]:
    """SH through the quantiser and back; share of AC zeros by degree; mean magnitude of the others, in steps."""
    back = np.empty_like(sh)
    count = sh.shape[1]
    zeros, magnitude = np.zeros(count), 0.0
    for k in range(count):
        steps = [quantize_sh(c, sf_sh) for c in to_ycocg(sh[:, k].astype(np.float64))]
        y, co, cg = (np.float32(1 / sf_sh) * c.astype(np.float32) for c in steps)
        back[:, k, 0], back[:, k, 1], back[:, k, 2] = y - cg + co, y + cg, y - cg - co
        zeros[k] = sum(np.count_nonzero(c == 0) for c in steps)
        if k:
            magnitude += sum(float(np.abs(c).sum(dtype=np.float64)) for c in steps)
    others = 3 * len(sh) * (count - 1) - zeros[1:].sum()
    degrees = [zeros[d * d : (d + 1) ** 2].mean() / (3 * len(sh)) for d in range(1, round(count**0.5))]
    return back, np.array(degrees), magnitude / max(others, 1)


def _psnr(images: list[FloatArray], targets: list[FloatArray]) -> float:
    errors = [np.mean(np.square(a - b), dtype=np.float64) for a, b in zip(images, targets, strict=True)]
    return float(np.mean(-10 * np.log10(np.maximum(errors, 1e-20))))


def _renders(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> list[FloatArray]:
    return [np.clip(rasterizer.render(c)[0], 0, 1) for c in cameras]


def _ground_truth(cameras: Sequence[Camera]) -> list[FloatArray] | None:
    paths = [c.image_path for c in cameras]
    if not all(p is not None and p.exists() for p in paths):
        return None
    return [read_ground_truth(p) for p in paths if p is not None]


def _resolution(
    device: Device, scene: Scene, views: list[Camera], weights: ViewWeights, sf_sh: float
) -> list[dict[str, Any]]:
    """Sparsity with weights from views of full and half size, and of half size with the low-pass of full size."""
    small = [scaled(c, 0.5) for c in views]
    half = measured_weights(device, scene, small)
    sharp_device = Device(device.info, family=device.family, macros=QUARTER_LOW_PASS)
    sharp = measured_weights(sharp_device, scene, small)
    centres, compactor = camera_centres(views), Compactor(device)
    rows = []
    for lam in (0.1, 1.0, 10.0):
        row: dict[str, Any] = {"lambda": lam}
        for label, w in (("full", weights), ("half", half), ("half, low-pass of full size", sharp)):
            sh = compactor.compact(scene, centres, w, CompactionOptions(lam=lam, sf_sh=sf_sh)).sh
            _, degrees, _ = quantized(sh, sf_sh)
            row[label] = _whole(degrees)
        rows.append(row)
    return rows


def _whole(degrees: NDArray[np.float64]) -> float:
    """Share of zeros among all AC coefficients from those of the degrees 1, 2, …"""
    sizes = 2 * np.arange(1, len(degrees) + 1) + 1
    return float(np.sum(degrees * sizes) / np.sum(sizes))


class _CurveEvaluator:
    """Renders the test views with other SH coefficients and compares.

    Args:
        targets: pictures of the test views by name.
    """

    def __init__(
        self, rasterizer: Rasterizer, tests: Sequence[Camera], targets: dict[str, list[FloatArray]], sf_sh: float
    ) -> None:
        self._rasterizer, self._tests, self._targets, self._sf_sh = rasterizer, tests, targets, sf_sh
        self.rows: list[dict[str, Any]] = []

    def add(self, label: str, sh: FloatArray, **settings: float) -> None:
        """A row of figures for these coefficients, quantised."""
        back, degrees, magnitude = quantized(sh, self._sf_sh)
        former = self._rasterizer.replace_sh(back)
        assert former is not None
        self._rasterizer.device.free(former)
        images = _renders(self._rasterizer, self._tests)
        row = {"label": label, "zeros": _whole(degrees), "by degree": degrees.tolist(), "magnitude": magnitude}
        self.rows.append(row | settings | {name: _psnr(images, target) for name, target in self._targets.items()})


def measure(device: Device, folder: Path, every: int, powers: Sequence[float]) -> Iterator[dict[str, Any]]:
    """The figures of a scene as it is, then of the pruned one."""
    scene, _ = load_scene(folder / "point_cloud.ply").cleaned()
    cameras = load_cameras(folder / "cameras.json")
    views, tests = train_views(cameras), test_views(cameras)[::every]
    ground_truth = _ground_truth(tests)
    options = EncodeOptions.for_preset("paper", compact=False)
    sf_sh = options.parameters.sf_sh
    settings: list[tuple[str, dict[str, Any]]] = [
        (f"α = {alpha:g}, λ = 10^{power:g}", {"alpha": alpha, "lam": 10.0**power})
        for alpha in ALPHAS
        for power in powers
    ]
    settings += PARTS
    targets: dict[str, list[FloatArray]] = {}
    for pruned in (False, True):
        if pruned:
            scene = reduced(scene, views, options, device)
        with Rasterizer(device, scene) as rasterizer:
            unquantized = _renders(rasterizer, tests)
            targets = {"uncompressed": targets.get("uncompressed", unquantized), "uncompacted": unquantized}
            if ground_truth:
                targets["ground_truth"] = ground_truth
            evaluator = _CurveEvaluator(rasterizer, tests, targets, sf_sh)
            evaluator.add("no compaction", scene.sh)
            evaluator.add("AC set to 0", np.where(np.arange(scene.sh.shape[1])[:, None] == 0, scene.sh, np.float32(0)))
            weights = measured_weights(device, scene, views)
            compactor = Compactor(device)
            for label, changes in settings:
                chosen = replace(CompactionOptions(sf_sh=sf_sh), **changes)
                sh = compactor.compact(scene, camera_centres(views), weights, chosen).sh
                evaluator.add(label, sh, alpha=chosen.alpha, lam=chosen.lam)
        yield {
            "scene": folder.name,
            "pruned": pruned,
            "device": str(device.info),
            "splats": len(scene),
            "views": len(tests),
            "sf_sh": sf_sh,
            "before": {name: _psnr(unquantized, target) for name, target in targets.items() if name != "uncompacted"},
            "rows": evaluator.rows,
            "resolution": _resolution(device, scene, views, weights, sf_sh),
        }


def show(result: dict[str, Any]) -> None:
    """Print the tables of one scene."""
    kind = "pruned at quality 0.5" if result["pruned"] else "not pruned"
    print(f"\n#### {result['scene']}, {kind}: {result['splats']} splats, {result['views']} test views\n")
    print(f"{result['device']}; SF_SH = {result['sf_sh']:g}. ", end="")
    before = [f"{value:.3f} dB against {name}" for name, value in result["before"].items() if value < 200]
    print(f"Neither compacted nor quantised: {', '.join(before)}.\n" if before else "\n")
    print(
        "| | AC zeros (degree 1 / 2 / 3) | mean non-zero, steps | PSNR, uncompressed | uncompacted | photographs |\n"
        "|---|---|---|---|---|---|"
    )
    for row in result["rows"]:
        degrees = " / ".join(f"{100 * z:.1f}" for z in row["by degree"])
        ground_truth = f"{row['ground_truth']:.3f}" if "ground_truth" in row else "–"
        print(
            f"| {row['label']} | {100 * row['zeros']:.2f} % ({degrees}) | {row['magnitude']:.2f} "
            f"| {row['uncompressed']:.2f} | {row['uncompacted']:.2f} | {ground_truth} |"
        )
    photographed = "ground_truth" in result["rows"][0]
    columns = ["α", "AC zeros", "PSNR, uncompacted", *(["lost on the photographs"] if photographed else [])]
    print(f"\n| {' | '.join(columns)} |\n" + "|---" * len(columns) + "|")
    for alpha in ALPHAS:
        rows = [r for r in result["rows"] if r["label"].startswith(f"α = {alpha:g}, λ = 10^")]
        zeros = [r["zeros"] for r in rows]
        for share in SHARES:
            if not zeros[0] <= share <= zeros[-1]:
                continue
            cells = [f"{np.interp(share, zeros, [r['uncompacted'] for r in rows]):.1f} dB"]
            if photographed:
                left = float(np.interp(share, zeros, [r["ground_truth"] for r in rows]))
                cells.append(f"{result['rows'][0]['ground_truth'] - left:.2f} dB")
            print(f"| {alpha:g} | {100 * share:g} % | {' | '.join(cells)} |")
    print("\n| λ (α = 0.9) | AC zeros | from views of half the size | the same, low-pass of full size |")
    print("|---|---|---|---|")
    for row in result["resolution"]:
        shares = " | ".join(f"{100 * v:.2f} %" for k, v in row.items() if k != "lambda")
        print(f"| {row['lambda']:g} | {shares} |")


def plot(results: list[dict[str, Any]], file: Path) -> None:
    """Sparsity, magnitude and PSNR against λ, a column a scene, as the paper draws them."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(3, len(results), figsize=(4.2 * len(results), 9), sharex=True, squeeze=False)
    for column, result in zip(axes.T, results, strict=True):
        ground_truth = "ground_truth" in result["rows"][0]
        quantities = ("zeros", "magnitude", "ground_truth" if ground_truth else "uncompacted")
        kind = "pruned" if result["pruned"] else "not pruned"
        column[0].set_title(f"{result['scene']}, {kind}, {result['splats']:,} splats", fontsize=10)
        column[2].set_xlabel("λ")
        labels = {
            "zeros": "AC coefficients that are 0, %",
            "magnitude": "mean |AC| that is not 0, steps",
            "ground_truth": "PSNR, photographs, dB",
            "uncompacted": "PSNR, same splats uncompacted, dB",
        }
        for axis, quantity in zip(column, quantities, strict=True):
            factor = 100 if quantity == "zeros" else 1
            for alpha in ALPHAS:
                rows = [r for r in result["rows"] if r["label"].startswith(f"α = {alpha:g}, λ = 10^")]
                values = [factor * r[quantity] for r in rows]
                axis.semilogx([r["lam"] for r in rows], values, marker=".", label=f"α = {alpha:g}")
            by_label = {r["label"]: r for r in result["rows"]}
            for label, style in (("no compaction", "--"), ("AC set to 0", ":")):
                if quantity != "magnitude" or label == "no compaction":
                    axis.axhline(factor * by_label[label][quantity], color="0.4", linestyle=style, label=label)
            axis.set_ylabel(labels[quantity])
            axis.grid(alpha=0.3)
        column[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--every", type=int, default=1, help="render every so many-th test view")
    parser.add_argument("--powers", nargs="+", type=float, default=POWERS, help="of ten that λ takes")
    parser.add_argument("--json", type=Path, help="where to keep the figures")
    parser.add_argument("--from", dest="kept", type=Path, help="figures that were kept")
    parser.add_argument("--png", type=Path, help="where to draw the figures")
    args = parser.parse_args()
    results: list[dict[str, Any]] = json.loads(args.kept.read_text()) if args.kept else []
    for result in results:
        show(result)
    device = Device(args.device) if args.scenes else None
    for folder in args.scenes:
        assert device is not None
        for result in measure(device, folder, args.every, args.powers):
            show(result)
            results.append(result)
            if args.json:
                args.json.write_text(json.dumps(results))
    if args.png:
        plot(results, args.png)


if __name__ == "__main__":
    main()
