"""Photographs: found by name, as a judge, as targets of the re-fit, and undistorted on the fly."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from potr_cl import Camera, DataError, UsageError, cli, compare, load_cameras
from potr_cl.formats.images import to_8_bits
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import within_photographs
from potr_cl.model.lens import Lens, Pinhole
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics import psnr
from potr_cl.quality.photographs import GroundTruth, find_ground_truth, read_photograph, undistorted
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views.targets import PhotographTargets, RenderedTargets
from tests.cases.cameras import write_json
from tests.cases.photographs import bent, photographed_scene, photographs
from tests.reference.scenes import random_scene, ring_of_cameras

LENS = Lens(200, 150, 180, 185, 101, 74, radial=(-0.15, 0.04), tangential=(0.002, -0.001))


def save(path: Path, pixels: NDArray[np.uint8] | tuple[int, int] = (64, 64)) -> Path:
    """A picture, black if nothing but its width and height is given."""
    path.parent.mkdir(exist_ok=True)
    (Image.new("RGB", pixels) if isinstance(pixels, tuple) else Image.fromarray(pixels)).save(path)
    return path


@pytest.fixture(scope="module")
def device() -> Iterator[Device]:
    device = Device()
    yield device
    assert device.allocated == 0


def test_ground_truth_are_found_by_name(tmp_path):
    cameras = ring_of_cameras(4)
    cameras[2] = replace(cameras[2], name="left/view.2")
    cameras[3] = replace(cameras[3], name="view_3.png")  # views keep the extension where two differ only in it
    paths = [tmp_path / name for name in ("view_0.JPG", "view_1.png", "left/view.2.png", "view_3.png")]
    for path in (*paths, tmp_path / "view_3.jpg"):
        save(path)
    (tmp_path / "view_0.txt").write_text("not a picture")
    assert find_ground_truth(tmp_path, cameras) == {c.name: p for c, p in zip(cameras, paths, strict=True)}


def test_ground_truth_missing_or_ambiguous(tmp_path):
    cameras = ring_of_cameras(2)
    with pytest.raises(UsageError, match=r"cannot read the folder of photographs .*nowhere"):
        find_ground_truth(tmp_path / "nowhere", cameras)
    with pytest.raises(UsageError, match=r"no photograph of any of the 2 views: .* as 'view_0'"):
        find_ground_truth(tmp_path, cameras)
    save(tmp_path / "view_0.png")
    assert find_ground_truth(tmp_path, cameras) == {"view_0": tmp_path / "view_0.png"}
    save(tmp_path / "view_1.png")
    save(tmp_path / "view_1.jpg")
    with pytest.raises(UsageError, match=r"several photographs of view 'view_1'.*view_1.jpg, view_1.png"):
        find_ground_truth(tmp_path, cameras)


def test_ground_truth_of_another_size_or_damaged(tmp_path):
    cameras = ring_of_cameras(1)
    save(tmp_path / "view_0.png", (80, 60))
    with pytest.raises(UsageError, match=r"80 x 60 pixels, view 'view_0' of the cameras is 64 x 64"):
        find_ground_truth(tmp_path, cameras)
    (tmp_path / "view_0.png").write_bytes(b"\x89PNG damaged")
    with pytest.raises(DataError, match=r"view_0.png' is damaged"):
        find_ground_truth(tmp_path, cameras)


# ------------------------------------------------------------------------------------------ as a judge and as targets


SCENE = photographed_scene()
CAMERAS = ring_of_cameras(6, size=32)
CAMERAS[5] = replace(CAMERAS[5], width=20, height=16, cx=10.0, cy=8.0)


@pytest.fixture
def folder(tmp_path, device):
    """The scene's own pictures."""
    return photographs(tmp_path, device, SCENE, CAMERAS)


def test_psnr_is_the_mean_over_the_views(device, folder):
    ground_truth = GroundTruth(folder, CAMERAS)
    with Rasterizer(device, replace(SCENE, sh=SCENE.sh + np.float32(0.1))) as rasterizer:
        wanted = np.mean([psnr(rasterizer.render(c)[0], ground_truth.picture(c)) for c in CAMERAS[:2]])
        assert ground_truth.psnr(rasterizer, CAMERAS[:2]) == pytest.approx(wanted)


def test_a_refit_to_ground_truth_is_one_to_what_they_show(device, folder):
    """8 bits are all that tells the photographs from the pictures."""
    dimmed = replace(SCENE, sh=SCENE.sh * np.float32(0.5))
    options = RefitOptions(steps=20, gain=0, prior=1)
    targets = PhotographTargets(device, GroundTruth(folder, CAMERAS), CAMERAS)
    refitted = refit_colours(device, dimmed, CAMERAS, targets, options)
    with Rasterizer(device, SCENE) as rasterizer:
        wanted = refit_colours(device, dimmed, CAMERAS, RenderedTargets(rasterizer, CAMERAS), options)
    assert refitted.errors[1] < 0.1 * refitted.errors[0]
    assert refitted.errors == pytest.approx(wanted.errors, abs=1e-4)
    assert np.abs(refitted.sh - wanted.sh).mean() < 0.1 * np.abs(refitted.sh - dimmed.sh).mean()


def test_views_without_a_photograph_are_left_out(folder):
    assert GroundTruth(folder, CAMERAS).missing is None
    (folder / "view_3.png").unlink()
    ground_truth = GroundTruth(folder, CAMERAS)
    assert [camera.name for camera in ground_truth.of(CAMERAS)] == ["view_0", "view_1", "view_2", "view_4", "view_5"]
    assert ground_truth.missing == "view 'view_3' has no photograph and is left out"
    (folder / "view_1.png").unlink()
    assert GroundTruth(folder, CAMERAS).missing == ("2 views, such as 'view_1', have no photograph and are left out")
    elsewhere = [*CAMERAS[:1], replace(CAMERAS[1], name="other/view_1")]
    assert GroundTruth(folder, elsewhere).of(elsewhere) == elsewhere[:1]


def test_a_damaged_photograph(device, folder):
    whole = (folder / "view_2.png").read_bytes()
    (folder / "view_2.png").write_bytes(whole[: len(whole) // 2])
    targets = PhotographTargets(device, GroundTruth(folder, CAMERAS), CAMERAS)
    with pytest.raises(DataError, match=r"view_2\.png"):
        refit_colours(device, SCENE, CAMERAS, targets)


# ------------------------------------------------------------------------------------------ bent by a lens


def test_every_pixel_is_the_bilinear_mean_around_where_the_lens_has_put_it():
    """Against the definition, pixel by pixel in float64."""
    photograph = np.random.default_rng(0).random((150, 200, 3), np.float32)
    view = LENS.within()
    result = undistorted(photograph, LENS, view)
    assert result.shape == (view.height, view.width, 3)
    for row in range(0, view.height, 7):
        for column in range(0, view.width, 9):
            x, y = (column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy
            square = x * x + y * y
            radial = 1 - 0.15 * square + 0.04 * square**2
            u = radial * x + 2 * 0.002 * x * y - 0.001 * (square + 2 * x * x)
            v = radial * y - 2 * 0.001 * x * y + 0.002 * (square + 2 * y * y)
            # The first pixel's centre is at 0.5; half a pixel at the border is the border's.
            u, v = min(max(u * 180 + 101 - 0.5, 0), 199), min(max(v * 185 + 74 - 0.5, 0), 149)
            left, top = min(math.floor(u), 198), min(math.floor(v), 148)
            a, b = u - left, v - top
            corners = photograph[top : top + 2, left : left + 2].astype(float)
            expected = np.einsum("i,j,ijk->k", [1 - b, b], [1 - a, a], corners)
            assert np.abs(result[row, column] - expected).max() < 2e-4  # positions are float32


def test_undistorted_as_colmap_does(tmp_path):
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
    view = Pinhole(pinhole.width, pinhole.height, *pinhole.params)
    ours = undistorted(pixels.astype(np.float32) / 255, LENS, view)
    difference = np.abs(to_8_bits(ours).astype(int) - theirs.to_array().astype(int))
    # COLMAP rounds on its own; it leaves pixels of the outermost row and column black.
    assert np.quantile(difference[2:-2, 2:-2], 0.999) <= 1


def test_a_view_beyond_the_photograph_is_refused(tmp_path):
    save(tmp_path / "a.png", (200, 150))
    pose = {"rotation": np.eye(3), "translation": np.zeros(3)}
    covering = Camera("a", **LENS.covering()[0]._asdict(), **pose, lens=LENS)
    with pytest.raises(DataError, match="within_photographs"):
        read_photograph(tmp_path / "a.png", covering)
    (within,) = within_photographs([covering])
    assert read_photograph(tmp_path / "a.png", within).shape == (within.height, within.width, 3)
    save(tmp_path / "a.png")
    with pytest.raises(DataError, match="200 x 150 pixels"):
        read_photograph(tmp_path / "a.png", within)


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory, device: Device) -> Path:
    """A scene, and bent photographs of it with their cameras as nerfstudio's transforms.json."""
    folder = tmp_path_factory.mktemp("captured")
    scene = random_scene(400, 1)
    # Colours that a photograph holds, and splats that look the same when they are rendered finer.
    scene = replace(scene, sh=0.1 * scene.sh, log_scales=np.maximum(scene.log_scales, -2))
    ply.save(folder / "a.ply", scene)
    lens = Lens(120, 90, 100, 100, 60, 45, radial=(-0.2,))
    view, _ = lens.covering()
    frames = []
    with Rasterizer(device, scene) as rasterizer:
        for number, camera in enumerate(ring_of_cameras(8)):
            # Rendered far finer than photographed, then bent: each pixel looks where the lens lets it look.
            size = {name: 4 * value for name, value in view._asdict().items()}
            fine = replace(camera, **size)
            file = f"images/v{number}.png"
            save(folder / file, bent(rasterizer.render(fine)[0], fine, lens))
            to_world = np.eye(4)
            to_world[:3, :3], to_world[:3, 3] = camera.rotation.T @ np.diag([1, -1, -1]), camera.centre
            frames.append({"file_path": file, "transform_matrix": to_world.tolist()})
    intrinsics = {"w": 120, "h": 90, "fl_x": 100, "fl_y": 100, "cx": 60, "cy": 45, "k1": -0.2}
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", **intrinsics, "frames": frames})
    return folder


def test_compare_with_bent_photographs(captured, tmp_path):
    content = json.loads((captured / "transforms.json").read_text())
    del content["k1"]
    told = []
    # The second time as if the lens was not known.
    for cameras in (captured / "transforms.json", write_json(tmp_path / "transforms.json", content)):
        compared = compare(captured / "a.ply", captured / "a.ply", cameras, truth=captured / "images")
        told.append(np.mean([view.figures["a_against_truth"].psnr for view in compared.figures.views]))
    assert told[0] > max(told[1] + 5, 30)


def test_views_with_a_lens_are_told_once(captured, caplog):
    cameras = load_cameras(captured)
    assert caplog.text.count("lens distortion") == 1
    assert "8 of 8 views" in caplog.text
    assert all(camera.width > 120 and camera.height > 90 for camera in cameras)


@pytest.mark.slow
def test_encode_and_refit_to_bent_photographs(captured, tmp_path, capsys):
    scene, given = str(captured / "a.ply"), ["--cameras", str(captured), "--photos", str(captured / "images")]
    encode = ["encode", scene, "-o", str(tmp_path / "a.potr"), "--iterations", "3", "--refit", "2"]
    assert cli.main([*encode, *given]) == 0
    assert "photograph of test views" in capsys.readouterr().out
    refit = ["refit", scene, "--reference", scene, "--steps", "2", "-o", str(tmp_path / "b.ply")]
    assert cli.main([*refit, *given]) == 0
