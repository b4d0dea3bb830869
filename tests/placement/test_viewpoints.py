"""Views for scenes without cameras: which way is up, what they show, that they are level and evenly spaced."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.model.camera import camera_centres, focus, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.placement.upright import AXES, guess_up
from potr_cl.placement.viewpoints import look_around, turntable
from potr_cl.placement.virtual import judging_views, place_cameras
from tests.cases.surfaces import flat_splats
from tests.reference.scenes import random_scene
from tests.reference.surfaces import together


def rotated(scene: Scene, rotation: np.ndarray) -> Scene:
    """The scene turned about the origin; its colours stay as they are, which a scene of SH degree 0 does not mind."""
    w = math.sqrt(max(1 + np.trace(rotation), 1e-12)) / 2
    x, y, z = ((rotation[i, j] - rotation[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    a, (b, c, d) = scene.quaternions[:, 0], scene.quaternions[:, 1:].T
    turned = [
        w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a,
    ]  # fmt: skip
    return dataclasses.replace(
        scene,
        means=(scene.means @ rotation.T).astype(np.float32),
        quaternions=np.stack(turned, axis=1).astype(np.float32),
    )


def house() -> Scene:
    """A floor in the plane z = 0 and a small cube on it; of SH degree 0."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3, 3, (4000, 2)), np.zeros(4000)])
    ground = flat_splats(floor, np.tile([0.0, 0.0, 1.0], (4000, 1)), 0.05)
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            points = rng.uniform(-0.5, 0.5, (150, 3))
            points[:, axis] = 0.5 * sign
            normal = np.zeros(3)
            normal[axis] = sign
            sides.append(flat_splats(points + np.array([0, 0, 0.5]), np.tile(normal, (150, 1)), 0.05))
    return together(ground, *sides)


HOUSE = house()


def tilt(degrees: float) -> np.ndarray:
    turn = math.radians(degrees)
    return np.array([[1, 0, 0], [0, math.cos(turn), -math.sin(turn)], [0, math.sin(turn), math.cos(turn)]])


def angle(a, b) -> float:
    return math.degrees(math.acos(min(max(float(np.dot(a, b)), -1), 1)))


def test_ground_tells_which_way_is_up():
    assert np.array_equal(guess_up(HOUSE, place_cameras(HOUSE, 16)), (0, 0, 1))


@pytest.mark.slow
def test_a_scene_that_stands_askew_is_held_level():
    """As those of COLMAP do: no axis is up."""
    rotation = tilt(20)
    scene = rotated(HOUSE, rotation)
    up = guess_up(scene, place_cameras(scene, 16))
    assert angle(up, rotation @ (0, 0, 1)) < 3
    # The nearest axis would be wrong by the 20 degrees.
    assert angle(up, (0, 0, 1)) > 15


@pytest.mark.parametrize(("views", "up"), [(look_around, (1.0, 2.0, -0.5)), (turntable, AXES["-y"])])
def test_views_are_level(views, up):
    direction = np.array(up) / np.linalg.norm(up)
    for camera in views(HOUSE, 5, 64, up):
        assert abs(camera.rotation[0] @ direction) < 1e-9 or abs(camera.rotation[2] @ direction) > 0.999
        assert -camera.rotation[1] @ direction > 0, "upside down"
        assert np.allclose(camera.rotation @ camera.rotation.T, np.eye(3))
        assert np.linalg.det(camera.rotation) == pytest.approx(1)


@pytest.mark.slow
def test_a_view_has_one_name_and_one_way_up_whoever_places_it():
    scene = rotated(HOUSE, tilt(90))
    judging, placed = judging_views(scene), place_cameras(scene, 40)
    for cameras in (look_around(scene, 8, judging[0].width), judging, test_views(placed)):
        assert [c.name for c in cameras] == [f"virtual_test_{k:03d}" for k in range(len(cameras))]
        for camera, other in zip(cameras, judging, strict=False):
            assert np.array_equal(camera.rotation, other.rotation)
            assert np.array_equal(camera.translation, other.translation)
    assert [c.name for c in train_views(placed)] == [f"virtual_{k:03d}" for k in range(40)]
    assert {c.split for c in judging} == {"test"}
    for camera in placed:
        assert -camera.rotation[1] @ tilt(90) @ (0, 0, 1) > 0, "upside down"


@pytest.mark.slow
def test_another_way_up_moves_no_camera():
    level, askew = (look_around(HOUSE, 8, 64, up) for up in (None, (1, 0, 0)))
    assert np.allclose(camera_centres(level), camera_centres(askew))
    assert np.allclose([c.rotation[2] for c in level], [c.rotation[2] for c in askew])


def seen(scene: Scene, camera) -> float:
    """The part of the opaque splats that are in a picture."""
    view = scene.means[scene.opacities > 0.1] @ camera.rotation.T + camera.translation
    x, y = view[:, 0] / view[:, 2] * camera.fx + camera.cx, view[:, 1] / view[:, 2] * camera.fy + camera.cy
    return float(np.mean((view[:, 2] > 0.2) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)))


@pytest.mark.slow
def test_a_turntable_turns_evenly_around_the_scene():
    scene, scale = HOUSE, 1000.0
    larger = dataclasses.replace(
        scene,
        means=scene.means * np.float32(scale) + np.array([5, -7, 3], np.float32) * np.float32(scale),
        log_scales=scene.log_scales + np.float32(math.log(scale)),
    )
    views = turntable(larger, 12, 128, (0, 0, 1))
    centres, middle = camera_centres(views), focus(views)
    assert np.ptp(centres[:, 2]) < 1e-6 * scale, "one height"
    away = centres - middle
    assert np.allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]), rtol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(away[:, 1], away[:, 0])))
    assert np.allclose(np.abs(steps), 2 * math.pi / 12, atol=1e-6)
    assert np.allclose(np.sign(steps), np.sign(steps[0])), "always the same way round"
    assert (away[:, 2] > 0).all(), "from above"
    assert min(seen(larger, view) for view in views) > 0.5


def test_one_splat_can_be_looked_at():
    scene = random_scene(1, 0)
    assert len(look_around(scene, 3, 32)) == 3
    (view,) = turntable(scene, 1, 32)
    assert seen(dataclasses.replace(scene, opacity_logits=np.full(1, 5, np.float32)), view) == 1


@pytest.mark.parametrize("up", [(0, 0, 0), (1, 2), (np.nan, 0, 1), (np.inf, 0, 1)])
def test_what_is_no_direction(up):
    for make in (lambda s: look_around(s, 1, 32, up), lambda s: turntable(s, 1, 32, up)):
        with pytest.raises(UsageError, match="the direction that is up"):
            make(HOUSE)


@pytest.mark.parametrize(("count", "size"), [(0, 32), (10**6, 32), (1, 0), (1, 10**6)])
def test_how_many_and_how_large(count, size):
    for make in (look_around, turntable):
        with pytest.raises(UsageError, match="must lie between"):
            make(HOUSE, count, size)
