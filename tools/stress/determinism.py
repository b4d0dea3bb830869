"""Run every command that writes twice, on a small scene, and see that it writes the same bytes.

    python -m tools.stress.determinism [--command NAME …] [--json FILE]

The second run has another seed of Python's hashes, another folder, time zone, number of threads, and comes at least
two seconds later: what a file would hold of any of that shows. Reports (.html) tell of times and are left out.
"""

from __future__ import annotations

import dataclasses
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

SPLATS, VIEWS, SIDE = 400, 6, 48
_CIRCUMSTANCES = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "2", "TZ": "Asia/Tokyo", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
)


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line.

    Attributes:
        name: for tables.
        arguments: after ``potr-cl``; those that begin with "in/" or "out/" are files.
        outputs: that it writes, in the folder "out".
    """

    name: str
    arguments: tuple[str, ...]
    outputs: tuple[str, ...]

    def argv(self) -> list[str]:
        return [sys.executable, "-m", "potr_cl", *self.arguments]


_VIEWS = ("--cameras", "in/cameras.json")
_ENCODE = ("encode", "in/scene.ply", *_VIEWS, "-o", "out/scene.potr")


def commands() -> list[Command]:
    """All of them, in the order of the help."""
    return [
        Command("encode", _ENCODE, ("scene.potr",)),
        Command("encode, preset paper", (*_ENCODE, "--preset", "paper", "--no-quality"), ("scene.potr",)),
        Command(
            "encode without pruning",
            ("encode", "in/scene.ply", "-o", "out/scene.potr", "--no-prune", "--no-compact", "--refit", "off"),
            ("scene.potr",),
        ),
        Command("encode --max-size", (*_ENCODE, "--max-size", "12k", "--no-quality"), ("scene.potr",)),
        Command("encode --min-psnr", (*_ENCODE, "--min-psnr", "35"), ("scene.potr",)),
        Command(
            "encode --ladder",
            ("encode", "in/scene.ply", *_VIEWS, "-o", "out", "--ladder", "0.2,0.6"),
            ("scene_q0.2.potr", "scene_q0.6.potr", "ladder.json"),
        ),
        Command(
            "encode, preset smallest",
            (*_ENCODE, "--preset", "smallest", "-q", "0.2", "--iterations", "8", "--fit", "150", "--no-quality"),
            ("scene.potr",),
        ),
        Command("encode --photos", (*_ENCODE, "--photos", "in/photos", "--fit", "60"), ("scene.potr",)),
        Command(
            "prune --order",
            ("prune", "in/scene.ply", *_VIEWS, "-o", "out/a.ply", "--order", "out/a.npy"),
            ("a.ply", "a.npy"),
        ),
        Command("compact", ("compact", "in/scene.ply", *_VIEWS, "-o", "out/a.ply"), ("a.ply",)),
        Command(
            "refit", ("refit", "in/scene.potr", "--reference", "in/scene.ply", *_VIEWS, "-o", "out/a.ply"), ("a.ply",)
        ),
        Command(
            "fit",
            ("fit", "in/scene.potr", "--reference", "in/scene.ply", *_VIEWS, "-o", "out/a.ply", "--steps", "20"),
            ("a.ply",),
        ),
        Command("decode", ("decode", "in/scene.potr", "-o", "out/a.ply"), ("a.ply",)),
        *(
            Command(f"convert to {suffix}", ("convert", "in/scene.potr", f"out/a.{suffix}"), (f"a.{suffix}",))
            for suffix in ("ply", "compressed.ply", "spz")
        ),
        Command(
            "render",
            ("render", "in/scene.ply", *_VIEWS, "-o", "out", "--split", "all"),
            tuple(f"view_{k}.png" for k in range(VIEWS)),
        ),
        Command("compare -o", ("compare", "in/scene.ply", "in/scene.potr", *_VIEWS, "-o", "out/a.png"), ("a.png",)),
    ]


def prepare(folder: Path) -> dict[str, str]:
    """Make the inputs in ``folder/in``; their hashes by name."""
    inputs = folder / "in"
    inputs.mkdir(parents=True)
    (folder / "out").mkdir()
    (folder / "tmp").mkdir()
    scene = visible_scene(SPLATS, 1, seed=1)
    cameras = ring_of_cameras(VIEWS, size=SIDE)
    save_scene(inputs / "scene.ply", scene)
    coded = encode(scene, None, EncodeOptions().changed(prune=False, compact=False, refit=False))
    (inputs / "scene.potr").write_bytes(b"".join(coded.pieces))
    (inputs / "cameras.json").write_text(json.dumps([camera_entry(n, view) for n, view in enumerate(cameras)]))
    render(scene, cameras, output=inputs / "photos")
    return hashes(inputs)


def environment(folder: Path, **more: str) -> dict[str, str]:
    """For a command: temporary files go to ``folder/tmp``, what drivers keep to ``folder/cache``."""
    cache = os.fspath(folder / "cache")
    return {
        **os.environ, "PYTHONPATH": os.fspath(ROOT), "TMPDIR": os.fspath(folder / "tmp"), "XDG_CACHE_HOME": cache,
        "POCL_CACHE_DIR": cache, **more,
    }  # fmt: skip


def hashes(folder: Path) -> dict[str, str]:
    """The SHA-256 of every file of a folder by its name, those in folders within it too."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--command", action="append", choices=[each.name for each in commands()], dest="names")
    args = parser.parse_args()
    chosen = [each for each in commands() if args.names is None or each.name in args.names]
    columns = "command; files; bytes||,; same bytes"
    table = Results(None, args.json).table("determinism", "Every command twice, in other circumstances", columns)
    different = []
    with tempfile.TemporaryDirectory() as scratch:
        runs, sizes = [], {}
        for number, circumstances in enumerate(_CIRCUMSTANCES):
            folder = Path(scratch, f"run {number}")
            inputs = prepare(folder)
            time.sleep(2 * number)  # time stamps of FAT and of MS-DOS are that coarse
            runs.append({command.name: _run(folder, command, circumstances) for command in chosen})
            if hashes(folder / "in") != inputs:
                raise RuntimeError("a command changed its input")
            sizes = {
                command.name: sum((folder / "out" / _place(command) / name).stat().st_size for name in command.outputs)
                for command in chosen
            }
        for command in chosen:
            one, other = (run[command.name] for run in runs)
            same = sum(one[name] == other[name] for name in command.outputs)
            table.add(command.name, len(command.outputs), sizes[command.name], "yes" if one == other else "no")
            if same != len(command.outputs):
                different.append(command.name)
    sys.exit(f"other bytes the second time: {', '.join(different)}" if different else 0)


def _run(folder: Path, command: Command, circumstances: dict[str, str]) -> dict[str, str]:
    """The hashes of what a command writes."""
    place = folder / "out" / _place(command)
    place.mkdir()
    argv = [part.replace("out", f"out/{place.name}", 1) if part.startswith("out") else part for part in command.argv()]
    done = subprocess.run(
        argv, cwd=folder, env=environment(folder, **circumstances), capture_output=True, text=True, check=False
    )
    written = hashes(place)
    if done.returncode != 0 or set(written) != set(command.outputs):
        raise RuntimeError(f"{command.name} fails:\n{done.stderr}")
    return written


def _place(command: Command) -> str:
    return command.name.replace(" ", "_")


if __name__ == "__main__":
    main()
