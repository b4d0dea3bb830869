"""The original implementation's cameras.json."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.formats import load_cameras
from tests.cases.cameras import pixel, refused, view, write_image, write_json
from tests.cases.own_warnings import warnings_are_errors


def test_cameras_json_is_camera_to_world(tmp_path):
    """The columns of ``rotation`` are the camera's axes: this camera looks along +x, its right is -z."""
    (camera,) = load_cameras(write_json(tmp_path / "cameras.json", [view()]))
    np.testing.assert_allclose(camera.centre, [1, 2, -5])
    assert (camera.width, camera.height, camera.fx, camera.fy) == (40, 30, 50, 60)
    assert pixel(camera, [11, 2, -5]) == pytest.approx((20, 15))
    assert pixel(camera, [11, 2, -6]) == pytest.approx((25, 15))
    assert pixel(camera, [11, 3, -5]) == pytest.approx((20, 21))


def test_cameras_json_without_split_are_training_views_with_ground_truth_beside_it(tmp_path):
    write_image(tmp_path / "images" / "a.JPG")
    views = [view(img_name=name) for name in ("a", "frame.0001", "missing.png")]
    cameras = load_cameras(write_json(tmp_path / "cameras.json", views))
    assert [camera.name for camera in cameras] == ["a", "frame.0001", "missing"]
    assert [camera.image_path for camera in cameras] == [tmp_path / "images" / "a.JPG", None, None]
    assert [camera.split for camera in cameras] == ["train"] * 3
    views[1]["split"] = "test"
    refused(write_json(tmp_path / "cameras.json", views), "view 'a': 'split' is missing")


def test_cameras_json_with_equal_names(tmp_path, caplog):
    """The original calls the r_0 of a synthetic scene's train folder and that of its test folder both r_0."""
    views = [view(img_name=name) for name in ("r_0", "r_1", "r_0")]
    cameras = load_cameras(write_json(tmp_path / "cameras.json", views))
    assert [camera.name for camera in cameras] == ["r_0", "r_1", "r_0_2"]
    assert "have the same name" in caplog.text
    views.append(view(img_name="r_0_2"))
    refused(write_json(tmp_path / "cameras.json", views), "more than one view has the image 'r_0_2'")


@pytest.mark.parametrize(
    ("field", "values", "message"),
    [
        ("width", [0], "'width' is 0.*, not a number of pixels"),
        ("height", [30.5], r"'height' is 30\.5, not a number of pixels"),
        ("width", [True], "'width' is True, not a finite number"),
        ("width", [10**400], "'width' is a number of more than 64 bits, not a finite number"),
        ("fx", [float("nan")], "'fx' is nan"),
        ("fy", [0], "camera 'a': intrinsics"),
        ("position", [[1, 2]], "'position' is a list of 2, not 3 numbers"),
        ("rotation", [[[x, 0, 0]] * 3 for x in (1, 1e200)], "camera 'a': the pose's 3 x 3 part is not a rotation"),
        ("rotation", [{}], "'rotation' is an object of 0 keys"),
        ("split", ["valid", ["train"] * 999], "'split' is ('valid', neither|a list of 999)"),
        ("img_name", [""], "'img_name' is '', not the name"),
    ],
)
@warnings_are_errors
def test_bad_views_in_cameras_json(field, values, message, tmp_path):
    for value in values:
        refused(write_json(tmp_path / "cameras.json", [view(**{field: value})]), message)
