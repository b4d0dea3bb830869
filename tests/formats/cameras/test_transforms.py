"""transforms.json of Blender and of nerfstudio."""

from __future__ import annotations

import io
import os

import numpy as np
import pytest
from PIL import Image

from potr_cl.formats import load_cameras
from potr_cl.model import lens
from potr_cl.model.lens import Lens
from tests.cases.cameras import IDENTITY, nerfstudio, pixel, refused, write_image, write_json
from tests.cases.images import png_of
from tests.cases.own_warnings import warnings_are_errors


def test_transforms_have_opengl_axes(tmp_path):
    """The camera looks along -z, its up is +y."""
    (camera,) = load_cameras(write_json(tmp_path / "transforms.json", nerfstudio(["a.png"])))
    assert camera.name == "a"
    assert pixel(camera, [0, 0, -10]) == pytest.approx((21, 14))
    assert pixel(camera, [1, 0, -10]) == pytest.approx((26, 14))
    assert pixel(camera, [0, 1, -10]) == pytest.approx((21, 8))


def test_blender_intrinsics_come_from_the_angle_and_the_image(tmp_path):
    write_image(tmp_path / "train" / "r_0.png", 80, 60)
    frames = [{"file_path": "./train/r_0", "transform_matrix": IDENTITY}]
    content = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
    (camera,) = load_cameras(write_json(tmp_path / "transforms_train.json", content))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 60, 40, 30)
    assert (camera.fx, camera.fy) == pytest.approx((80, 80))
    assert camera.image_path == tmp_path / "train" / "r_0.png"
    os.remove(tmp_path / "train" / "r_0.png")
    refused(
        tmp_path / "transforms_train.json", r"frame 0: the size of the view is unknown: .*r_0.png' cannot be opened"
    )
    (camera,) = load_cameras(write_json(tmp_path / "transforms_train.json", content | {"w": 80, "h": 60.0}))
    assert (camera.width, camera.height, camera.fx) == pytest.approx((80, 60, 80))


def test_equal_names_in_the_train_and_test_folder(tmp_path):
    for split in ("train", "test"):
        frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": IDENTITY} for i in range(2)]
        write_json(tmp_path / f"transforms_{split}.json", {"camera_angle_x": 1, "w": 8, "h": 8, "frames": frames})
    cameras = load_cameras(tmp_path)
    assert [camera.name for camera in cameras] == ["train/r_0", "train/r_1", "test/r_0", "test/r_1"]
    assert [camera.split for camera in cameras] == ["train", "train", "test", "test"]


def test_a_frame_has_its_own_intrinsics_and_lens(tmp_path):
    content = nerfstudio(["a.png", "b.png", "c.png"])
    content["frames"][0] |= {"k1": -0.05}
    content["frames"][1] |= {"fl_x": 70, "w": 44, "cx": 23.5}
    a, b, c = load_cameras(write_json(tmp_path / "transforms.json", content))
    assert a.lens == Lens(40, 30, 50, 60, 21, 14, radial=(-0.05,))
    assert (b.fx, b.fy, b.cx, b.cy, b.width, b.height) == (70, 60, 23.5, 14, 44, 30)
    assert (c.fx, c.fy, c.cx, c.cy, c.width, c.height) == (50, 60, 21, 14, 40, 30)
    assert (b.lens, c.lens) == (None, None)


def test_each_eighth_image_by_name_is_a_test_view(tmp_path):
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
def test_splits_that_the_file_lists(lists, test, tmp_path):
    lists = {key: [f"images/{name}.png" for name in names] for key, names in lists.items()}
    content = nerfstudio([f"{name}.png" for name in "abcd"], **lists)
    cameras = load_cameras(write_json(tmp_path / "transforms.json", content))
    assert [c.name for c in cameras if c.split == "test"] == list(test)


def test_views_are_moved_to_nerfstudios_training_space(tmp_path, caplog):
    """Nerfstudio orients, centres and scales what the file holds, and notes that step after the applied one."""
    rng = np.random.default_rng(5)

    def rigid():
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
    assert "put the dataparser_transforms.json of the training's output folder beside the file" in caplog.text
    caplog.clear()
    noted = {"transform": (oriented @ applied)[:3].tolist(), "scale": scale * applied_scale}
    write_json(tmp_path / "dataparser_transforms.json", noted)
    (moved,) = load_cameras(path)
    assert "moved the views to the training space" in caplog.text
    assert "taken as they stand" not in caplog.text

    seen = plain.centre + plain.rotation.T @ [0.1, -0.2, 3.0]
    trained = scale * (oriented @ [*seen, 1])[:3]
    assert pixel(moved, trained) == pytest.approx(pixel(plain, seen))
    np.testing.assert_allclose(moved.centre, scale * (oriented @ [*plain.centre, 1])[:3])


@pytest.mark.parametrize(
    ("changes", "terms"),
    [
        ({"k1": 0.01}, {"radial": (0.01,)}),
        ({"k1": 0.01, "k2": 0.002, "p1": 1e-3, "p2": 2e-3}, {"radial": (0.01, 0.002), "tangential": (1e-3, 2e-3)}),
        ({"k3": 0.001}, {"radial": (0, 0, 0.001)}),
        ({"camera_model": "OPENCV_FISHEYE"}, {"fisheye": True}),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.01}, {"fisheye": True, "radial": (0, 0, 0, 0.01)}),
        ({"is_fisheye": True, "k1": 0.02}, {"fisheye": True, "radial": (0.02,)}),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.02}, {"radial": (0.02,)}),
    ],
)
def test_lenses(changes, terms, tmp_path):
    cameras = load_cameras(write_json(tmp_path / "transforms.json", nerfstudio(["a.png", "b.png"], **changes)))
    expected = Lens(40, 30, 50, 60, 21, 14, **terms)
    assert [camera.lens for camera in cameras] == [expected] * 2
    assert (cameras[0].width, cameras[0].height) == expected.covering()[0][:2]


def test_a_lens_for_each_frame_costs_no_more_calls(tmp_path, monkeypatch):
    """They are looked at together: a file of hostile lenses takes as long as its size lets expect."""
    calls: list[int] = []
    bent = lens._Terms.bent
    monkeypatch.setattr(lens._Terms, "bent", lambda terms, points: calls.append(points.size) or bent(terms, points))
    counts = []
    for views in (1, 60):
        calls.clear()
        content = nerfstudio([f"{number}.png" for number in range(views)])
        for number, frame in enumerate(content["frames"]):
            frame |= {"k1": -0.05 - 1e-4 * number, "k2": 0.01}
        load_cameras(write_json(tmp_path / "transforms.json", content))
        counts.append(len(calls))
    assert counts[1] <= 2 * counts[0]


#: What is no pose, with what is said of it.
POSES = [
    (np.diag([2.0, 2, 2, 1]).tolist(), "camera 'a': the pose's 3 x 3 part is not a rotation"),
    (np.diag([1.0, 1, -1, 1]).tolist(), "not a rotation"),
    (np.diag([1.0, 1, 1, 2]).tolist(), "its last row is not 0 0 0 1"),
    (np.full((4, 4), np.nan).tolist(), "holds a non-finite value"),
    ([[1, 0, 0]], "is a list of 1, not 4 x 4 or 3 x 4 numbers"),
    ([[1, 0, 0, 10**400], [0, 1, 0, 0], [0, 0, 1, 0]], "not 4 x 4 or 3 x 4 numbers"),
    ([["a"] * 4] * 4, "not 4 x 4 or 3 x 4 numbers"),
    ([[1, 2], [3]], "not 4 x 4 or 3 x 4 numbers"),
]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k1": -30}, "frame 0: its lens distortion folds the picture over"),
        ({"k1": "a"}, "'k1' is 'a', not a finite number"),
        ({"camera_model": "EQUIRECTANGULAR"}, "is 'EQUIRECTANGULAR', whose pictures no pinhole view can"),
        ({"camera_model": 3}, "'camera_model' is 3"),
        ({"fl_x": None}, "frame 0: neither 'fl_x' nor 'camera_angle_x' is given"),
        ({"fl_x": None, "camera_angle_x": 4}, "'camera_angle_x' is 4.0, not an angle"),
        ({"fl_x": -1}, "camera 'a': intrinsics"),
        ({"fl_x": "50"}, "'fl_x' is '50', not a finite number"),
        ({"w": 0}, "'w' is 0.*not a number of pixels"),
        ({"h": 1 << 40}, "not a number of pixels from 1 to"),
        ({"frames": []}, "has no views"),
        ({"frames": {}}, "not an object with a list 'frames'"),
        ({"frames": [7]}, "frame 0 is 7, not an object"),
        ({"frames": [{}]}, "frame 0: 'file_path' is missing"),
        ({"frames": [{"file_path": "a"}]}, "frame 0: 'transform_matrix' is missing"),
        ({"frames": [{"file_path": "a\nb"}]}, "not the name of an image"),
        ({"frames": [{"file_path": 3}]}, "'file_path' is 3"),
        ({"train_filenames": ["images/z.png"]}, "'train_filenames' names 'images/z.png', which is the file_path of no"),
        ({"train_filenames": 3}, "'train_filenames' is 3, not a list"),
        *(({"frames": [{"file_path": "a", "transform_matrix": pose}]}, message) for pose, message in POSES),
    ],
)
def test_bad_transforms(changes, message, tmp_path):
    refused(write_json(tmp_path / "transforms.json", nerfstudio(["a.png"], **changes)), message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "it is not an object"),
        ({"scale": 1}, "'transform' is missing"),
        ({"transform": np.diag([2, 2, 2, 1]).tolist(), "scale": 1}, "not a rotation and a translation"),
        ({"transform": IDENTITY, "scale": 0}, "'scale' is 0.0, not above 0"),
        ({"transform": IDENTITY, "scale": float("nan")}, "'scale' is nan, not a finite number"),
    ],
)
def test_bad_dataparser_transforms(content, message, tmp_path):
    write_json(tmp_path / "dataparser_transforms.json", content)
    refused(write_json(tmp_path / "transforms.json", nerfstudio(["a.png"])), message)


def bmp() -> bytes:
    Image.new("RGB", (8, 8)).save(file := io.BytesIO(), "BMP")
    return file.getvalue()


@warnings_are_errors
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (png_of(70_000, 10), "r_0.png': the width is 70000, not a number of pixels from 1 to 65536"),
        (png_of(10, 70_000), "r_0.png': the height is 70000, not a number of pixels from 1 to 65536"),
        (png_of(12_000, 12_000), "the size of the view is unknown: .* 12000 x 12000 pixels, at most"),
        (png_of(60_000, 60_000), "the size of the view is unknown: .* pixels"),
        (png_of(0, 10), "the size of the view is unknown|not a number of pixels"),
        (b"no image", "the size of the view is unknown"),
        (bmp(), "the size of the view is unknown: .*no PNG, JPEG or WebP image"),
    ],
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_sizes_that_only_the_image_tells_have_limits(tmp_path, image, message):
    content = nerfstudio(["r_0.png"])
    del content["w"], content["h"]
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "r_0.png").write_bytes(image)
    refused(write_json(tmp_path / "transforms.json", content), message)
