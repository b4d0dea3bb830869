"""Views between the training views: where they lie, and where none is added."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.given_views import GivenViews
from potr_cl.model.views_between import is_between, views_between
from tests.cases.surfaces import flat_splats, sphere
from tests.reference.surfaces import together

BALL = sphere(4000, 1.0, 0.03)


def looking(centre: np.ndarray, at: np.ndarray, number: int = 0) -> Camera:
    """A camera of 96 x 64 pixels at a place, looking at a point."""
    forward = (at - centre) / np.linalg.norm(at - centre)
    right = np.cross(forward, [0.0, 0.1, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(f"view{number}", 96, 64, 80, 80, 48, 32, rotation, -rotation @ centre)


def orbit(count: int, distance: float = 4.0) -> list[Camera]:
    """Cameras on a circle around the origin, 0.5 above it."""
    turns = 2 * np.pi * np.arange(count) / count
    places = np.stack([np.cos(turns), np.sin(turns), np.full(count, 0.5)], axis=1) * distance
    return [looking(place, np.zeros(3), number) for number, place in enumerate(places)]


ORBIT = orbit(12)


def test_an_orbit_is_kept():
    radius = np.linalg.norm(ORBIT[0].centre)
    added = views_between(BALL, ORBIT, 3, 0.3)
    assert len(added) > 30
    distance = np.linalg.norm(camera_centres(added), axis=1)
    # The chord between two neighbours comes 3 % nearer, and deviates of 0.3 of the way would reach 10 % off.
    assert np.allclose(distance, radius, rtol=0.005)
    towards = np.array([-camera.centre / np.linalg.norm(camera.centre) for camera in added])
    off = np.degrees(np.arccos(np.sum(towards * [camera.rotation[2] for camera in added], axis=1)))
    assert np.median(off) < 12
    # They are between the given ones, and not upon them.
    nearest = np.linalg.norm(camera_centres(added)[:, None] - camera_centres(ORBIT), axis=2).min(axis=1)
    spacing = np.linalg.norm(ORBIT[0].centre - ORBIT[1].centre)
    assert np.median(nearest) > 0.15 * spacing
    assert nearest.max() < 1.5 * spacing


def test_a_path_is_kept():
    wall = flat_splats(
        np.stack(np.meshgrid(np.linspace(-8, 8, 80), [4.0], np.linspace(-2, 2, 20)), axis=-1).reshape(-1, 3),
        np.tile([0.0, -1, 0], (1600, 1)),
        0.1,
    )
    path = [looking(np.array([x, 0.0, 0]), np.array([x, 4.0, 0]), i) for i, x in enumerate(np.linspace(-4, 4, 9))]
    centres = camera_centres(views_between(wall, path, 2, 0.0))
    assert len(centres) > 10
    assert np.allclose(centres[:, 1:], 0, atol=1e-9)
    assert np.abs(centres[:, 0]).max() <= 4


def test_they_have_the_intrinsics_of_the_given_ones_and_no_photograph(tmp_path):
    given = [dataclasses.replace(camera, image_path=tmp_path / "a.png", cx=40 + i) for i, camera in enumerate(ORBIT)]
    added = views_between(BALL, given, 1)
    assert {camera.cx for camera in added} <= {camera.cx for camera in given}
    assert all(camera.image_path is None and camera.split == "train" and is_between(camera) for camera in added)
    assert not any(is_between(camera) for camera in given)
    assert len({camera.name for camera in added}) == len(added)


def test_further_rounds_add_to_earlier_ones():
    two = views_between(BALL, ORBIT, 2)
    one, second = views_between(BALL, ORBIT, 1), views_between(BALL, ORBIT, 1, first=1)
    assert [camera.name for camera in one + second] == [camera.name for camera in two]
    assert np.array_equal(camera_centres(one + second), camera_centres(two))


def test_none_stands_in_matter():
    turns = 2 * np.pi * (np.arange(12) + 0.5) / 12
    posts = np.stack([np.cos(turns), np.sin(turns), np.full(12, 0.5)], axis=1) * 4.0
    random = np.random.default_rng(1)
    points = np.repeat(posts, 150, axis=0) + random.normal(0, 0.12, (1800, 3))
    clutter = flat_splats(points, np.tile([0.0, 0, 1], (1800, 1)), 0.1)
    scene = together(BALL, clutter)
    free, guarded = (camera_centres(views_between(each, ORBIT, 12, 0.05)) for each in (BALL, scene))

    def inside(centres):
        return int((np.linalg.norm(centres[:, None] - posts, axis=2).min(axis=1) < 0.15).sum())

    assert inside(free) > 2
    assert inside(guarded) == 0


def test_none_is_added_where_it_would_show_what_no_view_shows():
    # Two cameras back to back: whoever stands between them and turns sees the sides, which neither of them saw.
    room = sphere(4000, 5.0, 0.1)
    pair = [looking(np.array([0.1, 0, 0]), np.array([5.0, 0, 0.1])), looking(np.array([-0.1, 0, 0]), [-5.0, 0.1, 0])]
    assert len(views_between(room, pair, 8)) <= 4


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_nothing_lies_between_fewer_than_two_and_cameras_at_one_place_do_no_harm(count):
    with np.errstate(all="raise", under="ignore"):
        added = views_between(BALL, [ORBIT[0]] * count, 2)
    assert count > 1 or added == []
    assert all(np.isfinite(camera.translation).all() for camera in added)


@pytest.mark.parametrize(("each", "spread"), [(-1, 0.3), (1, -0.1), (1, float("nan")), (1, 11)])
def test_wrong_numbers(each, spread):
    with pytest.raises(UsageError, match="views between"):
        views_between(BALL, ORBIT, each, spread)


def test_half_of_the_given_views_get_one():
    whole, half, more = ([camera.name for camera in views_between(BALL, ORBIT, each)] for each in (1, 0.5, 1.5))
    assert half == whole[1::2]
    assert more[:12] == whole
    assert (len(half), len(more)) == (6, 18)


def test_parts_of_a_scene_are_shown_by_the_views_that_face_them():
    once, twice = (GivenViews(BALL, orbit(count)).views_of_parts() for count in (12, 24))
    # From four radii away, somewhat less than half of the ball is seen.
    assert once.min() > 0
    assert 3 < once.mean() < 6
    assert 1.8 < twice.mean() / once.mean() < 2.2
    # Cameras in one place all show the same half.
    here = [dataclasses.replace(ORBIT[0], name=f"{number}") for number in range(5)]
    assert set(GivenViews(BALL, here).views_of_parts()) == {5}


def test_what_is_allowed():
    """Most that lie between; none within the ball, that looks away, or whose place is no number."""
    known = GivenViews(BALL, ORBIT)
    inside = looking(np.array([0.0, 0, 0.97]), np.zeros(3))
    away = dataclasses.replace(ORBIT[0], rotation=np.diag([1.0, -1, -1]) @ ORBIT[0].rotation)
    nowhere = dataclasses.replace(ORBIT[0])
    object.__setattr__(nowhere, "translation", np.array([0, np.nan, 0]))
    assert not any(known.allows(view, 0) for view in (inside, away, nowhere))
    assert all(known.allows(view, number) for number, view in enumerate(ORBIT))
    views = views_between(BALL, ORBIT, 3, 0.3)
    assert all(known.allows(view, int(view.name[-4:])) for view in views)
    assert len(views) > 30


def test_threads_find_the_same_views():
    with thread_pool(3) as pool:
        pair = views_between(BALL, ORBIT, 4, 0.3, run=pool.map), views_between(BALL, ORBIT, 4, 0.3)
    for one, other in zip(*pair, strict=True):
        assert one.name == other.name
        assert np.array_equal(one.rotation, other.rotation)
        assert np.array_equal(one.translation, other.translation)


@pytest.mark.parametrize("far", [1e30, 1e300])
def test_cameras_beyond_all_bounds_do_no_harm(far):
    """On all axes, so that their directions have no largest one in single precision."""
    out = [
        dataclasses.replace(view, name=f"{number}", translation=np.full(3, far)) for number, view in enumerate(ORBIT)
    ]
    known = GivenViews(BALL, [*ORBIT, *out])
    assert not any(known.allows(view, 0) for view in out)
    assert len(known.views_of_parts())
