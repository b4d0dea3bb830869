"""Which levels are shown for a budget of splats: as the engine's own code chooses, and what is said of it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import potr_cl
from potr_cl import DataError
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats import load_cameras
from potr_cl.formats.scenes.sog_levels import StreamedScene
from potr_cl.levels.budgets import by_distance, by_errors
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Request
from potr_cl.outputs.potr import Potr
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.streamed_sog import StreamedSog
from potr_cl.raster.rasterizer import Rasterizer
from tests.cases.scenes import rows_of
from tests.cases.web import WEB
from tests.cli.calls import fails, run

ENGINE = WEB / "node_modules" / "playcanvas" / "build" / "playcanvas" / "src"
NODE = shutil.which("node")
LEVELS = (1500, 700, 300)


@dataclass
class Leaves:
    boxes: Any
    counts: Any
    errors: Any = None

    def shown(self, levels: Any) -> Scene:
        raise NotImplementedError


def random_leaves(leaves: int = 60, levels: int = 4, seed: int = 3) -> Leaves:
    random = np.random.default_rng(seed)
    low = random.normal(0, 6, (leaves, 3))
    counts = random.integers(200, 2000, (leaves, 1)) // 2 ** np.arange(levels)
    counts[random.random(counts.shape) < 0.1] = 0  # some leaves lack a level, or all
    errors = np.cumsum(random.random((leaves, levels)) * (np.arange(levels) > 0), axis=1)
    return Leaves(np.concatenate([low, low + random.gamma(2, 2, (leaves, 3))], axis=1), counts, errors)


_IN_NODE = """
const [, engine, cases] = process.argv;
const load = (name) => import(`file://${engine}/${name}`);
const { GSplatBudgetBalancer } = await load('scene/gsplat-unified/gsplat-budget-balancer.js');
const { GSplatOctreeInstance } = await load('scene/gsplat-unified/gsplat-octree-instance.js');
const { GSplatOctree } = await load('scene/gsplat-unified/gsplat-octree.js');
const { GSplatLodTable } = await load('scene/gsplat-unified/gsplat-lod-table.js');
const { Mat4 } = await load('core/math/mat4.js'), { Vec3 } = await load('core/math/vec3.js');
const { boxes, counts, views, budgets } = JSON.parse(cases), levels = counts[0].length;
const leaf = (own, k) => ({
  bound: { min: boxes[k].slice(0, 3), max: boxes[k].slice(3) },
  lods: Object.fromEntries(own.map((count, k) => [k, { file: 0, offset: 0, count }])),
});
const tree = { children: counts.map(leaf) };
const octree = new GSplatOctree('a/lod-meta.json', { lodLevels: levels, filenames: ['a'], tree });
const own = Object.create(GSplatOctreeInstance.prototype);
const node = { getWorldTransform: () => new Mat4(), getPosition: () => new Vec3() };
Object.assign(own, {
  octree, placement: { node, lodBaseDistance: 5, lodMultiplier: 3 }, rangeMin: 0, rangeMax: levels - 1,
  nodeInfos: counts.map(() => ({})), lodTable: new GSplatLodTable(octree, 0, levels - 1),
});
const found = views.map(({ position, forward, fov, aspect }) => budgets.map((budget) => {
  const lens = { projection: 0, aspectRatio: aspect, fov, horizontalFov: false };
  const camera = { camera: lens, forward: new Vec3(forward), getPosition: () => new Vec3(position) };
  own.evaluateNodeDistances(camera, { lodBehindPenalty: 1.5, lodDistanceShrink: 0.75 });
  new GSplatBudgetBalancer().balance(new Map([[0, own]]), budget, false);
  return own.nodeInfos.map((info) => info.optimalLod);
}));
console.log(JSON.stringify(found));
"""


@pytest.mark.skipif(NODE is None or not ENGINE.exists(), reason="npm's playcanvas is not installed: npm ci in web/")
def test_levels_by_distance_are_those_of_the_engine(plush_excerpt_cameras: list[Camera]) -> None:
    leaves, budgets = random_leaves(), [1, 9000, 20_000, 40_000, 60_000, 10**6]
    views = [*plush_excerpt_cameras[:3], replace(plush_excerpt_cameras[0], width=900, fx=200.0)]
    cases = {
        "boxes": leaves.boxes.tolist(),
        "counts": leaves.counts.tolist(),
        "budgets": budgets,
        "views": [
            {
                "position": view.centre.tolist(),
                "forward": view.rotation[2].tolist(),
                "fov": float(np.degrees(2 * np.arctan(view.height / 2 / view.fy))),
                "aspect": view.width / view.fx / (view.height / view.fy),
            }
            for view in views
        ],
    }
    assert NODE is not None
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", _IN_NODE, str(ENGINE), json.dumps(cases)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    seen = set()
    for view, chosen in zip(views, json.loads(done.stdout), strict=True):
        for budget, theirs in zip(budgets, chosen, strict=True):
            ours = by_distance(leaves, view, budget)
            shows = [level < 4 and leaves.counts[leaf, level] > 0 for leaf, level in enumerate(theirs)]
            assert np.where(shows, theirs, -1).tolist() == ours.tolist()
            seen.add(ours.tobytes())
    assert len(seen) > 12


def test_levels_by_errors_take_what_removes_most_for_a_splat(plush_excerpt_cameras: list[Camera]) -> None:
    """Of two leaves of one size at one distance, the one with the larger error; and no more than the budget."""
    view = plush_excerpt_cameras[0]
    centre, right = view.centre + 4 * view.rotation[2], view.rotation[0]
    boxes = np.array([[*(centre + x * right - 0.1), *(centre + x * right + 0.1)] for x in (-1, 1)])
    counts = np.array([[100, 50, 25], [100, 50, 25]])
    errors = np.array([[0, 1, 3], [0, 10, 30.0]])
    leaves = Leaves(boxes, counts, errors)
    chosen = {budget: by_errors(leaves, view, budget).tolist() for budget in (10, 75, 124, 125, 149, 150, 200)}
    assert chosen == {10: [2, 2], 75: [2, 1], 124: [2, 1], 125: [2, 0], 149: [2, 0], 150: [1, 0], 200: [0, 0]}
    # A level that another one beats with fewer splats is never shown, nor what a leaf lacks.
    leaves.counts[1], leaves.errors[0] = [100, 0, 25], [0, 5, 3]
    assert [by_errors(leaves, view, budget).tolist() for budget in (125, 200)] == [[2, 0], [0, 0]]


@pytest.fixture(scope="module")
def files(plush_excerpt: Scene, tmp_path_factory: Any) -> tuple[Path, Path]:
    """Streamed SOG and a .potr, with levels that are the first splats of the scene."""

    class Told:
        def far(self, scene: Scene) -> Any:
            return np.zeros(len(scene), bool)

        def of_level(self, level: int) -> float:
            return float(level)

        def of_leaves(self, scenes: Any, levels: int, leaves: Any) -> Any:
            return np.arange(1, len(leaves().boxes) + 1)[:, None] * np.arange(levels)

    folder, request = tmp_path_factory.mktemp("levels"), Request(HyperParameters.from_quality(0.5, "best"))
    found = []
    for output, part, name in ((StreamedSog(lod_chunk_count=1), Sog(), "lod-meta.json"), (Potr(), Potr(), "a.potr")):
        own = [b"".join(part.file(plush_excerpt.subset(np.arange(n)), None, request).pieces) for n in LEVELS]
        with (folder / name).open("wb") as file:
            pieces = output.levelled(own, Told(), lambda level, own=own, part=part: part.read(own[level]))
            output.write(pieces, file, folder / name)
        found.append(folder / name)
    return found[0], found[1]


def test_files_are_read_as_they_are_shown(files: tuple[Path, Path]) -> None:
    streamed = StreamedScene(files[0])
    assert streamed.counts.sum(axis=0).tolist() == list(LEVELS)
    assert len(streamed.counts) > 1
    for level, count in enumerate(LEVELS):
        shown = streamed.shown(np.full(len(streamed.counts), level))
        assert len(shown) == count
        assert np.array_equal(
            np.sort(shown.means[:, 0]), np.sort(potr_cl.load_scene(f"{files[0]}#{level}").means[:, 0])
        )
    mixed = np.arange(len(streamed.counts)) % 3 - 1
    shown = streamed.shown(mixed)
    assert len(shown) == sum(streamed.counts[leaf, level] for leaf, level in enumerate(mixed) if level >= 0)
    broken = files[0].parent / "broken" / "lod-meta.json"
    shutil.copytree(files[0].parent, broken.parent, ignore=shutil.ignore_patterns("*.potr"))
    shutil.rmtree(broken.parent / "0_0")
    coarse = StreamedScene(broken)  # files are opened when they are shown, not before
    assert len(coarse.shown(np.full(len(coarse.counts), 2))) == LEVELS[2]
    with pytest.raises(DataError, match="has no splats"):
        coarse.shown(np.full(len(coarse.counts), -1))


def test_an_environment_is_shown_besides_what_the_budget_is_for(
    files: tuple[Path, Path], plush_excerpt: Scene, plush_excerpt_cameras: list[Camera], tmp_path: Path
) -> None:
    """As in PlayCanvas' engine."""
    path, views = tmp_path / "sky" / "lod-meta.json", plush_excerpt_cameras[:2]
    shutil.copytree(files[0].parent, path.parent, ignore=shutil.ignore_patterns("*.potr"))
    shutil.copytree(path.parent / "2_0", path.parent / "env")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"environment": "env/meta.json"}))
    streamed = StreamedScene(path)
    sky = potr_cl.load_scene(path.parent / "env")
    assert rows_of(streamed.shown(np.full(len(streamed.counts), -1))) == rows_of(sky)
    both = rows_of(streamed.shown(np.zeros(len(streamed.counts), np.int64)))
    assert both == rows_of(potr_cl.load_scene(f"{files[0]}#0")) | rows_of(sky)
    alone, around = (potr_cl.compare_budgets(plush_excerpt, each, 900, views).shown for each in (files[0], path))
    for before, after in zip(alone, around, strict=True):
        assert after.splats == [splats + len(sky) for splats in before.splats]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda leaf: leaf.pop("bound"), "damaged"),
        (lambda leaf: leaf.update(lods={"0": leaf["lods"]["0"]}, bound={"min": [0] * 6, "max": [1] * 6}), "damaged"),
        (lambda leaf: leaf["bound"].update(min=[1e9, 0, 0]), "a box is invalid"),
        (lambda leaf: leaf.update(errors=[0, 1]), "damaged"),
        (lambda leaf: leaf.update(errors=[0, 1, float("nan")]), "errors of levels are invalid"),
        (lambda leaf: leaf.update(errors=[0, 1, float("inf")]), "errors of levels are invalid"),
    ],
)
def test_what_is_damaged_is_told(change: Any, message: str, files: tuple[Path, Path], tmp_path: Path) -> None:
    meta = json.loads(files[0].read_text())
    leaf = meta["tree"]
    while "children" in leaf:
        leaf = leaf["children"][0]
    change(leaf)
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    with pytest.raises(DataError, match=message):
        StreamedScene(tmp_path)


def test_the_command_compares_what_is_shown(
    files: tuple[Path, Path], data: Path, capsys: Any, tmp_path: Path, plush_excerpt: Scene
) -> None:
    scene, cameras = data / "plush_excerpt.ply", data / "plush_excerpt_cameras.json"
    words = ["compare", scene, *files, "--cameras", cameras, "--budget", "900", "350", "--views", "0", "3", "--json"]
    report = json.loads(run(capsys, *words, "-o", tmp_path / "worst.png", "--curve", tmp_path / "curve.html"))
    assert [file["splats"] for file in report["files"]] == [list(LEVELS)] * 2
    rows = {(row["budget"], Path(row["file"]).name, row["levels_by"]): row for row in report["budgets"]}
    assert set(rows) == {
        (budget, *which)
        for budget in (900, 350)
        for which in (("lod-meta.json", "distance"), ("lod-meta.json", "errors"), ("a.potr", "distance"))
    }
    assert rows[900, "a.potr", "distance"]["splats"] == 700
    assert all(view["splats"] <= 900 for row in rows.values() for view in row["views"])
    # One of them by hand.
    view = load_cameras(cameras)[3]
    streamed = StreamedScene(files[0])
    shown = streamed.shown(by_errors(streamed, view, 900))
    device = Device()
    own, whole = (Rasterizer(device, each).render(view)[0].clip(0, 1) for each in (shown, plush_excerpt))
    row = rows[900, "lod-meta.json", "errors"]["views"][1]
    assert (row["name"], row["splats"]) == (view.name, len(shown))
    assert row["psnr"] == pytest.approx(-10 * np.log10(np.square(own - whole).mean()), abs=0.01)
    assert (tmp_path / "worst.png").stat().st_size > 1000
    page = (tmp_path / "curve.html").read_text()
    assert len(re.findall(r'<polyline points="\S+ \S+"', page)) == 3  # a line a choice, a point a budget
    assert f"<td>{rows[900, 'a.potr', 'distance']['psnr']:.2f} dB</td>" in page
    text = run(capsys, *words[:-1])
    assert "levels by" in text
    assert f"{rows[350, 'a.potr', 'distance']['psnr']:.2f}" in text


def test_wrong_requests_are_told(files: tuple[Path, Path], data: Path, capsys: Any) -> None:
    scene = data / "plush_excerpt.ply"
    fails(capsys, ["compare", scene, *files], 2, "give --budget")
    fails(capsys, ["compare", scene, files[0], "--curve", "a.html"], 2, "give --budget")
    fails(capsys, ["compare", scene, *files, "--budget", "0"], 2, "1 or more")
    fails(capsys, ["compare", scene, *files, "--budget", "5", "--lpips"], 2, "--lpips does not go with --budget")
    with pytest.raises(potr_cl.UsageError, match="1 or more"):
        potr_cl.compare_budgets(scene, files, [])
