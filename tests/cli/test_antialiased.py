"""--antialiased, and what the commands do with scenes that are."""

from __future__ import annotations

import json

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.formats.scenes import ply
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer

KEEP = ["--no-prune", "--no-compact", "--refit", "off", "--no-quality"]


@pytest.fixture
def paths(tmp_path, data, plush_excerpt):
    """The excerpt without a mark, the same with one, and its cameras."""
    plain, marked = tmp_path / "plain.ply", tmp_path / "marked.ply"
    ply.save(plain, plush_excerpt)
    ply.save(marked, plush_excerpt.rendered(True))
    return str(plain), str(marked), str(data / "plush_excerpt_cameras.json")


def run(*arguments) -> None:
    assert cli.main([str(a) for a in arguments]) == 0


@pytest.mark.parametrize(
    ("marked", "option", "expected"),
    [pytest.param(False, [], False, marks=pytest.mark.slow), (True, ["--antialiased", "auto"], True),
     pytest.param(False, ["--antialiased", "yes"], True, marks=pytest.mark.slow),
     (True, ["--antialiased", "no"], False)],
)  # fmt: skip
def test_every_command_that_writes_a_scene(tmp_path, paths, capsys, marked, option, expected):
    scene, cameras = paths[marked], paths[2]
    few = ["--iterations", 2]
    for command in (
        ["encode", scene, "-o", tmp_path / "a.potr", *KEEP],
        ["convert", scene, tmp_path / "a.spz"],
        ["convert", scene, tmp_path / "a.ply"],
        ["prune", scene, "--cameras", cameras, "-o", tmp_path / "b.ply", *few],
        ["compact", scene, "--cameras", cameras, "-o", tmp_path / "c.ply"],
        ["refit", scene, "--reference", scene, "--cameras", cameras, "-o", tmp_path / "d.ply", "--steps", 1],
        ["fit", scene, "--reference", scene, "--cameras", cameras, "-o", tmp_path / "g.ply", "--steps", 1],
    ):
        run(*command, *option)
        said = capsys.readouterr().out
        assert ("as an antialiased scene" in said) == (expected and command[0] == "encode")
    for name in ("a.potr", "a.spz", "a.ply", "b.ply", "c.ply", "d.ply", "g.ply"):
        assert load_scene(tmp_path / name).antialiased is expected, name
    run("decode", tmp_path / "a.potr", "-o", tmp_path / "e.ply")
    assert load_scene(tmp_path / "e.ply").antialiased is expected
    run("convert", tmp_path / "a.potr", tmp_path / "f.spz")
    assert load_scene(tmp_path / "f.spz").antialiased is expected


def test_render(tmp_path, paths, plush_excerpt):
    plain, marked, cameras = paths
    view = load_cameras(cameras)[0]
    wanted = {}
    for kind in (True, False):
        with Rasterizer(Device(), plush_excerpt.rendered(kind)) as rasterizer:
            wanted[kind] = np.clip(rasterizer.render(view)[0], 0, 1)
    assert np.abs(wanted[True] - wanted[False]).max() > 0.05
    for number, (scene, option, kind) in enumerate(
        [(plain, [], False), (marked, [], True), (plain, ["--antialiased", "yes"], True),
         (marked, ["--antialiased", "no"], False)]
    ):  # fmt: skip
        folder = tmp_path / str(number)
        run("render", scene, "--cameras", cameras, "-o", folder, "--views", 0, *option)
        picture = read_ground_truth(next(folder.iterdir()), (0.0, 0.0, 0.0))
        assert np.abs(picture - wanted[kind]).max() <= 0.51 / 255


def test_info_shows_it(tmp_path, paths, capsys):
    for scene, said in ((paths[0], "antialiased     no"), (paths[1], "antialiased     yes, low-pass filter of 0.3")):
        run("encode", scene, "-o", tmp_path / "a.potr", *KEEP)
        capsys.readouterr()
        run("info", tmp_path / "a.potr")
        assert said in capsys.readouterr().out
        run("info", tmp_path / "a.potr", "--json")
        assert json.loads(capsys.readouterr().out)["antialiased"] is ("yes" in said)
        run("info", scene)
        assert said in capsys.readouterr().out


@pytest.mark.slow
def test_encode_is_judged_as_the_scene_is_rendered(tmp_path, paths, capsys):
    plain, _, cameras = paths
    few = ["--preset", "fast", "--iterations", 4]
    run("encode", plain, "-o", tmp_path / "a.potr", "--cameras", cameras, *few, "--json", "--antialiased", "yes")
    report = json.loads(capsys.readouterr().out)
    assert report["source"]["antialiased"] is True
    said = report["quality"]["psnr"]
    run("compare", plain, tmp_path / "a.potr", "--cameras", cameras, "--json", "--antialiased", "yes")
    alike = json.loads(capsys.readouterr().out)
    assert alike["mean"]["b_against_a"]["psnr"] == pytest.approx(said, abs=0.02)
    assert not any("antialiasing" in note for note in alike["notes"])
    run("compare", plain, tmp_path / "a.potr", "--cameras", cameras, "--json")
    unlike = json.loads(capsys.readouterr().out)
    assert any("A is rendered without antialiasing and B is rendered with" in note for note in unlike["notes"])
    assert unlike["mean"]["b_against_a"]["psnr"] < said - 5


def test_refit_takes_both_scenes_alike(tmp_path, paths, capsys):
    """As after ``prune --antialiased yes`` of a file without a mark: the result has one, the original has none."""
    plain, marked, cameras = paths
    command = ["refit", marked, "--reference", plain, "--cameras", cameras, "-o", str(tmp_path / "a.ply")]
    assert cli.main(command) == 2
    assert f"'{marked}' says that it is antialiased and '{plain}' does not" in capsys.readouterr().err
    assert not (tmp_path / "a.ply").exists()
    run(*command, "--antialiased", "yes", "--steps", 1)
    assert load_scene(tmp_path / "a.ply").antialiased


def test_a_wrong_choice_is_told(paths, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["convert", paths[0], "x.spz", "--antialiased", "perhaps"])
    assert ended.value.code == 2
    assert "perhaps" in capsys.readouterr().err
