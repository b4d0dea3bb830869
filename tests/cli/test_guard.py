"""No input is destroyed: outputs that are inputs, or each other, are refused before anything is read or written."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from potr_cl import cli
from potr_cl.cli import guard
from potr_cl.errors import UsageError
from potr_cl.formats.scenes import ply
from tests.cli.calls import cameras_json
from tests.reference.scenes import random_scene, ring_of_cameras

Link = Callable[[Path, Path], None]


def same_name(_: Path, __: Path) -> None:
    """The output is named as the input is."""


def symbolic_link(source: Path, link: Path) -> None:
    link.symlink_to(source)


def hard_link(source: Path, link: Path) -> None:
    os.link(source, link)


def link_to_its_folder(source: Path, link: Path) -> None:
    link.symlink_to(source.parent, target_is_directory=True)


LINKS = [same_name, symbolic_link, hard_link, link_to_its_folder]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Scenes, cameras in a folder of their own, and photographs of their views."""
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


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def written_suffix(call: str) -> str:
    """Of the output "{out}" of a call."""
    for option, suffix in (("--report", ".html"), ("--order", ".npy"), ("encode", ".potr"), ("compare", ".png")):
        if option in call:
            return suffix
    return ".ply"


def refused(capsys: pytest.CaptureFixture[str], folder: Path, arguments: list[str], *words: str) -> None:
    before = contents(folder)
    assert cli.main(arguments) == 2
    said = capsys.readouterr()
    assert any(word in said.err for word in words)
    assert said.err.startswith("potr-cl: ")
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("call", "target", "link"),
    [*((*CALLS[0], link) for link in LINKS), *((*call, LINKS[n % 2]) for n, call in enumerate(CALLS[1:]))],
)
def test_an_output_that_is_an_input(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    call: str,
    target: str,
    link: Link,
) -> None:
    monkeypatch.chdir(folder)
    source = folder / target
    # Links have the suffix that the command writes: another one is reason enough to refuse.
    out = source if link is same_name else folder / f"link{written_suffix(call)}"
    link(source, out)
    if link is link_to_its_folder:
        out = out / source.name
    words = ["would be replaced"]
    if out.name == source.name and source.suffix != written_suffix(call):
        words += ["a name that ends in", "give it one of"]
    refused(capsys, folder, [word.format(out=out) for word in call.split()], *words)


def test_a_name_that_leads_through_a_folder_that_is_not_there(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system finds no "missing/../i.ply", but a file of this name would be written over i.ply."""
    monkeypatch.chdir(folder)
    refused(capsys, folder, ["encode", "i.ply", "-o", "missing/../i.ply"], "would be replaced")


@pytest.mark.parametrize(
    "call",
    [
        "encode i.ply -o new --report new",
        "encode i.ply -o new --report data/../new",
        "encode i.ply -o new --report link/new",
        "encode i.ply -o new --report dangling",
        "prune i.ply -o old --order old",
        "prune i.ply -o old --order hard",
    ],
)
def test_two_outputs_that_are_one(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    monkeypatch.chdir(folder)
    (folder / "link").symlink_to(folder, target_is_directory=True)
    (folder / "dangling").symlink_to("new")
    (folder / "old").write_bytes(b"old")
    os.link(folder / "old", folder / "hard")
    refused(capsys, folder, call.split(), "name the same file")


@pytest.mark.parametrize("cameras", ["data", "data/cameras.json"])
def test_pictures_in_the_place_of_photographs(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, cameras: str
) -> None:
    monkeypatch.chdir(folder)
    refused(
        capsys, folder, ["render", "i.ply", "--cameras", cameras, "-o", "data/images"], "view_0.png' is an input too"
    )


def test_a_picture_in_the_place_of_the_scene(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "out").mkdir()
    os.link(folder / "i.ply", folder / "out" / "view_2.png")
    refused(capsys, folder, ["render", "i.ply", "--cameras", "data", "-o", "out"], "view_2.png' is an input too")


def test_what_is_no_input_may_be_replaced(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Outputs in the folder of the cameras, twice; and pictures, twice."""
    monkeypatch.chdir(folder)
    keep = ["--no-prune", "--no-compact", "--refit", "off", "--no-quality"]
    for _ in range(2):
        call = ["encode", "i.ply", "-o", "data/out.potr", "--cameras", "data", "--report", "data/out.html", *keep]
        assert cli.main(call) == 0
        assert cli.main(["render", "i.ply", "--cameras", "data", "-o", "pictures", "--views", "0"]) == 0
    capsys.readouterr()


def test_every_command_says_of_every_path_what_becomes_of_it() -> None:
    parser = cli.command_parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, command in commands.choices.items():
        for action in command._actions:
            assert action.type is not Path, f"{name}: {action.dest}: give it one of the types of {guard.__name__}"


def test_a_path_of_which_nothing_is_said_is_a_mistake() -> None:
    with pytest.raises(TypeError, match="'scene' is a path"):
        guard.check(argparse.Namespace(scene=Path("i.ply")))


def test_inputs_may_be_the_same(folder: Path) -> None:
    scene = guard.ReadFile(folder / "i.ply")
    guard.check(argparse.Namespace(a=scene, b=scene))
    with pytest.raises(UsageError):
        guard.check(argparse.Namespace(a=scene, outputs=[guard.WrittenFile(folder / "i.ply")]))
