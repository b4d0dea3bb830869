"""Virtual cameras: they see what matters, from where it was made to be seen, and nothing upsets them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import camera_centres, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.spherical_harmonics import ac_basis
from potr_cl.model.virtual_cameras import MOST, Plan, describe, is_virtual, plan, standpoints
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.placement.upright import guess_up
from potr_cl.placement.virtual import judging_views, place_cameras
from potr_cl.raster.rules import INRIA
from tests.cases.surfaces import box, flat_splats, sphere
from tests.reference.raster import sh_basis
from tests.reference.scenes import random_scene
from tests.reference.surfaces import together

BALL = sphere(8000, 1.0, 0.03)
ROOM = box(8000, (3, 4, 1.5), 0.1)
INSIDE_ROOM = np.array([3, 4, 1.5])
#: Outward normals of the room's splats.
WALLS = np.sign(ROOM.means) * (np.abs(ROOM.means) > INSIDE_ROOM - 1e-3)


def in_view(scene: Scene, camera) -> np.ndarray:
    """(N,) whether each centre is in the picture and beyond the near plane."""
    t = scene.means.astype(np.float64) @ camera.rotation.T + camera.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * t[:, 0] / t[:, 2] + camera.cx, camera.fy * t[:, 1] / t[:, 2] + camera.cy
    return (t[:, 2] > INRIA.near) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)


def times_seen(scene: Scene, normals: np.ndarray, cameras) -> np.ndarray:
    """(N,) how many cameras see the side of each splat to which its normal points, of a surface that hides nothing."""
    count = np.zeros(len(scene), int)
    for camera in cameras:
        facing = np.einsum("ij,ij->i", camera.centre - scene.means, normals) > 0
        count += facing & in_view(scene, camera)
    return count


def outside_ball(cameras):
    return [c for c in cameras if np.linalg.norm(c.centre) > 1]


def inside_room(cameras):
    return [c for c in cameras if (np.abs(c.centre) < INSIDE_ROOM).all()]


def trained(scene: Scene, normals: np.ndarray, centres: np.ndarray, degree: int = 3) -> Scene:
    """The scene with coefficients that training from these camera centres could give.

    They are random sums of the basis functions in the directions of the camera centres in front of a splat.
    """
    rng = np.random.default_rng(0)
    sh = np.zeros((len(scene), (degree + 1) ** 2, 3))
    for camera_centre in centres:
        towards = scene.means - camera_centre
        facing = np.einsum("ij,ij->i", towards, normals) < 0
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        steps = facing[:, None, None] * rng.normal(0, 0.02, (len(scene), 1, 3))
        sh += sh_basis(towards, degree)[:, :, None] * steps
    return dataclasses.replace(scene, sh=sh.astype(np.float32))


def placed(scene: Scene, count: int = 128, size: int | None = None):
    return place_cameras(scene, count, size)


@pytest.fixture(scope="module")
def around_ball():
    return placed(BALL)


def test_an_object_is_seen_from_all_sides(around_ball):
    outside = outside_ball(train_views(around_ball))
    assert len(outside) >= len(train_views(around_ball)) // 3, "it is hollow: the others are inside"
    assert times_seen(BALL, BALL.means, outside).min() >= 4
    # It fills a good part of the picture.
    assert np.median([np.mean(in_view(BALL, c)) for c in outside]) > 0.4
    assert np.quantile([np.linalg.norm(c.centre) for c in outside], 0.9) < 8


def test_names_and_splits(around_ball):
    assert (len(train_views(around_ball)), len(test_views(around_ball))) == (128, 16)
    assert len({c.name for c in around_ball}) == 144
    assert {(c.width, c.height) for c in around_ball} == {(480, 480)}, "on a CPU"
    assert is_virtual(around_ball)
    assert not is_virtual([])
    assert not is_virtual([dataclasses.replace(around_ball[0], name="photo")])
    assert describe(around_ball).startswith("128 virtual views and 16 to judge by, ")
    few = place_cameras(FEW, 5, 64)
    assert [c.split for c in few] == ["train"] * 5
    assert few[0].width == 64
    assert "judge" not in describe(few)


def test_the_median_splat_is_resolved(around_ball):
    """In the views that are placed for a scene whose colours tell nothing it has about 3 pixels."""
    sizes = []
    for camera in train_views(around_ball):
        t = BALL.means.astype(np.float64) @ camera.rotation.T + camera.translation
        facing = np.einsum("ij,ij->i", camera.centre - BALL.means, BALL.means) > 0
        shown = facing & in_view(BALL, camera)
        if shown.any():
            sizes.append(np.median(camera.fx * 0.03 / t[shown, 2]))
    assert 1.5 < np.median(sizes) < 5


def test_a_plan_says_beforehand_what_is_placed_where_colours_tell_nothing(around_ball):
    planned = plan(len(BALL), 128, slow=True)
    assert (planned.training, planned.test) == (len(train_views(around_ball)), len(test_views(around_ball)))
    assert {planned.size} == {c.width for c in around_ball}
    assert plan(len(BALL), slow=True).sharper(1.1) == Plan(136, 182, 25, 528), "their number times their width stays"
    assert plan(len(BALL), slow=True).sharper(3.0).size == plan(len(BALL)).size
    assert plan(len(BALL)).sharper(3.0) == plan(len(BALL))


def test_large_scenes_get_more_views_and_cpus_fewer_and_smaller_ones():
    plans = [plan(splats) for splats in (1, 10_000, 1_000_000, 10_000_000, 1_000_000_000)]
    counts, sizes = [p.training for p in plans], [p.size for p in plans]
    assert counts == sorted(counts)
    assert len(set(sizes)) == 1
    assert counts[0] == counts[1] < counts[2] < counts[3] <= counts[4] == MOST
    for splats in (1, 1_000_000):
        slow, fast = plan(splats, slow=True), plan(splats)
        assert slow.training < slow.in_rooms < fast.training == fast.in_rooms
        assert slow.size < fast.size


@pytest.mark.slow
def test_judges_stand_elsewhere_and_fewer_are_the_first_of_more(around_ball):
    tests = test_views(around_ball)
    apart = np.linalg.norm(camera_centres(tests)[:, None] - camera_centres(train_views(around_ball)), axis=2)
    assert apart.min() > 0
    alone = judging_views(BALL, 16)
    assert np.array_equal(camera_centres(alone), camera_centres(tests))
    assert np.array_equal(camera_centres(judging_views(BALL, 5, 64)), camera_centres(tests)[:5]), "whatever their size"
    # Near and far.
    distance = np.linalg.norm(camera_centres(judging_views(BALL, 40, 600)), axis=1)
    assert distance.min() < 0.6 * distance.max()


def test_standpoints(around_ball):
    given = [dataclasses.replace(c, name="photo") for c in around_ball]
    assert np.array_equal(standpoints(given, BALL.means), camera_centres(given))
    places = standpoints(around_ball, BALL.means)
    assert places.shape == (144, 4, 3)
    assert np.allclose(places.mean(axis=1), camera_centres(around_ball))
    away = np.linalg.norm(places - camera_centres(around_ball)[:, None], axis=2)
    assert np.allclose(away, away[:, :1])
    # In proportion to the distance of what is looked at, and well short of it.
    distance = np.linalg.norm(camera_centres(around_ball), axis=1)
    ratio = (away[:, 0] / distance)[distance > 2]
    assert np.allclose(ratio, np.median(ratio), rtol=0.15)
    assert 0.1 < np.median(ratio) < 0.5


def floaters(count: int, spread: float) -> Scene:
    rng = np.random.default_rng(5)
    return flat_splats(spread * rng.normal(size=(count, 3)), np.tile([0.0, 0, 1], (count, 1)), 0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "clutter",
    [floaters(400, 10), sphere(1500, 60, 4, seed=1), flat_splats([[1e4, 0, 0]] * 80, [[0.0, 0, 1]] * 80, 1)],
    ids=["floaters", "background shell", "far away clump"],
)
def test_clutter_does_not_draw_the_views_away(clutter):
    outside = outside_ball(train_views(placed(together(BALL, clutter))))
    assert times_seen(BALL, BALL.means, outside).min() >= 4
    assert np.mean(np.linalg.norm(camera_centres(outside), axis=1) < 12) > 0.4


@pytest.mark.slow
def test_no_camera_stands_in_matter():
    scene = together(BALL, floaters(4000, 2))
    centres = camera_centres(placed(scene))
    assert not any((np.linalg.norm(scene.means - centre, axis=1) < 0.05).any() for centre in centres)


@pytest.mark.slow
def test_a_room_and_an_object_in_it_are_seen_from_inside():
    thing = sphere(6000, 0.5, 0.02)
    inside = inside_room(train_views(placed(together(ROOM, thing))))
    assert len(inside) >= 30
    # Corners are the hardest.
    for scene, normals, times in ((ROOM, -WALLS, 2), (thing, thing.means, 4)):
        seen = times_seen(scene, normals, outside_ball(inside) if scene is thing else inside)
        assert np.quantile(seen, 0.01) >= times
        assert seen.min() >= 1


def upper_centres(count: int, distance: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    centres = rng.normal(size=(count, 3))
    centres[:, 2] = np.abs(centres[:, 2]) + 0.1
    return distance * centres / np.linalg.norm(centres, axis=1, keepdims=True)


@pytest.mark.slow
def test_colours_tell_the_side_that_was_photographed(around_ball):
    centres = camera_centres(placed(trained(BALL, BALL.means, upper_centres(60, 3), 2)))
    elevation = np.degrees(np.arcsin(centres[:, 2] / np.linalg.norm(centres, axis=1)))
    assert np.mean(elevation > -20) > 0.95
    # Without that knowledge they are all around.
    blind = camera_centres(around_ball)
    assert np.mean(blind[:, 2] < 0) > 0.3


@pytest.mark.slow
def test_colours_tell_a_room_from_an_object():
    rng = np.random.default_rng(4)
    from_inside = trained(ROOM, -WALLS, rng.uniform(-0.6, 0.6, (60, 3)) * INSIDE_ROOM)
    views = placed(from_inside)
    assert len(inside_room(views)) > 0.94 * len(views)
    assert len(judging_views(from_inside, 12, 200)) == 12
    from_outside = trained(ROOM, WALLS, upper_centres(60, 12))
    views = placed(from_outside)
    assert len(inside_room(views)) < 0.0625 * len(views)


@pytest.mark.slow
def test_pictures_are_larger_where_splats_are_small_from_where_photographs_were_taken():
    rng = np.random.default_rng(4)
    fine = dataclasses.replace(ROOM, log_scales=ROOM.log_scales + np.float32(np.log(0.1)))
    from_inside = trained(fine, -WALLS, rng.uniform(-0.6, 0.6, (60, 3)) * INSIDE_ROOM)
    usual, views = plan(len(fine), slow=True), place_cameras(from_inside)
    (size,) = {camera.width for camera in views}
    assert usual.size < size <= plan(len(fine)).size
    assert len(train_views(views)) == round(usual.training * usual.size / size)
    assert len(test_views(views)) == usual.test
    # Who asks for a number of views gets it, and is judged from the same places. Who asks for a size gets that.
    few = place_cameras(from_inside, 20)
    assert len(train_views(few)) == 20
    assert np.array_equal(camera_centres(test_views(few)), camera_centres(test_views(views))[: len(test_views(few))])
    assert {camera.width for camera in place_cameras(from_inside, size=100)} == {100}
    # Where colours tell nothing, pictures are the usual ones; where there are walls that hide, more of them.
    for scene, count in ((fine, usual.training), (ROOM, usual.in_rooms)):
        cameras = train_views(place_cameras(scene))
        assert (len(cameras), cameras[0].width) == (count, usual.size)


def scaled(scene: Scene, factor: float) -> Scene:
    return dataclasses.replace(
        scene, means=(scene.means * np.float32(factor)), log_scales=scene.log_scales + np.float32(np.log(factor))
    )


LINE = np.linspace(-1, 1, 300)[:, None] * [[1.0, 2, 3]]
UP = np.tile([0.0, 0, 1], (300, 1))
PLANE = np.random.default_rng(6).uniform(-1, 1, (300, 3)) * [1, 1, 0]
FEW = sphere(400, 1.0, 0.12)
DEGENERATE = {
    "one splat": BALL.subset(np.arange(1)),
    "all coincident": BALL.subset(np.zeros(50, int)),
    "coincident points": flat_splats(np.zeros((300, 3)), UP, 1e-30),
    "line": flat_splats(LINE, UP, 0.01),
    "plane": flat_splats(PLANE, UP, 0.05),
    "tiny units": scaled(FEW, 1e-6),
    "huge units": scaled(FEW, 1e9),
    "far from the origin": dataclasses.replace(FEW, means=FEW.means + np.float32(1e5)),
    "transparent": dataclasses.replace(FEW, opacity_logits=FEW.opacity_logits - 60),
    "extreme values": dataclasses.replace(
        random_scene(200, 3), means=random_scene(200, 3).means * np.float32([1e30, 1e-30, 1])
    ),
    "needles": dataclasses.replace(FEW, log_scales=FEW.log_scales * np.float32([30, 1, 1])),
    "noise": random_scene(400, 3, extent=3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_scenes(name):
    scene = DEGENERATE[name]
    with np.errstate(all="raise", under="ignore"):
        cameras = place_cameras(scene, 16, 100)
    assert len(cameras) == 18
    assert np.isfinite(camera_centres(cameras)).all()
    if name != "extreme values":  # nothing but a few of its splats is anywhere near any of the others
        assert all(in_view(scene, c).any() for c in cameras)


@pytest.mark.parametrize(("count", "size"), [(0, 800), (10, 0), (-1, 800)])
def test_wrong_numbers(count, size):
    with pytest.raises(UsageError, match="at least 1"):
        place_cameras(BALL, count, size)


def test_the_basis_is_that_of_the_rasterizer():
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.allclose(ac_basis(directions), sh_basis(directions, 3)[:, 1:], atol=1e-12)


@pytest.mark.slow
def test_encode_places_them_itself(monkeypatch):
    """The same ones every time."""
    monkeypatch.setattr(
        "potr_cl.pipeline.encode.place_cameras", lambda scene, count, device: place_cameras(scene, 6, 64)
    )
    scene, options = random_scene(150, 2), EncodeOptions.for_preset("paper", prune={"iterations": 2})
    given = encode(scene, place_cameras(scene, 6, 64), options)
    assert encode(scene, None, options).data == given.data
    assert given.pruned is not None


@pytest.mark.slow
def test_colours_are_held_more_where_cameras_were_placed():
    scene = random_scene(150, 2)
    own = place_cameras(scene, 6, 64)
    photographs = [dataclasses.replace(camera, name=f"photo_{number}") for number, camera in enumerate(own)]

    def encoded(cameras, **refit):
        return encode(scene, cameras, EncodeOptions.for_preset("best", prune={"iterations": 2}, refit=refit)).data

    assert encoded(own) == encoded(own, prior=0.3) != encoded(own, prior=0.1)
    assert encoded(photographs) == encoded(photographs, prior=0.1)


def assert_up(scene: Scene, cameras, up) -> None:
    """Against what the scene's own cameras say: the direction across which all pictures' horizontals lie."""
    assert np.dot(guess_up(scene, cameras), up) > np.cos(np.radians(12))


@pytest.mark.slow
def test_lego_is_looked_at_from_above(lego):
    scene = load_scene(lego / "point_cloud.ply")
    cameras = placed(scene)
    assert_up(scene, cameras, (0, 0, 1))
    centres = camera_centres(cameras)
    distance = np.linalg.norm(centres, axis=1)
    assert np.mean(np.degrees(np.arcsin(centres[:, 2] / distance)) > -20) > 0.97  # the photographs: all above 0
    assert 1.3 < np.median(distance) < 5


@pytest.mark.slow
def test_plush_is_looked_at_from_where_it_was_photographed(plush):
    scene, cameras = load_scene(plush / "point_cloud.ply"), load_cameras(plush / "cameras.json")
    own = placed(scene)
    assert_up(scene, own, (-0.0497, -0.8993, -0.4344))
    centres, true = camera_centres(own), camera_centres(cameras)
    nearest = np.linalg.norm(centres[:, None] - true, axis=2).min(axis=1)
    # The photographs were taken from 2.6 to 7.3 units away from the toy, on a shell of about that radius.
    assert np.median(nearest) < 1.8
    assert np.quantile(nearest, 0.9) < 4
