"""The commands that look: render and compare."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest
from PIL import Image

from potr_cl import cli
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import to_8_bits
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.quality.compare import side_by_side
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT
from tests.cli.calls import fails, run


def test_render_writes_what_the_rasterizer_sees(tmp_path, potr_path, cameras_path, capsys):
    out = tmp_path / "new" / "folder"
    options = ["--background", "1,0.5,0", "--rules", "gsplat"]
    text = run(capsys, "render", potr_path, "--cameras", cameras_path, "-o", out, *options)
    assert "8 images" in text
    rasterizer = Rasterizer(Device(), load_scene(potr_path), GSPLAT, (1, 0.5, 0))
    cameras = load_cameras(cameras_path)
    assert sorted(file.name for file in out.iterdir()) == sorted(f"{c.name}.png" for c in cameras)
    for camera in cameras:
        with Image.open(out / f"{camera.name}.png") as image:
            assert np.array_equal(np.asarray(image), to_8_bits(rasterizer.render(camera)[0]))


@pytest.mark.parametrize(
    ("options", "views"),
    [
        (["--split", "test"], ["view_0", "view_4"]),
        (["--split", "train"], ["0", *(f"view_{k}" for k in (1, 2, 3, 5, 6))]),
        (["--split", "all"], ["0", *(f"view_{k}" for k in range(7))]),
        # A view named like a number is that view.
        (["--views", "view_3", "5", "view_5", "0"], ["0", "view_3", "view_5"]),
    ],
)
def test_render_chosen_views(tmp_path, scene_path, cameras_path, capsys, options, views):
    given = json.loads(cameras_path.read_text())
    given[7]["img_name"] = "0"
    cameras_path.write_text(json.dumps(given))
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", tmp_path / "out", *options)
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [f"{view}.png" for view in views]


def test_pictures_stay_in_their_folder(tmp_path, scene_path, cameras_path, capsys):
    """Names of views come from files that others wrote."""
    views = json.loads(cameras_path.read_text())[:3]
    for view, name in zip(views, ("../../x.png", "/x.png", "a/x.png"), strict=True):
        view["img_name"] = name
    cameras_path.write_text(json.dumps(views))
    out = tmp_path / "out"
    before = set(tmp_path.iterdir())
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", out)
    assert set(tmp_path.iterdir()) == before | {out}
    assert sorted(file.name for file in out.iterdir()) == [".._.._x.png", "_x.png", "a_x.png"]
    views[0]["img_name"] = "a_x.png"
    views[1]["img_name"] = "b/x.png"
    cameras_path.write_text(json.dumps(views))
    fails(capsys, ["render", scene_path, "--cameras", cameras_path, "-o", out], 1, "two views", "--views")


def test_render_bad_calls(tmp_path, scene_path, cameras_path, capsys):
    out = tmp_path / "out"
    render = ["render", scene_path, "--cameras", cameras_path, "-o", out]
    fails(capsys, ["render", cameras_path, *render[2:]], 2, "cameras.json", "holds cameras, not a scene")
    fails(capsys, [*render, "--views", "view_9"], 2, "'view_9'", "0 ('view_0') to 7 ('view_7')")
    fails(capsys, [*render, "--views", "8"], 2, "'8'")
    fails(capsys, [*render, "--device", "no such thing"], 1, "'no such thing'", list_devices()[0].name)
    (tmp_path / "folder" / "view_0.png").mkdir(parents=True)
    fails(capsys, [*render[:5], tmp_path / "folder"], 2, "view_0.png")
    views = [view for view in json.loads(cameras_path.read_text()) if view["split"] == "train"]
    cameras_path.write_text(json.dumps(views))
    fails(capsys, [*render, "--split", "test"], 2, "--split all")


def test_compare_from_cameras(scene_path, potr_path, cameras_path, capsys, monkeypatch):
    both = [scene_path, potr_path, "--cameras", cameras_path]
    report = json.loads(run(capsys, "compare", *both, "--json"))
    assert [view["name"] for view in report["views"]] == ["view_0", "view_4"]  # the test views
    assert report["a"]["bytes"] == scene_path.stat().st_size
    assert report["b"]["bytes"] == potr_path.stat().st_size
    assert report["size_ratio"] == report["a"]["bytes"] / report["b"]["bytes"]
    assert report["rules"] == "inria"
    psnrs = [view["b_against_a"]["psnr"] for view in report["views"]]
    assert report["mean"]["b_against_a"]["psnr"] == pytest.approx(np.mean(psnrs))
    assert min(psnrs) > 30
    text = run(capsys, "compare", *both)
    assert f"{np.mean(psnrs):.2f}" in text
    assert "LPIPS" not in text
    assert json.loads(run(capsys, "compare", *both, "--json", "--views", "2"))["worst_view"] == "view_2"
    monkeypatch.setitem(sys.modules, "lpips", None)
    fails(capsys, ["compare", *both, "--lpips"], 2, "LPIPS needs", "pip install")


def test_compare_with_itself_is_valid_json(scene_path, cameras_path, capsys):
    compare = ["compare", scene_path, scene_path, "--cameras", cameras_path]
    assert json.loads(run(capsys, *compare, "--json"))["mean"]["b_against_a"] == {"psnr": None, "ssim": 1}
    assert "identical" in run(capsys, *compare)


@pytest.mark.slow
def test_compare_without_cameras(scene_path, potr_path, capsys):
    compare = ["compare", scene_path, potr_path, "--size", 48]
    said = run(capsys, *compare)
    assert "times smaller" in said
    placed = [line for line in said.splitlines() if "no --cameras" in line]
    assert len(placed) == 1
    assert re.search("(25|30) virtual views of 48 x 48 pixels", placed[0])
    assert placed[0].endswith("files encoded with cameras look best from those")
    report = json.loads(run(capsys, *compare, "--json", "--virtual-views", 2))
    assert (report["a"]["splats"], report["b"]["splats"]) == (200, 200)
    assert [view["name"] for view in report["views"]] == ["virtual_test_000", "virtual_test_001"]
    assert all(25 < view["b_against_a"]["psnr"] < 70 for view in report["views"])
    turning = json.loads(run(capsys, *compare, "--json", "--turntable", 3, "--views", "1"))
    assert [view["name"] for view in turning["views"]] == ["turntable_001"]
    fails(capsys, ["compare", scene_path, potr_path, "--truth", "x"], 2, "--cameras")


def test_compare_tells_sizes_where_there_is_no_device(scene_path, potr_path, capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.api.comparing.list_devices", list)
    assert cli.main(["compare", str(scene_path), str(potr_path)]) == 0
    captured = capsys.readouterr()
    assert "times smaller" in captured.out
    assert "virtual" not in captured.out
    assert "no OpenCL device" in captured.err
    assert set(json.loads(run(capsys, "compare", scene_path, potr_path, "--json"))) == {"a", "b", "size_ratio"}


@pytest.mark.slow
def test_render_without_cameras_places_views(tmp_path, scene_path, capsys):
    assert cli.main(["render", str(scene_path), "-o", str(tmp_path / "around"), "--size", "40"]) == 0
    placed = [line for line in capsys.readouterr().err.splitlines() if "no --cameras" in line]
    assert len(placed) == 1
    assert "8 virtual views of 40 x 40 pixels" in placed[0]
    files = sorted((tmp_path / "around").iterdir())
    assert [file.name for file in files] == [f"virtual_test_{k:03d}.png" for k in range(8)]
    run(capsys, "render", scene_path, "-o", tmp_path / "turn", "--turntable", 5, "--size", 40, "--up=-y")
    files += sorted((tmp_path / "turn").iterdir())
    assert [file.name for file in files[8:]] == [f"turntable_{k:03d}.png" for k in range(5)]
    for file in files:
        with Image.open(file) as image:
            assert image.size == (40, 40)
            assert np.asarray(image).std() > 5, "the scene is in the picture"


@pytest.mark.parametrize(
    ("option", "said"),
    [
        *(("--turntable 0", "0 views"), ("--virtual-views 100000", "100000 views")),
        *(("--size 0", "0 x 0"), ("--size 99999", "99999 x 99999")),
    ],
)
def test_wrong_numbers_of_views_to_place(tmp_path, scene_path, capsys, option, said):
    fails(capsys, ["render", scene_path, "-o", tmp_path / "out", *option.split()], 2, said)
    assert not (tmp_path / "out").exists()


def test_compare_picture(tmp_path, scene_path, potr_path, cameras_path, capsys):
    picture = tmp_path / "worst.png"
    text = run(capsys, "compare", scene_path, potr_path, "--cameras", cameras_path, "-o", picture)
    factor = int(text.split("difference times ")[1].split()[0])
    worst = text.split("worst view: ")[1].split(",")[0]
    a, b = (Rasterizer(Device(), load_scene(path)) for path in (scene_path, potr_path))
    view = next(camera for camera in load_cameras(cameras_path) if camera.name == worst)
    with Image.open(picture) as image:
        assert image.width == 3 * 64
        assert image.height > 64 + 20, "there are labels above the pictures"
        pixels = np.asarray(image)
        assert np.array_equal(pixels[-64:], side_by_side(a.render(view)[0], b.render(view)[0])[0])
        labels = pixels[:-64]
        assert labels.max() > 200
        assert all((labels[len(labels) // 2 :, k * 64 : (k + 1) * 64].max() > 200) for k in range(3))
        assert image.text["Description"] == (
            f"view {worst}: A, B and their difference times {factor}; A is scene.ply, B is scene.potr"
        )


def test_compare_with_ground_truth(tmp_path, scene_path, potr_path, cameras_path, capsys):
    """The uncompressed scene's own pictures as photographs: 8 bits are all that A loses."""
    photos = tmp_path / "photos"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos, "--background", "white")
    both = ["compare", scene_path, potr_path, "--cameras", cameras_path, "--background", "white"]
    mean = json.loads(run(capsys, *both, "--truth", photos, "--json"))["mean"]
    assert mean["a_against_truth"]["psnr"] > 55
    assert mean["b_against_truth"]["psnr"] == pytest.approx(mean["b_against_a"]["psnr"], abs=0.5)
    fails(capsys, [*both, "--truth", tmp_path / "nowhere"], 2, "nowhere")
    (photos / "view_4.png").unlink()
    said = run(capsys, *both, "--truth", photos)
    assert "loss by photo" in said
    assert "view 'view_4' has no photograph" in said


def test_compare_bad_calls(tmp_path, scene_path, potr_path, cameras_path, capsys):
    call = ["compare", scene_path, potr_path, "--cameras", cameras_path]
    fails(capsys, [*call, "--device", "77"], 1, "'77'")
    fails(capsys, [*call, "--views", "nobody"], 2, "'nobody'")
    potr_path.write_bytes(potr_path.read_bytes()[:-20])
    fails(capsys, [*call, "-o", tmp_path / "worst.png"], 1, str(potr_path))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cameras.json", "scene.ply", "scene.potr"]
