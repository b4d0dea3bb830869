"""Levels of detail: how close is each to the full scene where it is shown, and do leaves' errors foretell pictures'?

    python -m tools.bench.levels SCENE FOLDER/lod-meta.json [--views N] [--budgets PART …] [--json FILE]

The folder is streamed SOG, by any tool. Two tables, both of held-out views:

- of each level: PSNR against the full scene in views that are smaller by √½ a level, for which our levels are made, and
  against the level before it there; the same where one does not see a viewer change from one to the other, or hardly;
- of budgets: the levels that PlayCanvas' engine would show of each leaf in each view for so many splats (coverage ×
  error removed / splats added, until one does not fit), the PSNR of that, and how far the sum of coverage × error is
  from the squared error that the picture really has against the finest level, the median over the views.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl import load_cameras, load_scene
from potr_cl.levels.errors import coverage
from potr_cl.levels.plan import scale_of_level, scaled
from potr_cl.levels.seams import scales_shown
from potr_cl.model.camera import Camera, test_views
from potr_cl.model.scene import Scene, joined
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tools.results import Results

Picture = NDArray[np.float32]


class Streamed:
    """A folder of levels, with its leaves.

    Attributes:
        scenes: of the levels, the finest first.
        boxes: (leaves, 6).
        counts, errors: (leaves, levels), of splats, and what each level loses.
    """

    def __init__(self, path: Path) -> None:
        meta = json.loads(path.read_text())
        leaves = list(_leaves(meta["tree"]))
        levels = meta["lodLevels"]
        self.scenes = [load_scene(f"{path}#{level}") for level in range(levels)]
        self.boxes = np.array([[*leaf["bound"]["min"], *leaf["bound"]["max"]] for leaf in leaves])
        parts = [[leaf["lods"].get(str(level)) for level in range(levels)] for leaf in leaves]
        self.counts = np.array([[part["count"] if part else 0 for part in own] for own in parts])
        if meta.get("lodErrors"):
            self.errors = np.array([leaf["errors"] for leaf in leaves], float)
        else:
            self.errors = np.log(np.maximum(self.counts[:, :1], 1) / np.maximum(self.counts, 1))
        self._starts: list[list[int]] = []
        for level in range(levels):
            own = [leaf[level] for leaf in parts]
            ends: dict[int, int] = {}
            for part in filter(None, own):
                ends[part["file"]] = max(ends.get(part["file"], 0), part["offset"] + part["count"])
            first, behind = {}, 0
            for file in sorted(ends):  # as the reader joins them
                first[file], behind = behind, behind + ends[file]
            self._starts.append([first[part["file"]] + part["offset"] if part else 0 for part in own])

    def shown(self, levels: NDArray[np.int64]) -> Scene:
        """The scene of which each leaf shows its own level."""
        parts = []
        for level, scene in enumerate(self.scenes):
            leaves = np.flatnonzero(levels == level)
            rows = [np.arange(self._starts[level][k], self._starts[level][k] + self.counts[k, level]) for k in leaves]
            if rows and sum(map(len, rows)):
                parts.append(scene.subset(np.sort(np.concatenate(rows))))
        return joined(parts)

    def within(self, view: Camera, budget: float) -> NDArray[np.int64]:
        """The level of each leaf for a budget of splats in a view."""
        levels = np.full(len(self.boxes), len(self.scenes) - 1)
        covered = coverage(view, self.boxes)

        def upgrade(leaf: int) -> tuple[float, int]:
            level = levels[leaf]
            added = max(self.counts[leaf, level - 1] - self.counts[leaf, level], 1)
            return -covered[leaf] * (self.errors[leaf, level] - self.errors[leaf, level - 1]) / added, leaf

        spent = self.counts[:, -1].sum()
        waiting = [upgrade(leaf) for leaf in range(len(levels))] if len(self.scenes) > 1 else []
        heapq.heapify(waiting)
        while waiting:
            _, leaf = heapq.heappop(waiting)
            spent += self.counts[leaf, levels[leaf] - 1] - self.counts[leaf, levels[leaf]]
            if spent > budget:
                break
            levels[leaf] -= 1
            if levels[leaf]:
                heapq.heappush(waiting, upgrade(leaf))
        return levels


def _leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if "children" not in node:
        yield node
    for child in node.get("children", []):
        yield from _leaves(child)


def pictures(device: Device, scene: Scene, views: list[Camera]) -> list[Picture]:
    """Of some views, clipped as screens do."""
    with Rasterizer(device, scene) as rasterizer:
        return [rasterizer.render(view)[0].clip(0, 1) for view in views]


def decibels(errors: list[float]) -> float:
    """The mean PSNR of some views' mean squared errors."""
    return float(np.mean([-10 * math.log10(max(error, 1e-12)) for error in errors]))


def differences(some: list[Picture], others: list[Picture]) -> list[float]:
    """Mean squared errors, view by view."""
    return [float(np.square(a - b).mean(dtype=np.float64)) for a, b in zip(some, others, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with point_cloud.ply and cameras.json")
    parser.add_argument("folder", type=Path, help="lod-meta.json")
    parser.add_argument("--views", type=int, default=13, help="held-out views, spread evenly")
    parser.add_argument("--budgets", type=float, nargs="*", default=(0.75, 0.5, 0.25), help="parts of the finest level")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    device = Device()
    results = Results(device.info, args.json)
    full, streamed = load_scene(args.scene / "point_cloud.ply"), Streamed(args.folder)
    given = test_views(load_cameras(args.scene / "cameras.json"))
    views = [given[k] for k in np.linspace(0, len(given) - 1, min(args.views, len(given))).round().astype(int)]
    name = args.scene.name
    table = results.table(
        f"levels_{name}", f"Levels of {name}, in views of the size in which each is shown",
        "level; splats||,; of the scene|%|.1f; size of views||.2f; PSNR|dB|.2f; PSNR against the level before|dB|.2f; "
        "shown from, size of views||.2f; PSNR there|dB|.2f; against the level before there|dB|.2f",
    )  # fmt: skip
    scales = scales_shown(device, streamed.scenes.__getitem__, len(streamed.scenes), views)
    for level, scene in enumerate(streamed.scenes):
        cells: list[float | None] = []
        for scale in (scale_of_level(level), scales[level]):
            small = scaled(views, scale)
            own = pictures(device, scene, small)
            finer = pictures(device, streamed.scenes[level - 1], small) if level else []
            cells += [scale, decibels(differences(own, pictures(device, full, small)))]
            cells.append(decibels(differences(finer, own)) if level else None)
        table.add(level, len(scene), 100 * len(scene) / len(full), *cells)
    table = results.table(
        f"budgets_{name}", f"What is shown of {name} for a budget of splats, {len(streamed.boxes)} leaves",
        "budget||,; splats shown||,; PSNR|dB|.2f; error against the finest|dB|.2f; foretold|dB|.2f; "
        "off, median|dB|.2f",
    )  # fmt: skip
    whole, finest = pictures(device, full, views), pictures(device, streamed.scenes[0], views)
    for part in args.budgets:
        budget = int(part * len(streamed.scenes[0]))
        shown, errors, real, told = [], [], [], []
        for view, full_picture, fine in zip(views, whole, finest, strict=True):
            levels = streamed.within(view, budget)
            scene = streamed.shown(levels)
            (picture,) = pictures(device, scene, [view])
            shown.append(len(scene))
            errors += differences([picture], [full_picture])
            real += differences([picture], [fine])
            leaves = np.arange(len(levels))
            told.append(float((coverage(view, streamed.boxes) * streamed.errors[leaves, levels]).sum()))
        off = np.median([abs(10 * math.log10(max(a, 1e-12) / max(b, 1e-12))) for a, b in zip(told, real, strict=True)])
        table.add(budget, round(float(np.mean(shown))), decibels(errors), decibels(real), decibels(told), float(off))


if __name__ == "__main__":
    main()
