"""Levels of detail: how close is each to the full scene where it is shown, and do leaves' errors foretell pictures'?

    python -m tools.bench.levels SCENE FOLDER/lod-meta.json [--views N] [--budgets PART …] [--json FILE]

The folder is streamed SOG, by any tool. Two tables, both of held-out views:

- of each level: PSNR against the full scene in views that are smaller by √½ a level, for which our levels are made, and
  against the level before it there; the same where one does not see a viewer change from one to the other, or hardly;
- of budgets: what PlayCanvas' engine would show for so many splats, by errors where the folder has some and else by
  distance (as ``potr-cl compare --budget``); and how far the sum of coverage × error is from the squared error that the
  picture has against the finest level, the median over the views.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl import compare_budgets, load_scene
from potr_cl.formats.scenes.sog_levels import StreamedScene
from potr_cl.levels.budgets import CHOICES, Levels, coverage
from potr_cl.levels.plan import scale_of_level, scaled
from potr_cl.levels.seams import scales_shown
from potr_cl.model.camera import Camera, test_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.quality.compare import mean_view
from potr_cl.quality.judging import Judging, Looks
from tools.results import Results
from tools.workloads import read, scene_parser

_AGAINST = "b_against_a"


def levels(results: Results, name: str, full: Scene, folder: Path, views: list[Camera], device: Device) -> None:
    """The table of levels."""
    table = results.table(
        f"levels_{name}", f"Levels of {name}, in views of the size in which each is shown",
        "level; splats||,; of the scene|%|.1f; size of views||.2f; PSNR|dB|.2f; PSNR against the level before|dB|.2f; "
        "shown from, size of views||.2f; PSNR there|dB|.2f; against the level before there|dB|.2f",
    )  # fmt: skip

    def psnr(one: Scene, other: Scene, scale: float) -> float:
        small = scaled(views, scale)
        with Judging(device, one, small, Looks()) as judging:
            return mean_view(judging.figures(other)).figures[_AGAINST].psnr

    scenes = [load_scene(f"{folder}#{level}") for level in range(StreamedScene(folder).counts.shape[1])]
    for level, shown_from in enumerate(scales_shown(device, scenes.__getitem__, len(scenes), views)):
        own, cells = scenes[level], list[float | None]()
        for scale in (scale_of_level(level), shown_from):
            cells += [scale, psnr(full, own, scale), psnr(scenes[level - 1], own, scale) if level else None]
        table.add(level, len(own), 100 * len(own) / len(full), *cells)


def budgets(
    results: Results, name: str, full: Scene, folder: Path, views: list[Camera], parts: list[float], device: Device
) -> None:
    """The table of budgets."""
    scene = StreamedScene(folder)
    table = results.table(
        f"budgets_{name}", f"What is shown of {name} for a budget of splats, {len(scene.boxes)} leaves",
        "budget||,; splats shown||,; PSNR|dB|.2f; error against the finest|dB|.2f; foretold|dB|.2f; "
        "off, median|dB|.2f",
    )  # fmt: skip
    by = "distance" if scene.errors is None else "errors"
    wanted = sorted({int(part * scene.counts[:, 0].sum()) for part in parts}, reverse=True)
    whole, finest = (
        [each for each in compare_budgets(a, folder, wanted, views, device=device).shown if each.by == by]
        for a in (full, load_scene(f"{folder}#0"))
    )
    for budget, against, real in zip(wanted, whole, finest, strict=True):
        told = list[float]()
        for view in views if scene.errors is not None else ():
            shown = CHOICES[by](scene, view, budget)
            told.append(10 * math.log10(1 / max(float(coverage(view, scene.boxes) @ _errors(scene, shown)), 1e-12)))
        off = [abs(a - min(view.figures[_AGAINST].psnr, 120)) for a, view in zip(told, real.views, strict=False)]
        figures = (float(np.mean(told)), float(np.median(off))) if told else (None, None)
        table.add(budget, round(float(np.mean(against.splats))), against.psnr, real.psnr, *figures)


def _errors(scene: StreamedScene, shown: Levels) -> NDArray[np.float64]:
    """(leaves,) of what each shows; 0 where that is nothing, of which no error is known."""
    assert scene.errors is not None
    found: NDArray[np.float64] = np.where(shown >= 0, scene.errors[np.arange(len(shown)), shown], 0.0)
    return found


def main() -> None:
    parser = scene_parser(__doc__, 1)
    parser.add_argument("folder", type=Path, help="lod-meta.json")
    parser.add_argument("--views", type=int, default=13, help="held-out views, spread evenly")
    parser.add_argument("--budgets", type=float, nargs="*", default=(0.75, 0.5, 0.25), help="parts of the finest level")
    args = parser.parse_args()
    device, (source,) = Device(args.device), args.scenes
    results = Results(device.info, args.json)
    full, cameras = read(source)
    given = test_views(cameras)
    views = [given[k] for k in np.linspace(0, len(given) - 1, min(args.views, len(given))).round().astype(int)]
    levels(results, source.name, full, args.folder, views, device)
    budgets(results, source.name, full, args.folder, views, args.budgets, device)


if __name__ == "__main__":
    main()
