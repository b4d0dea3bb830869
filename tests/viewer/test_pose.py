"""The browser's camera and ours."""

import dataclasses
import math

import numpy as np
import pytest

from potr_cl.viewer.pose import Gaze, camera_of, gaze_on, place_in, rotation_of


def off_centre(camera, cx, cy):
    return dataclasses.replace(camera, cx=cx, cy=cy)


def test_a_view_comes_back_as_it_was(plush_excerpt_cameras):
    for camera in plush_excerpt_cameras:
        camera = dataclasses.replace(camera, cx=camera.width / 2, cy=camera.height / 2, fy=camera.fx)
        back = camera_of(gaze_on(camera, camera.width / camera.height), camera.width, camera.height)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(back, name) == pytest.approx(getattr(camera, name))
        assert back.rotation == pytest.approx(camera.rotation, abs=1e-6)
        assert back.translation == pytest.approx(camera.translation, abs=1e-5)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 16 / 9, 3.0])
@pytest.mark.parametrize(("cx", "cy"), [(120, 90), (60, 130), (-20, 90)])
def test_the_whole_view_is_in_the_picture(plush_excerpt_cameras, aspect, cx, cy):
    camera = off_centre(plush_excerpt_cameras[0], cx, cy)
    outer = camera_of(gaze_on(camera, aspect), round(400 * aspect), 400)
    place = place_in(camera, outer)
    assert place is not None
    # One pixel of the smaller picture may be cut where the larger one has no whole pixel for it.
    scale = max(camera.fx / outer.fx, camera.fy / outer.fy)
    left, top, right, bottom = place.box
    assert max(left, top) <= scale
    assert right >= camera.width - scale
    assert bottom >= camera.height - scale
    assert place.right - place.left == pytest.approx((right - left) * outer.fx / camera.fx, abs=0.2)


def test_a_picture_lies_in_itself(plush_excerpt_cameras):
    camera = plush_excerpt_cameras[0]
    place = place_in(camera, camera)
    assert (place.left, place.top, place.right, place.bottom) == (0, 0, camera.width, camera.height)
    assert place.box == pytest.approx((0, 0, camera.width, camera.height))


def test_pictures_without_a_common_pixel(plush_excerpt_cameras):
    camera = plush_excerpt_cameras[0]
    assert place_in(off_centre(camera, -1e6, 0), camera) is None


def test_quaternions_of_any_length():
    assert rotation_of(np.array([3.0, 0, 0, 0])) == pytest.approx(np.eye(3))
    quarter = rotation_of(np.array([math.sqrt(0.5), 0, 0, math.sqrt(0.5)]))
    assert quarter @ [1, 0, 0] == pytest.approx([0, 1, 0])


def test_near_is_what_float32_loses():
    gaze = Gaze(np.array([1.0, 2.0, 3.0]), np.eye(3), 1.0)
    rounded = Gaze(gaze.position.astype(np.float32).astype(float), np.eye(3), float(np.float32(1.0)))
    assert gaze.is_near(rounded)
    assert not gaze.is_near(Gaze(gaze.position + 0.01, np.eye(3), 1.0))
    assert not gaze.is_near(Gaze(gaze.position, np.eye(3), 1.01))
