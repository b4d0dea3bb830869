"""Photographs that a lens has bent, undistorted on the fly."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from potr_cl import Camera, DataError, cli, load_cameras
from potr_cl.formats.images import to_8_bits
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import within_photographs
from potr_cl.model.lens import Lens
from potr_cl.opencl.device import Device
from potr_cl.quality.photographs import read_photograph, undistorted
from potr_cl.raster.rasterizer import Rasterizer
from tests.reference.scenes import random_scene, ring_of_cameras

LENS = Lens(200, 150, 180, 185, 101, 74, radial=(-0.15, 0.04), tangential=(0.002, -0.001))


def test_every_pixel_is_the_bilinear_mean_around_where_the_lens_has_put_it() -> None:
    """Against the definition, pixel by pixel in float64."""
    photograph = np.random.default_rng(0).random((150, 200, 3), np.float32)
    view = LENS.within()
    result = undistorted(photograph, LENS, view)
    assert result.shape == (view.height, view.width, 3)
    for row in range(0, view.height, 7):
        for column in range(0, view.width, 9):
            x, y = (column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy
            square = x * x + y * y
            bent = 1 - 0.15 * square + 0.04 * square**2
            u = bent * x + 2 * 0.002 * x * y - 0.001 * (square + 2 * x * x)
            v = bent * y - 2 * 0.001 * x * y + 0.002 * (square + 2 * y * y)
            # The first pixel's centre is at 0.5; half a pixel at the border is the border's.
            u, v = min(max(u * 180 + 101 - 0.5, 0), 199), min(max(v * 185 + 74 - 0.5, 0), 149)
            left, top = min(math.floor(u), 198), min(math.floor(v), 148)
            a, b = u - left, v - top
            corners = photograph[top : top + 2, left : left + 2].astype(float)
            expected = np.einsum("i,j,ijk->k", [1 - b, b], [1 - a, a], corners)
            assert np.abs(result[row, column] - expected).max() < 2e-4  # positions are float32


def test_undistorted_as_colmap_does(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    x, y = np.meshgrid(np.arange(200), np.arange(150))
    smooth = np.stack([np.sin(x / 9), np.cos(y / 7), np.sin((x + y) / 11)], axis=2) * 0.4 + 0.5
    pixels = to_8_bits(smooth)
    camera = pycolmap.Camera(
        model="OPENCV", width=200, height=150, params=[180, 185, 101, 74, -0.15, 0.04, 0.002, -0.001]
    )
    theirs, pinhole = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(blank_pixels=0), pycolmap.Bitmap.from_array(pixels), camera
    )
    from potr_cl.model.lens import Pinhole

    view = Pinhole(pinhole.width, pinhole.height, *pinhole.params)
    ours = undistorted(pixels.astype(np.float32) / 255, LENS, view)
    difference = np.abs(to_8_bits(ours).astype(int) - theirs.to_array().astype(int))
    # COLMAP rounds on its own; it leaves pixels of the outermost row and column black.
    assert np.quantile(difference[2:-2, 2:-2], 0.999) <= 1


def test_a_view_beyond_the_photograph_is_refused(tmp_path: Path) -> None:
    Image.new("RGB", (200, 150)).save(tmp_path / "a.png")
    pose = {"rotation": np.eye(3), "translation": np.zeros(3)}
    covering = Camera("a", **LENS.covering()[0]._asdict(), **pose, lens=LENS)
    with pytest.raises(DataError, match="within_photographs"):
        read_photograph(tmp_path / "a.png", covering)
    (within,) = within_photographs([covering])
    assert read_photograph(tmp_path / "a.png", within).shape == (within.height, within.width, 3)
    Image.new("RGB", (64, 64)).save(tmp_path / "a.png")
    with pytest.raises(DataError, match="200 x 150 pixels"):
        read_photograph(tmp_path / "a.png", within)


@pytest.fixture
def captured(tmp_path: Path) -> Path:
    """A scene, and bent photographs of it with their cameras as nerfstudio's transforms.json."""
    scene = random_scene(400, 1)
    # Colours that a photograph holds, and splats that look the same when they are rendered finer.
    scene = replace(scene, sh=0.1 * scene.sh, log_scales=np.maximum(scene.log_scales, -2))
    ply.save(tmp_path / "a.ply", scene)
    lens = Lens(120, 90, 100, 100, 60, 45, radial=(-0.2,))
    view, _ = lens.covering()
    frames = []
    (tmp_path / "images").mkdir()
    with Rasterizer(Device(), scene) as rasterizer:
        for number, camera in enumerate(ring_of_cameras(8)):
            # Rendered far finer than photographed, then bent: each pixel looks where the lens lets it look.
            fine = Camera(
                "fine", 4 * view.width, 4 * view.height, 4 * view.fx, 4 * view.fy, 4 * view.cx, 4 * view.cy,
                camera.rotation, camera.translation,
            )  # fmt: skip
            picture = rasterizer.render(fine)[0]
            columns, rows = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
            points, found = lens.undistorted(((columns - 60) / 100).ravel(), ((rows - 45) / 100).ravel())
            assert found.all()
            x = (points[0] * fine.fx + fine.cx).astype(int).clip(0, fine.width - 1)
            y = (points[1] * fine.fy + fine.cy).astype(int).clip(0, fine.height - 1)
            Image.fromarray(to_8_bits(picture[y, x].reshape(90, 120, 3))).save(tmp_path / "images" / f"v{number}.png")
            to_world = np.eye(4)
            to_world[:3, :3], to_world[:3, 3] = camera.rotation.T @ np.diag([1, -1, -1]), camera.centre
            frames.append({"file_path": f"images/v{number}.png", "transform_matrix": to_world.tolist()})
    intrinsics = {"w": 120, "h": 90, "fl_x": 100, "fl_y": 100, "cx": 60, "cy": 45, "k1": -0.2}
    content = {"camera_model": "OPENCV", **intrinsics, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path


def test_compare_with_bent_photographs(captured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, cameras = str(captured / "a.ply"), str(captured / "transforms.json")
    call = ["compare", scene, scene, "--cameras", cameras, "--truth", str(captured / "images"), "--json"]
    assert cli.main(call) == 0
    told = capsys.readouterr()
    straight = json.loads(told.out)["mean"]["a_against_truth"]["psnr"]
    # What the same photographs say where the lens is not known.
    content = json.loads((captured / "transforms.json").read_text())
    del content["k1"]
    (captured / "transforms.json").write_text(json.dumps(content))
    assert cli.main(call) == 0
    bent = json.loads(capsys.readouterr().out)["mean"]["a_against_truth"]["psnr"]
    assert straight > bent + 5
    assert straight > 30


def test_views_with_a_lens_are_told_once(captured: Path, caplog: pytest.LogCaptureFixture) -> None:
    cameras = load_cameras(captured)
    assert caplog.text.count("lens distortion") == 1
    assert "8 of 8 views" in caplog.text
    assert all(camera.width > 120 and camera.height > 90 for camera in cameras)


@pytest.mark.slow
def test_encode_and_refit_to_bent_photographs(captured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, cameras, photos = str(captured / "a.ply"), str(captured / "transforms.json"), str(captured / "images")
    encode = ["encode", scene, "-o", str(captured / "a.potr"), "--cameras", cameras, "--iterations", "3"]
    assert cli.main([*encode, "--photos", photos, "--refit", "2"]) == 0
    assert "photograph of test views" in capsys.readouterr().out
    refit = ["refit", scene, "--reference", scene, "--cameras", cameras, "--photos", photos, "--steps", "2"]
    assert cli.main([*refit, "-o", str(captured / "b.ply")]) == 0
