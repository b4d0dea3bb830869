"""Make tests/data/foreign, the excerpt in splat-transform's formats, and tests/data/other_tools: some splats in those
of more tools, and how splat-transform reads each.

    python -m tools.make.other_tools PLUSH.ply --modules FOLDER [--node NODE] [--python PYTHON]

FOLDER is where npm has installed @playcanvas/splat-transform (it wants Node 22), @mkkellogg/gaussian-splats-3d, three
and spz-js. PYTHON has gaussforge, gsply and ply2splat. All is made anew.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from potr_cl.formats.scenes import ply
from tools.workloads import TEST_DATA

_DATA = TEST_DATA.resolve() / "other_tools"
_SPLATS = 150
#: Of tests/data/foreign: names, and what splat-transform is told besides.
_FOREIGN: dict[str, tuple[str, ...]] = {
    "version_3.spz": ("--spz-version", "3"),
    "version_4.spz": (),
    "degree_1.spz": ("--filter-harmonics", "1"),
    "degree_0.sog": ("--filter-harmonics", "0"),
    "degree_3.sog": (),
    "degree_3.compressed.ply": (),
    "degree_0.compressed.ply": ("--filter-harmonics", "0"),
}
_KSPLATS = {"GaussianSplats3D_level_0.ksplat": (0, 2), "GaussianSplats3D_level_1.ksplat": (1, 1)}
_KSPLATS |= {"GaussianSplats3D_level_2.ksplat": (2, 2)}
#: Run by PYTHON in the folder, with the PLY's path.
_PYTHON_TOOLS = """
import sys
import gaussforge, gsply, ply2splat
data = open(sys.argv[1], "rb").read()
for name, form, version in (
    ("gaussforge.splat", "splat", 3), ("gaussforge.ksplat", "ksplat", 3), ("gaussforge.sog", "sog", 3),
    ("gaussforge_version_2.spz", "spz", 2), ("gaussforge_version_4.spz", "spz", 4),
):
    open(name, "wb").write(gaussforge.GaussForge().convert(data, "ply", form, False, version)["data"])
gsply.write_spz("gsply_version_3.spz", gsply.plyread(sys.argv[1]), version=3)
ply2splat.convert(sys.argv[1], "ply2splat.splat")
"""
_SPZ_JS = """
import * as fs from "fs";
import { pathToFileURL } from "url";
const S = await import(pathToFileURL(process.argv[1] + "/node_modules/spz-js/dist/index.js").href);
const cloud = await S.loadPly(new Blob([fs.readFileSync(process.argv[2])]).stream());
fs.writeFileSync(process.argv[3], Buffer.from(await S.serializeSpz(cloud)));
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="the whole scene plush")
    parser.add_argument("--modules", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--node", default="node")
    parser.add_argument("--python", default=sys.executable)
    args = parser.parse_args()
    modules, source = args.modules.resolve(), _DATA / "plush.ply"
    cli = modules / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    shutil.rmtree(_DATA, ignore_errors=True)
    _DATA.mkdir()
    scene = ply.load(args.scene)
    distance = np.abs(scene.means - np.median(scene.means, axis=0)).max(axis=1)
    ply.save(source, scene.subset(np.sort(np.argsort(distance, kind="stable")[:_SPLATS])))

    def transform(*arguments: str | Path) -> None:
        command = [args.node, cli, "-q", "-w", "-g", "cpu", *arguments]
        subprocess.run(list(map(str, command)), check=True)

    for name, options in _FOREIGN.items():  # those before the output apply to the splats, others may stand anywhere
        transform(TEST_DATA / "plush_excerpt.ply", *options, TEST_DATA / "foreign" / name)
    for name in ("splat-transform.splat", "splat-transform.glb", "splat-transform_sog/meta.json"):
        transform(source, _DATA / name)
    with tempfile.TemporaryDirectory() as scratch:
        # Levels of detail in several chunks, and what is far away as environment. Chunks are a unit wide or more.
        fine, coarse, far = (Path(scratch, f"{name}.ply") for name in ("fine", "coarse", "far"))
        transform(source, "-s", "100", fine)
        ply.save(coarse, ply.load(fine).subset(np.arange(0, _SPLATS, 3)))
        transform(source, "-t", "100,0,0", "-H", "0", far)
        levels: list[str | Path] = [fine, "-l", "0", coarse, "-l", "1", far, "-l", "-1"]
        chunks = ["--lod-chunk-extent", "1", "--lod-chunk-min", "0"]
        transform(*chunks, *levels, _DATA / "splat-transform_lod" / "lod-meta.json")
    for name, (level, degree) in _KSPLATS.items():
        script = Path(__file__).with_name("ksplat.mjs").resolve()
        command = [args.node, "--no-warnings", script, source, _DATA / name, level, degree, 0.05, 16]
        subprocess.run(list(map(str, command)), check=True, cwd=modules)
    command = [args.node, "--input-type=module", "-e", _SPZ_JS, modules, source, _DATA / "spz-js.spz"]
    subprocess.run(list(map(str, command)), check=True)
    subprocess.run([args.python, "-c", _PYTHON_TOOLS, str(source)], check=True, cwd=_DATA)

    expected = _DATA / "as_splat-transform_reads_it"
    expected.mkdir()
    for path in sorted(_DATA.iterdir()):
        if path.suffix in (".splat", ".ksplat", ".spz", ".sog"):
            transform(path, expected / f"{path.name}.ply")
    transform(_DATA / "splat-transform_sog" / "meta.json", expected / "splat-transform_sog.ply")
    for level in (0, 1):
        transform("-L", str(level), _DATA / "splat-transform_lod" / "lod-meta.json", expected / f"level_{level}.ply")
    # It does not read glTF, whose axes it turns when it writes one.
    transform(source, "-r", "0,0,180", expected / "splat-transform.glb.ply")


if __name__ == "__main__":
    main()
