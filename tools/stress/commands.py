"""Every command that writes files, on a small scene: what signals and repetitions are tried on (:func:`commands`)."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
from contextlib import suppress
from pathlib import Path

from PIL import Image

from potr_cl.api.pictures import render
from potr_cl.errors import DataError
from potr_cl.formats import load_scene, save_scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tests.reference.scenes import ring_of_cameras, visible_scene
from tools.results import ROOT
from tools.workloads import camera_entry

SPLATS, VIEWS, SIDE = 400, 6, 48


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line.

    Attributes:
        name: for tables.
        arguments: after ``potr-cl``; those that begin with "in/" or "out/" are files.
        outputs: that it writes, in the folder "out".
        repeats: whether each run makes the same bytes; a report tells of times.
        ends_early: whether the first SIGINT may only end a fit: what is written then is whole, and not the usual file.
    """

    name: str
    arguments: tuple[str, ...]
    outputs: tuple[str, ...]
    repeats: bool = True
    ends_early: bool = False

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
        Command("encode --report", (*_ENCODE, "--report", "out/a.html"), ("scene.potr", "a.html"), repeats=False),
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
            ends_early=True,
        ),
        Command(
            "encode --photos", (*_ENCODE, "--photos", "in/photos", "--fit", "60"), ("scene.potr",), ends_early=True
        ),
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
            ends_early=True,
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


def is_whole(path: Path) -> bool:
    """Whether a file of which there is no equal copy is complete: a report, a picture, or a scene."""
    if path.suffix == ".html":
        return path.read_bytes().rstrip().endswith(b"</html>")
    if path.suffix == ".png":
        with Image.open(path) as image:
            image.load()
        return True
    if path.suffix in (".potr", ".ply"):
        with suppress(DataError):
            return len(load_scene(path)) > 0
    return False
