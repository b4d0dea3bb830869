"""Camera files of every kind: they agree with each other, and bad ones say what is wrong."""

from __future__ import annotations

import json
import os
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from potr_cl import Camera, DataError, PotrError, UsageError
from potr_cl.formats import load_cameras
from potr_cl.formats.cameras import view_files
from potr_cl.model.camera import test_views as views_for_judging
from potr_cl.model.camera import train_views


def assert_same(a: list[Camera], b: list[Camera], tolerance: float = 1e-5) -> None:
    """The same views, in any order."""
    by_name = {camera.name: camera for camera in b}
    assert sorted(camera.name for camera in a) == sorted(by_name)
    for one in a:
        two = by_name[one.name]
        np.testing.assert_allclose(one.rotation, two.rotation, atol=tolerance, err_msg=one.name)
        np.testing.assert_allclose(one.centre, two.centre, atol=tolerance, err_msg=one.name)
        for field in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(one, field) == pytest.approx(getattr(two, field), rel=1e-6), (one.name, field)
        assert one.split == two.split, one.name


def write_json(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def write_image(path: Path, width: int = 8, height: int = 6) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (width, height)).save(path)
    return path


def refused(path: Path, message: str, kind: type[PotrError] = DataError) -> None:
    with pytest.raises(kind, match=message) as caught:
        load_cameras(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def pixel(camera: Camera, point: list[float]) -> tuple[float, float]:
    """Where a world point appears, by Camera's definition."""
    t = camera.rotation @ np.array(point) + camera.translation
    assert t[2] > 0, "behind the camera"
    return camera.fx * t[0] / t[2] + camera.cx, camera.fy * t[1] / t[2] + camera.cy


# The same views in different formats ---------------------------------------------------------------------------------


def test_lego_excerpt_as_cameras_json_and_as_transforms(data: Path, tmp_path: Path) -> None:
    shutil.copytree(data / "lego_transforms", tmp_path, dirs_exist_ok=True)
    expected = load_cameras(data / "lego_cameras.json")
    for camera in expected:
        write_image(tmp_path / "images" / f"{camera.name}.png", 400, 400)
    loaded = load_cameras(tmp_path)
    assert_same(loaded, expected)
    assert len(train_views(loaded)) == 9
    assert len(views_for_judging(loaded)) == 3
    assert loaded[0].image_path == tmp_path / "images" / f"{loaded[0].name}.png"
    assert [c.name for c in load_cameras(tmp_path / "transforms_test.json")] == [c.name for c in loaded[9:]]


@pytest.mark.parametrize("model", ["plush_sparse_binary", "plush_sparse_text"])
def test_plush_excerpt_as_cameras_json_and_as_colmap_model(model: str, data: Path) -> None:
    expected = load_cameras(data / "plush_cameras.json")
    assert_same(load_cameras(data / model), expected, 1e-9)
    assert [c.split for c in load_cameras(data / model)].count("test") == 3
    some_file = next((data / model).iterdir())
    assert_same(load_cameras(some_file), expected, 1e-9)


def test_whole_lego(lego: Path) -> None:
    from_json = load_cameras(lego / "cameras.json")
    train, test = (load_cameras(lego / f"transforms_{split}.json") for split in ("train", "test"))
    assert_same(from_json, train + test)
    assert len(train_views(from_json)) == 100
    assert all(camera.image_path == other.image_path for camera, other in zip(from_json, train + test, strict=True))


def test_whole_plush(plush: Path) -> None:
    from_json, from_model = load_cameras(plush / "cameras.json"), load_cameras(plush / "sparse" / "0")
    assert_same(from_json, from_model)
    assert len(views_for_judging(from_model)) == 13
    for camera in from_model:
        assert camera.image_path is not None
        with Image.open(camera.image_path) as image:
            assert image.size == (camera.width, camera.height)


# cameras.json --------------------------------------------------------------------------------------------------------


def view(**changes: Any) -> dict[str, Any]:
    base = {
        "id": 0,
        "img_name": "a",
        "width": 40,
        "height": 30,
        "position": [1.0, 2.0, -5.0],
        "rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
        "fx": 50.0,
        "fy": 60,
    }
    return base | changes


def test_cameras_json_is_camera_to_world(tmp_path: Path) -> None:
    """The columns of ``rotation`` are the camera's axes: this camera looks along +x, its right is -z."""
    (camera,) = load_cameras(write_json(tmp_path / "cameras.json", [view()]))
    np.testing.assert_allclose(camera.centre, [1, 2, -5])
    assert (camera.width, camera.height, camera.fx, camera.fy) == (40, 30, 50, 60)
    assert pixel(camera, [11, 2, -5]) == pytest.approx((20, 15))
    assert pixel(camera, [11, 2, -6]) == pytest.approx((25, 15))
    assert pixel(camera, [11, 3, -5]) == pytest.approx((20, 21))


def test_cameras_json_without_split_are_training_views(tmp_path: Path) -> None:
    views = [view(img_name=name) for name in "abc"]
    cameras = load_cameras(write_json(tmp_path / "cameras.json", views))
    assert [camera.split for camera in cameras] == ["train"] * 3
    views[1]["split"] = "test"
    refused(write_json(tmp_path / "cameras.json", views), "view 'a': 'split' is missing")


def test_cameras_json_finds_ground_truth_beside_it(tmp_path: Path) -> None:
    write_image(tmp_path / "images" / "a.JPG")
    views = [view(img_name=name) for name in ("a", "frame.0001", "missing.png")]
    cameras = load_cameras(write_json(tmp_path / "cameras.json", views))
    assert [camera.name for camera in cameras] == ["a", "frame.0001", "missing"]
    assert [camera.image_path for camera in cameras] == [tmp_path / "images" / "a.JPG", None, None]


def test_cameras_json_with_equal_names(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The original calls the r_0 of a synthetic scene's train folder and that of its test folder both r_0."""
    views = [view(img_name=name) for name in ("r_0", "r_1", "r_0")]
    cameras = load_cameras(write_json(tmp_path / "cameras.json", views))
    assert [camera.name for camera in cameras] == ["r_0", "r_1", "r_0_2"]
    assert "have the same name" in caplog.text
    views.append(view(img_name="r_0_2"))
    refused(write_json(tmp_path / "cameras.json", views), "more than one view has the image 'r_0_2'")


# transforms.json -----------------------------------------------------------------------------------------------------

IDENTITY = np.eye(4).tolist()


def nerfstudio(files: list[str], **changes: Any) -> dict[str, Any]:
    frames = [{"file_path": f"images/{file}", "transform_matrix": IDENTITY} for file in files]
    base = {"camera_model": "OPENCV", "fl_x": 50, "fl_y": 60, "cx": 21, "cy": 14, "w": 40, "h": 30, "k1": 0.0, "p1": 0}
    return base | {"frames": frames} | changes


def test_transforms_have_opengl_axes(tmp_path: Path) -> None:
    """The camera looks along -z, its up is +y."""
    (camera,) = load_cameras(write_json(tmp_path / "transforms.json", nerfstudio(["a.png"])))
    assert camera.name == "a"
    assert pixel(camera, [0, 0, -10]) == pytest.approx((21, 14))
    assert pixel(camera, [1, 0, -10]) == pytest.approx((26, 14))
    assert pixel(camera, [0, 1, -10]) == pytest.approx((21, 8))


def test_blender_intrinsics_come_from_the_angle_and_the_image(tmp_path: Path) -> None:
    write_image(tmp_path / "train" / "r_0.png", 80, 60)
    frames = [{"file_path": "./train/r_0", "transform_matrix": IDENTITY}]
    content = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
    (camera,) = load_cameras(write_json(tmp_path / "transforms_train.json", content))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 60, 40, 30)
    assert (camera.fx, camera.fy) == pytest.approx((80, 80))
    assert camera.image_path == tmp_path / "train" / "r_0.png"
    os.remove(tmp_path / "train" / "r_0.png")
    refused(
        tmp_path / "transforms_train.json", r"frame 0: the size of the view is unknown: .*r_0\.png' cannot be opened"
    )
    (tmp_path / "train" / "r_0.png").write_bytes(b"no image")
    refused(tmp_path / "transforms_train.json", "the size of the view is unknown")
    (camera,) = load_cameras(write_json(tmp_path / "transforms_train.json", content | {"w": 80, "h": 60.0}))
    assert (camera.width, camera.height, camera.fx) == pytest.approx((80, 60, 80))


def test_equal_names_in_the_train_and_test_folder(tmp_path: Path) -> None:
    for split in ("train", "test"):
        frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": IDENTITY} for i in range(2)]
        write_json(tmp_path / f"transforms_{split}.json", {"camera_angle_x": 1, "w": 8, "h": 8, "frames": frames})
    cameras = load_cameras(tmp_path)
    assert [camera.name for camera in cameras] == ["train/r_0", "train/r_1", "test/r_0", "test/r_1"]
    assert [camera.split for camera in cameras] == ["train", "train", "test", "test"]


def test_a_frame_has_its_own_intrinsics(tmp_path: Path) -> None:
    content = nerfstudio(["a.png", "b.png", "c.png"])
    content["frames"][1] |= {"fl_x": 70, "w": 44, "cx": 23.5}
    a, b, c = load_cameras(write_json(tmp_path / "transforms.json", content))
    assert (b.fx, b.fy, b.cx, b.cy, b.width, b.height) == (70, 60, 23.5, 14, 44, 30)
    assert (a.fx, a.cx, a.width) == (c.fx, c.cx, c.width) == (50, 21, 40)


def test_each_eighth_image_by_name_is_a_test_view(tmp_path: Path) -> None:
    files = [f"{i:02}.jpg" for i in range(17)]
    cameras = load_cameras(write_json(tmp_path / "transforms.json", nerfstudio(files[::-1])))
    assert sorted(c.name for c in cameras if c.split == "test") == ["00", "08", "16"]


@pytest.mark.parametrize(
    ("lists", "test"),
    [
        ({"train_filenames": ["a", "b"], "val_filenames": ["c"], "test_filenames": ["c"]}, "cd"),
        ({"train_filenames": ["a", "b", "c", "d"], "test_filenames": ["a"]}, ""),
        ({"val_filenames": ["b"], "test_filenames": ["c"]}, "bc"),
        ({"train_filenames": ["b", "c", "d"]}, "a"),
    ],
)
def test_splits_that_the_file_lists(lists: dict[str, list[str]], test: str, tmp_path: Path) -> None:
    lists = {key: [f"images/{name}.png" for name in names] for key, names in lists.items()}
    content = nerfstudio([f"{name}.png" for name in "abcd"], **lists)
    cameras = load_cameras(write_json(tmp_path / "transforms.json", content))
    assert [c.name for c in cameras if c.split == "test"] == list(test)


def test_views_are_moved_to_nerfstudios_training_space(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Nerfstudio orients, centres and scales what the file holds, and notes that step after the applied one."""
    rng = np.random.default_rng(5)

    def rigid() -> np.ndarray:
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = q * np.linalg.det(q), rng.normal(size=3)
        return pose

    applied, oriented, pose = rigid(), rigid(), rigid()
    applied_scale, scale = 2.0, 0.3
    content = nerfstudio(["a.png"], applied_transform=applied[:3].tolist(), applied_scale=applied_scale)
    content["frames"][0]["transform_matrix"] = pose.tolist()
    path = write_json(tmp_path / "transforms.json", content)
    (plain,) = load_cameras(path)
    noted = {"transform": (oriented @ applied)[:3].tolist(), "scale": scale * applied_scale}
    write_json(tmp_path / "dataparser_transforms.json", noted)
    (moved,) = load_cameras(path)
    assert "moved the views to the training space" in caplog.text

    seen = plain.centre + plain.rotation.T @ [0.1, -0.2, 3.0]
    trained = scale * (oriented @ [*seen, 1])[:3]
    assert pixel(moved, trained) == pytest.approx(pixel(plain, seen))
    np.testing.assert_allclose(moved.centre, scale * (oriented @ [*plain.centre, 1])[:3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k1": 0.01}, r"frame 0: 'k1' is 0\.01, only undistorted views .*'colmap image_undistorter'"),
        ({"k4": -1e-9}, "'k4' is -1e-09"),
        ({"camera_model": "OPENCV_FISHEYE"}, "'camera_model' is 'OPENCV_FISHEYE', only pinhole cameras"),
        ({"camera_model": "EQUIRECTANGULAR"}, "only pinhole cameras"),
        ({"is_fisheye": True}, "'is_fisheye' is set"),
        ({"fl_x": None}, "frame 0: neither 'fl_x' nor 'camera_angle_x' is given"),
        ({"fl_x": None, "camera_angle_x": 4}, "'camera_angle_x' is 4.0, not an angle"),
        ({"fl_x": -1}, "camera 'a': intrinsics"),
        ({"fl_x": "50"}, "'fl_x' is '50', not a finite number"),
        ({"w": 0}, "'w' is 0.*not a number of pixels"),
        ({"h": 1 << 40}, "not a number of pixels from 1 to"),
        ({"frames": []}, "holds no view"),
        ({"frames": {}}, "not an object with a list 'frames'"),
        ({"frames": [7]}, "frame 0 is 7, not an object"),
        ({"frames": [{}]}, "frame 0: 'file_path' is missing"),
        ({"frames": [{"file_path": "a"}]}, "frame 0: 'transform_matrix' is missing"),
        ({"frames": [{"file_path": "a\nb"}]}, "not the name of an image"),
        ({"frames": [{"file_path": 3}]}, "'file_path' is 3"),
        ({"train_filenames": ["images/z.png"]}, "'train_filenames' names 'images/z.png', which is the file_path of no"),
        ({"train_filenames": 3}, "'train_filenames' is 3, not a list"),
    ],
)
def test_bad_transforms(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    refused(write_json(tmp_path / "transforms.json", nerfstudio(["a.png"], **changes)), message)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ([[1, 0, 0]], "is a list of 1, not 4 x 4 or 3 x 4 numbers"),
        (np.diag([2.0, 2, 2, 1]).tolist(), "camera 'a': the pose's 3 x 3 part is not a rotation"),
        (np.diag([1.0, 1, -1, 1]).tolist(), "not a rotation"),
        (np.diag([1.0, 1, 1, 2]).tolist(), "its last row is not 0 0 0 1"),
        (np.full((4, 4), np.nan).tolist(), "holds a non-finite value"),
        ([[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0]], "not 4 x 4 or 3 x 4 numbers"),
        ([["a"] * 4] * 4, "not 4 x 4 or 3 x 4 numbers"),
        ([[1, 2], [3]], "not 4 x 4 or 3 x 4 numbers"),
    ],
)
def test_bad_poses(pose: Any, message: str, tmp_path: Path) -> None:
    content = nerfstudio(["a.png"])
    content["frames"][0]["transform_matrix"] = pose
    refused(write_json(tmp_path / "transforms.json", content), message)


def test_bad_dataparser_transforms(tmp_path: Path) -> None:
    path = write_json(tmp_path / "transforms.json", nerfstudio(["a.png"]))
    for content, message in [
        ([], "it is not an object"),
        ({"scale": 1}, "'transform' is missing"),
        ({"transform": np.diag([2, 2, 2, 1]).tolist(), "scale": 1}, "not a rotation and a translation"),
        ({"transform": IDENTITY, "scale": 0}, "'scale' is 0.0, not above 0"),
        ({"transform": IDENTITY, "scale": float("nan")}, "'scale' is nan, not a finite number"),
    ]:
        write_json(tmp_path / "dataparser_transforms.json", content)
        refused(path, message)


# COLMAP --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def model(data: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(data / "plush_sparse_binary", tmp_path / "sparse" / "0"))


@pytest.fixture
def text_model(data: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(data / "plush_sparse_text", tmp_path / "sparse" / "0"))


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_a_model_with_points_rigs_and_several_cameras(write: str, tmp_path: Path) -> None:
    """Against what pycolmap itself reads from the whole model."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_PINHOLE
    options.camera_params = [900.0, 500.0, 380.0]
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 9, 60
    options.sensor_from_rig_translation_stddev = 0.1
    options.sensor_from_rig_rotation_stddev = 5.0
    reconstruction = pycolmap.synthesize_dataset(options)
    getattr(reconstruction, write)(tmp_path)
    expected = {Path(image.name).stem: image for image in reconstruction.images.values()}
    assert sum(image.num_points3D for image in expected.values()) > 100
    cameras = load_cameras(tmp_path)
    assert sorted(camera.name for camera in cameras) == sorted(expected)
    for camera in cameras:
        pose = expected[camera.name].cam_from_world().matrix()
        np.testing.assert_allclose(np.column_stack([camera.rotation, camera.translation]), pose, atol=1e-9)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (900, 900, 500, 380)
    in_order = [camera.split for camera in sorted(cameras, key=lambda camera: camera.name)]
    assert [i for i, split in enumerate(in_order) if split == "test"] == list(range(0, len(cameras), 8))


def test_ground_truth_of_a_model(model: Path, tmp_path: Path) -> None:
    assert load_cameras(model)[0].image_path is None
    image = write_image(tmp_path / "images" / "20240212_003919.jpg")
    assert [c.image_path for c in load_cameras(tmp_path)] == [image, *[None] * 16]


def test_folders_in_image_names_tell_views_apart(text_model: Path) -> None:
    images = text_model / "images.txt"
    renamed = images.read_text().replace("20240212_003920.jpg", "right_camera_centre/20240212_003919.jpg")
    images.write_text(renamed)
    names = [camera.name for camera in load_cameras(text_model)]
    assert names[0] == "20240212_003919"
    assert names[-1] == "right_camera_centre/20240212_003919"
    images.write_text(renamed.replace("20240212_003921", "20240212_003919"))
    refused(text_model, r"more than one view has the image '20240212_003919\.jpg'")


def test_distorted_camera_models(model: Path, text_model_lines: Callable[[str], Path]) -> None:
    data = (model / "cameras.bin").read_bytes()
    for number, name in ((2, "SIMPLE_RADIAL"), (4, "OPENCV"), (5, "OPENCV_FISHEYE"), (99, "number 99")):
        (model / "cameras.bin").write_bytes(data[:12] + struct.pack("<i", number) + data[16:])
        refused(
            model, f"camera 1 has the model '{name}', only SIMPLE_PINHOLE and PINHOLE .* 'colmap image_undistorter'"
        )
    refused(text_model_lines("1 OPENCV 990 742 800 800 495 371 0 0 0 0\n"), "'1' has the model 'OPENCV', only")


@pytest.fixture
def text_model_lines(data: Path, tmp_path: Path) -> Callable[[str], Path]:
    def write(cameras: str) -> Path:
        folder = tmp_path / "text"
        shutil.copytree(data / "plush_sparse_text", folder, dirs_exist_ok=True)
        (folder / "cameras.txt").write_text(cameras)
        return folder

    return write


def test_damaged_text_models(text_model_lines: Callable[[str], Path]) -> None:
    for line in ("1 PINHOLE 990\n", "1 PINHOLE 990 742 800 800 495\n", "PINHOLE\n"):
        refused(text_model_lines(line), r"cameras\.txt' is truncated, or is no file of a COLMAP model")
    for line in ("", "# nothing\n", "2 PINHOLE 990 742 800 800 495 371\n", "1 PINHOLE x y 800 800 495 371\n"):
        refused(text_model_lines(line), "is a damaged COLMAP model: ")
    refused(text_model_lines("1 PINHOLE 990 742 nan 800 495 371\n"), "intrinsics|damaged")
    refused(
        text_model_lines("1 PINHOLE 990 99999999 800 800 495 371\n"),
        "the height of its camera is 99999999, not a number of pixels",
    )


def test_every_truncation_of_a_binary_model(model: Path) -> None:
    """The library itself would take the missing bytes from whatever is in memory, or never return."""
    for name in ("cameras.bin", "images.bin"):
        data = (model / name).read_bytes()
        for size in range(0, len(data), 1 if name == "cameras.bin" else 13):
            (model / name).write_bytes(data[:size])
            refused(model, f"{name}' is truncated, or is no file of a COLMAP model")
        (model / name).write_bytes(data + b"\0")
        refused(model, f"{name}' is truncated, or is no file of a COLMAP model")
        (model / name).write_bytes(struct.pack("<Q", 1 << 60) + data[8:])
        refused(model, f"{name}' is truncated, or is no file of a COLMAP model")
        (model / name).write_bytes(data)
    assert len(load_cameras(model)) == 17


def test_unusable_values_in_a_binary_model(model: Path) -> None:
    data = (model / "images.bin").read_bytes()
    for at, value, message in [
        (12, struct.pack("<d", np.nan), "view '20240212_003919': its rotation is not a unit quaternion"),
        (12, bytes(32), "view '20240212_003919': its rotation is not a unit quaternion"),
        (44, struct.pack("<d", np.inf), "the pose holds a non-finite value"),
        (68, struct.pack("<I", 77), "is a damaged COLMAP model"),
        (72, b"\xff\xfe", "the name of an image is not UTF-8"),
        (72, b"\n", "not the name of an image"),
    ]:
        (model / "images.bin").write_bytes(data[:at] + value + data[at + len(value) :])
        refused(model, message)
    (model / "images.bin").write_bytes(bytes(8))
    refused(model, "holds no view")
    os.remove(model / "images.bin")
    refused(model, r"cannot read '.*images\.bin': No such file", UsageError)


def test_without_pycolmap(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    refused(model, r'needs pycolmap: pip install "potr-cl\[colmap\]"', UsageError)


# Finding the kind ----------------------------------------------------------------------------------------------------


def test_folders(data: Path, tmp_path: Path) -> None:
    refused(tmp_path, "holds no cameras, expected a cameras.json, a transforms.json or a COLMAP model", UsageError)
    shutil.copytree(data / "plush_sparse_binary", tmp_path / "sparse")
    assert len(load_cameras(tmp_path)) == 17
    write_json(tmp_path / "transforms.json", nerfstudio(["a.png", "b.png"]))
    assert len(load_cameras(tmp_path)) == 2
    write_json(tmp_path / "cameras.json", [view()])
    assert len(load_cameras(tmp_path)) == 1


def test_any_file_name(data: Path, tmp_path: Path) -> None:
    shutil.copy(data / "plush_cameras.json", tmp_path / "views of mine.JSON")
    assert len(load_cameras(tmp_path / "views of mine.JSON")) == 17
    write_json(tmp_path / "poses.json", nerfstudio(["a.png"]))
    assert len(load_cameras(tmp_path / "poses.json")) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not valid JSON"),
        (b"{", "is not valid JSON"),
        (b"\xff\xfe\x00", "is not valid JSON"),
        (b"[" * 200_000, "is nested too deeply"),
        (b"[" + b"9" * 5000 + b"]", "is not valid JSON|not a list of views"),
        (b"3", "is neither a cameras.json"),
        (b'{"a": 1}', "is neither a cameras.json"),
        (b"[]", "holds no view"),
        (b"[1]", "not a list of views"),
        (b"[{}]", "view 0: 'img_name' is missing"),
        (b'[{"img_name": "a"}]', "view 'a': 'width' is missing"),
        (b'[{"img_name": "\\ud800"}]', "not the name of an image"),
    ],
)
def test_json_of_no_known_kind(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(content)
    refused(tmp_path / "a.json", message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "'width' is 0.*, not a number of pixels"),
        ({"height": 30.5}, r"'height' is 30\.5, not a number of pixels"),
        ({"width": True}, "'width' is True, not a finite number"),
        ({"width": 10**400}, "'width' is a number of more than 64 bits, not a finite number"),
        ({"fx": float("nan")}, "'fx' is nan"),
        ({"fy": 0}, "camera 'a': intrinsics"),
        ({"position": [1, 2]}, "'position' is a list of 2, not 3 numbers"),
        ({"rotation": [[1, 0, 0]] * 3}, "camera 'a': the pose's 3 x 3 part is not a rotation"),
        ({"rotation": [[1e200, 0, 0]] * 3}, "camera 'a': the pose's 3 x 3 part is not a rotation"),
        ({"rotation": {}}, "'rotation' is an object of 0 keys"),
        ({"split": "valid"}, "'split' is 'valid', neither"),
        ({"split": ["train"] * 999}, "'split' is a list of 999"),
        ({"img_name": ""}, "'img_name' is '', not the name"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_views_in_cameras_json(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    refused(write_json(tmp_path / "cameras.json", [view(**changes)]), message)


def test_paths_of_no_known_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(tmp_path / "missing.json", "cannot read '.*missing.json': No such file", UsageError)
    refused(tmp_path / "missing", "there is no file or folder", UsageError)
    (tmp_path / "notes.txt").write_bytes(b"")
    refused(tmp_path / "notes.txt", "unknown kind of cameras", UsageError)
    (tmp_path / "a.json").mkdir()
    refused(tmp_path / "a.json", "holds no cameras", UsageError)
    monkeypatch.setattr(view_files, "_MAX_JSON_BYTES", 10)
    refused(write_json(tmp_path / "b.json", [view()]), "too large for a camera file")


# Fuzzing -------------------------------------------------------------------------------------------------------------

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


def load_or_refuse(path: Path) -> None:
    message = ""
    try:
        assert load_cameras(path)
    except PotrError as error:
        message = str(error)
    assert "\n" not in message
    assert len(message) < 1000


def replace_somewhere(draw: st.DataObject, value: Any) -> Any:
    """The JSON value with one of its parts replaced by another value, or dropped."""
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not keys or draw.draw(st.integers(0, 9)) == 0:
        return draw.draw(JSON)
    key = draw.draw(st.sampled_from(keys))
    copy = value.copy()
    if draw.draw(st.integers(0, 9)) == 0:
        del copy[key]
    else:
        copy[key] = replace_somewhere(draw, value[key])
    return copy


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("content", [[view(), view(img_name="b", split="test")], nerfstudio(["a.png", "b.png"])])
@given(draw=st.data())
@settings(max_examples=300, deadline=None)
def test_json_with_replaced_parts(content: Any, draw: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    for _ in range(draw.draw(st.integers(1, 3))):
        content = replace_somewhere(draw, content)
    load_or_refuse(write_json(tmp_path_factory.getbasetemp() / "fuzz.json", content))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("model", ["plush_sparse_binary", "plush_sparse_text"])
@given(draw=st.data())
@settings(max_examples=200, deadline=None)
def test_mutated_models(model: str, draw: st.DataObject, data: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.getbasetemp() / f"fuzz_{model}"
    folder.mkdir(exist_ok=True)
    for source in (data / model).iterdir():
        content = bytearray(source.read_bytes())
        for _ in range(draw.draw(st.integers(0, 4))):
            at = draw.draw(st.integers(0, len(content)))
            content[at : at + draw.draw(st.integers(0, 9))] = draw.draw(st.binary(max_size=9))
        (folder / source.name).write_bytes(content)
    load_or_refuse(folder)
