"""Run every command that writes twice, on a small scene, and see that it writes the same bytes.

    python -m tools.stress.determinism [--command NAME …] [--json FILE]

The second run has another seed of Python's hashes, another folder, time zone, number of threads, and comes at least
two seconds later: what a file would hold of any of that shows. Reports (.html) tell of times and are left out.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from potr_cl.api.pictures import render
from potr_cl.formats import save_scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tests.reference.scenes import ring_of_cameras, visible_scene
from tools.results import ROOT, Results
from tools.workloads import camera_entry, plain_parser

_CIRCUMSTANCES = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "2", "TZ": "Asia/Tokyo", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
)
_ENCODE = "encode in/scene.ply -o out/scene.potr"
_SEEN = f"{_ENCODE} --cameras in/cameras.json"
#: The words of each command by its name. "in" is a folder with its inputs, "out" one that is empty when it begins.
COMMANDS = {
    "encode": _SEEN,
    "encode, preset paper": f"{_SEEN} --preset paper --no-quality",
    "encode without pruning": f"{_ENCODE} --no-prune --no-compact --refit off",
    "encode --max-size": f"{_SEEN} --max-size 12k --no-quality",
    "encode --min-psnr": f"{_SEEN} --min-psnr 35",
    "encode --ladder": "encode in/scene.ply -o out --cameras in/cameras.json --ladder 0.2,0.6",
    "encode, preset smallest": f"{_SEEN} --preset smallest -q 0.2 --iterations 8 --fit 150 --no-quality",
    "encode --photos": f"{_SEEN} --photos in/photos --fit 60",
    "prune --order": "prune in/scene.ply -o out/a.ply --cameras in/cameras.json --order out/a.npy",
    "compact": "compact in/scene.ply -o out/a.ply --cameras in/cameras.json",
    "refit": "refit in/scene.potr -o out/a.ply --cameras in/cameras.json --reference in/scene.ply",
    "fit": "fit in/scene.potr -o out/a.ply --cameras in/cameras.json --reference in/scene.ply --steps 20",
    "decode": "decode in/scene.potr -o out/a.ply",
    **{f"convert to {kind}": f"convert in/scene.potr out/a.{kind}" for kind in ("ply", "compressed.ply", "spz")},
    "render": "render in/scene.ply --cameras in/cameras.json -o out --split all",
    "compare -o": "compare in/scene.ply in/scene.potr --cameras in/cameras.json -o out/a.png",
}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--command", action="append", choices=list(COMMANDS), dest="names")
    args = parser.parse_args()
    columns = "command; files; bytes||,; same bytes"
    table = Results(None, args.json).table("determinism", "Every command twice, in other circumstances", columns)
    different = []
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch, f"run {number}") for number in range(2)]
        for folder in folders:
            _prepare(folder / "in")
            time.sleep(2)  # time stamps of FAT and of MS-DOS are that coarse
        for name in args.names or COMMANDS:
            one, other = (_run(*pair, name) for pair in zip(folders, _CIRCUMSTANCES, strict=True))
            table.add(name, len(one), sum(map(len, one.values())), "yes" if one == other else "no")
            different += [name] if one != other else []
    sys.exit(f"other bytes the second time: {', '.join(different)}" if different else 0)


def _prepare(inputs: Path) -> None:
    """Make the inputs."""
    inputs.mkdir(parents=True)
    scene, cameras = visible_scene(400, 1, seed=1), ring_of_cameras(6, size=48)
    save_scene(inputs / "scene.ply", scene)
    encode(scene, None, EncodeOptions().changed(prune=False, compact=False, refit=False)).save(inputs / "scene.potr")
    (inputs / "cameras.json").write_text(json.dumps([camera_entry(n, view) for n, view in enumerate(cameras)]))
    render(scene, cameras, output=inputs / "photos")


def _run(folder: Path, circumstances: dict[str, str], name: str) -> dict[str, bytes]:
    """What a command writes, by the files' names; drivers and libraries keep what they do in folders of its own.

    Raises:
        RuntimeError: it fails, writes nothing, or changes its inputs.
    """
    before, out = _hash(folder / "in"), folder / "out"
    own = {variable: os.fspath(folder / "kept") for variable in ("TMPDIR", "XDG_CACHE_HOME", "POCL_CACHE_DIR")}
    for each in (out, folder / "kept"):
        each.mkdir(exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", "potr_cl", *COMMANDS[name].split()], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.fspath(ROOT), **own, **circumstances}, check=False,
    )  # fmt: skip
    written = {path.name: path.read_bytes() for path in sorted(out.iterdir())}
    if done.returncode != 0 or not written or _hash(folder / "in") != before:
        raise RuntimeError(f"'{name}' fails, or changes its inputs:\n{done.stderr}")
    for path in out.iterdir():
        path.unlink()
    return written


def _hash(folder: Path) -> str:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


if __name__ == "__main__":
    main()
