"""--antialiased, and what the commands do with scenes that are."""

from __future__ import annotations

import json

import numpy as np
import pytest

from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.formats.scenes import ply
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tests.cli.calls import KEEP, fails, run


@pytest.fixture
def paths(tmp_path, data, plush_excerpt):
    """The excerpt without a mark, the same with one, and its cameras."""
    plain, marked = tmp_path / "plain.ply", tmp_path / "marked.ply"
    ply.save(plain, plush_excerpt)
    ply.save(marked, plush_excerpt.rendered(True))
    return plain, marked, data / "plush_excerpt_cameras.json"


@pytest.mark.parametrize(("option", "expected"), [("auto", True), ("no", False)])
def test_every_command_that_writes_a_scene(tmp_path, scene_path, cameras_path, capsys, option, expected):
    ply.save(scene_path, ply.load(scene_path).rendered(True))
    views = ["--cameras", cameras_path]
    for name, *command in (
        ("a.potr", "encode", scene_path, "-o", *KEEP),
        ("a.spz", "convert", scene_path),
        ("b.ply", "prune", scene_path, *views, "--iterations", 2, "-o"),
        ("c.ply", "compact", scene_path, *views, "-o"),
        ("d.ply", "refit", scene_path, "--reference", scene_path, *views, "--steps", 1, "-o"),
        ("e.ply", "fit", scene_path, "--reference", scene_path, *views, "--steps", 1, "-o"),
    ):
        at = command.index("-o") + 1 if "-o" in command else len(command)
        said = run(capsys, *command[:at], tmp_path / name, *command[at:], "--antialiased", option)
        assert ("as an antialiased scene" in said) == (expected and command[0] == "encode")
        assert load_scene(tmp_path / name).antialiased is expected, name
    run(capsys, "decode", tmp_path / "a.potr", "-o", tmp_path / "f.ply")
    assert load_scene(tmp_path / "f.ply").antialiased is expected


def test_render(tmp_path, paths, plush_excerpt, capsys):
    plain, marked, cameras = paths
    view = load_cameras(cameras)[0]
    wanted = {}
    for kind in (True, False):
        with Rasterizer(Device(), plush_excerpt.rendered(kind)) as rasterizer:
            wanted[kind] = np.clip(rasterizer.render(view)[0], 0, 1)
    assert np.abs(wanted[True] - wanted[False]).max() > 0.05
    calls = [(plain, [], False), (marked, [], True)]
    calls += [(plain, ["--antialiased", "yes"], True), (marked, ["--antialiased", "no"], False)]
    for number, (scene, option, kind) in enumerate(calls):
        folder = tmp_path / str(number)
        run(capsys, "render", scene, "--cameras", cameras, "-o", folder, "--views", 0, *option)
        picture = read_ground_truth(next(folder.iterdir()), (0.0, 0.0, 0.0))
        assert np.abs(picture - wanted[kind]).max() <= 0.51 / 255


@pytest.mark.parametrize(("option", "said"), [("no", "no"), ("yes", "yes, low-pass filter of 0.3")])
def test_info_shows_it(tmp_path, scene_path, capsys, option, said):
    run(capsys, "encode", scene_path, "-o", tmp_path / "a.potr", "--antialiased", option, *KEEP)
    run(capsys, "convert", scene_path, tmp_path / "a.ply", "--antialiased", option)
    for name in ("a.potr", "a.ply"):
        assert f"antialiased     {said}" in run(capsys, "info", tmp_path / name)
        assert json.loads(run(capsys, "info", tmp_path / name, "--json"))["antialiased"] is (option == "yes")


@pytest.mark.slow
def test_encode_is_judged_as_the_scene_is_rendered(tmp_path, paths, capsys):
    plain, _, cameras = paths
    few = ["--preset", "fast", "--iterations", 4]
    encode = ["encode", plain, "-o", tmp_path / "a.potr", "--cameras", cameras, *few, "--json", "--antialiased", "yes"]
    report = json.loads(run(capsys, *encode))
    assert report["source"]["antialiased"] is True
    said = report["quality"]["psnr"]
    compare = ["compare", plain, tmp_path / "a.potr", "--cameras", cameras, "--json"]
    alike = json.loads(run(capsys, *compare, "--antialiased", "yes"))
    assert alike["mean"]["b_against_a"]["psnr"] == pytest.approx(said, abs=0.02)
    assert not any("antialiasing" in note for note in alike["notes"])
    unlike = json.loads(run(capsys, *compare))
    assert any("A is rendered without antialiasing and B is rendered with" in note for note in unlike["notes"])
    assert unlike["mean"]["b_against_a"]["psnr"] < said - 5


def test_refit_takes_both_scenes_alike(tmp_path, scene_path, cameras_path, capsys):
    """As after ``prune --antialiased yes`` of a file without a mark: the result has one, the original has none."""
    marked, out = tmp_path / "marked.ply", tmp_path / "a.ply"
    ply.save(marked, ply.load(scene_path).rendered(True))
    command = ["refit", marked, "--reference", scene_path, "--cameras", cameras_path, "-o", out]
    fails(capsys, command, 2, f"'{marked}' says that it is antialiased and '{scene_path}' does not")
    assert not out.exists()
    run(capsys, *command, "--antialiased", "yes", "--steps", 1)
    assert load_scene(out).antialiased
