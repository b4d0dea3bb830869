"""No input is destroyed: outputs that are inputs, or each other, are refused before anything is read or written."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import pytest
from PIL import Image

from potr_cl import cli
from potr_cl.cli import guard
from potr_cl.errors import UsageError
from potr_cl.formats.scenes import ply
from tests.cli.calls import KEEP, cameras_json, refused
from tests.reference.scenes import random_scene, ring_of_cameras


def same_name(source, link):
    """The output is named as the input is."""


def symbolic_link(source, link):
    link.symlink_to(source)


def hard_link(source, link):
    os.link(source, link)


def link_to_its_folder(source, link):
    link.symlink_to(source.parent, target_is_directory=True)


LINKS = [same_name, symbolic_link, hard_link, link_to_its_folder]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with scenes, cameras in a folder of their own, and photographs of their views."""
    monkeypatch.chdir(tmp_path)
    for name in ("i.ply", "j.ply"):
        ply.save(tmp_path / name, random_scene(20, 0))
    (tmp_path / "x.potr").write_bytes(b"POTR, never read")
    cameras = tmp_path / "data"
    (cameras / "images").mkdir(parents=True)
    cameras_json(cameras / "cameras.json", 3)
    for camera in ring_of_cameras(3):
        Image.new("RGB", (camera.width, camera.height)).save(cameras / "images" / f"{camera.name}.png")
    return tmp_path


#: A command, with the input that its output is in the place of; "{out}" stands for that output.
CALLS = [
    ("encode i.ply -o {out}", "i.ply"),
    ("encode i.ply -o new.potr --report {out}", "i.ply"),
    ("encode i.ply -o {out} --cameras data", "data/cameras.json"),
    ("encode i.ply -o {out} --cameras data/cameras.json", "data/cameras.json"),
    ("encode i.ply -o new.potr --report {out} --cameras data", "data/cameras.json"),
    ("encode i.ply -o {out} --cameras data", "data/images/view_1.png"),
    ("encode i.ply -o {out} --cameras data --photos data/images", "data/images/view_1.png"),
    ("decode x.potr -o {out}", "x.potr"),
    ("prune i.ply -o {out}", "i.ply"),
    ("prune i.ply -o new.ply --order {out}", "i.ply"),
    ("prune i.ply -o new.ply --order {out} --cameras data", "data/cameras.json"),
    ("compact i.ply -o {out}", "i.ply"),
    ("refit i.ply --reference j.ply -o {out}", "i.ply"),
    ("refit i.ply --reference j.ply -o {out}", "j.ply"),
    ("refit i.ply --reference j.ply -o {out} --cameras data --photos data/images", "data/images/view_2.png"),
    ("fit i.ply --reference j.ply -o {out}", "i.ply"),
    ("fit i.ply --reference j.ply -o {out}", "j.ply"),
    ("fit i.ply --reference j.ply -o {out} --cameras data", "data/cameras.json"),
    ("convert i.ply {out}", "i.ply"),
    ("compare i.ply j.ply --cameras data -o {out}", "i.ply"),
    ("compare i.ply j.ply --cameras data -o {out}", "j.ply"),
    ("compare i.ply j.ply --cameras data --truth data/images -o {out}", "data/images/view_0.png"),
    ("compare i.ply j.ply --cameras data -o {out}", "data/images/view_0.png"),
]


def written_suffix(call: str) -> str:
    """Of the output "{out}" of a call."""
    for option, suffix in (("--report", ".html"), ("--order", ".npy"), ("encode", ".potr"), ("compare", ".png")):
        if option in call:
            return suffix
    return ".ply"


@pytest.mark.parametrize(
    ("call", "target", "link"),
    [*((*CALLS[0], link) for link in LINKS), *((*call, LINKS[n % 2]) for n, call in enumerate(CALLS[1:]))],
)
def test_an_output_that_is_an_input(folder, capsys, call, target, link):
    source = folder / target
    # Links have the suffix that the command writes: another one is reason enough to refuse.
    out = source if link is same_name else folder / f"link{written_suffix(call)}"
    link(source, out)
    if link is link_to_its_folder:
        out = out / source.name
    words = ["would be replaced"]
    if out.name == source.name and source.suffix != written_suffix(call):
        words += ["a name that ends in", "give it one of"]
    refused(capsys, call.format(out=out), *words)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        # The system finds no such name, but a file of this name would be written over i.ply.
        ("encode i.ply -o missing/../i.ply", "would be replaced"),
        *(
            (f"encode i.ply -o new --report {report}", "name the same file")
            for report in ("new", "data/../new", "link/new", "dangling")
        ),
        *((f"prune i.ply -o old --order {order}", "name the same file") for order in ("old", "hard")),
        *(
            (f"render i.ply --cameras {cameras} -o data/images", "view_0.png' is an input too")
            for cameras in ("data", "data/cameras.json")
        ),
        ("render i.ply --cameras data -o out", "view_2.png' is an input too"),
    ],
)
def test_two_names_of_one_file(folder, capsys, call, said):
    (folder / "link").symlink_to(folder, target_is_directory=True)
    (folder / "dangling").symlink_to("new")
    (folder / "old").write_bytes(b"old")
    os.link(folder / "old", folder / "hard")
    (folder / "out").mkdir()
    os.link(folder / "i.ply", folder / "out" / "view_2.png")
    refused(capsys, call, said)


def test_what_is_no_input_may_be_replaced(folder):
    """Outputs in the folder of the cameras, twice; and pictures, twice."""
    keep = ["--no-quality", "--report", "data/out.html", *KEEP]
    for _ in range(2):
        assert cli.main(["encode", "i.ply", "-o", "data/out.potr", "--cameras", "data", *keep]) == 0
        assert cli.main(["render", "i.ply", "--cameras", "data", "-o", "pictures", "--views", "0"]) == 0


def test_every_command_says_of_every_path_what_becomes_of_it():
    parser = cli.command_parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, command in commands.choices.items():
        for action in command._actions:
            assert action.type is not Path, f"{name}: {action.dest}: give it one of the types of {guard.__name__}"


def test_a_path_of_which_nothing_is_said_is_a_mistake():
    with pytest.raises(TypeError, match="'scene' is a path"):
        guard.check(argparse.Namespace(scene=Path("i.ply")))


def test_inputs_may_be_the_same(folder):
    scene = guard.ReadFile(folder / "i.ply")
    guard.check(argparse.Namespace(a=scene, b=scene))
    with pytest.raises(UsageError):
        guard.check(argparse.Namespace(a=scene, outputs=[guard.WrittenFile(folder / "i.ply")]))
