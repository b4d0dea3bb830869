"""What is in the way: the grid of a scene, and rays through it, against a walk in small steps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potr_cl.model.camera import Camera
from potr_cl.model.spherical_harmonics import energy, unit_coefficients
from potr_cl.opencl.device import Device
from potr_cl.placement.candidates import ViewMemory
from potr_cl.placement.rays import resolved_by, shown_from
from potr_cl.placement.space import Space, _distances
from tests.cases.surfaces import box, flat_splats, sphere
from tests.devices import KERNELS, open_device
from tests.reference.captures import looking
from tests.reference.scenes import random_scene
from tests.reference.surfaces import together

ROOM = together(box(9000, (3, 4, 1.5), 0.08), sphere(2000, 0.5, 0.04))


@pytest.fixture(scope="module")
def space():
    return Space.of(ROOM)


@pytest.fixture(params=KERNELS, scope="module")
def device(request):
    return open_device(request.param)


def walked(space: Space, start: np.ndarray, direction: np.ndarray, length: float) -> float:
    """The way until the first cell with matter, in steps of a fiftieth of a cell."""
    ways = np.arange(0, length, space.cell / 50)
    cells = space.cell_of(start + ways[:, None] * direction)
    met = np.flatnonzero((cells >= 0) & (space.distance[cells] == 0))
    return float(ways[met[0]]) if len(met) else length


def inside_the_room() -> np.ndarray:
    """Places where nothing is."""
    inside = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * (2.5, 3.5, 1.0)
    return inside[np.linalg.norm(inside, axis=1) > 1]


def test_walls_are_matter_and_rooms_are_free(space):
    rng = np.random.default_rng(0)
    walls = ROOM.means[rng.integers(0, 9000, 2000)]
    assert np.mean(space.free(walls) == 0) > 0.95
    assert (space.free(inside_the_room()) > 0).all()
    assert (space.free(np.array([[100.0, 0, 0], [0, 0, -50]])) > 4).all()


def test_rays_run_as_far_as_a_walk_in_small_steps(space):
    rng = np.random.default_rng(1)
    starts = rng.uniform(-1, 1, (300, 3)) * (6, 8, 4)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = space.reach(starts, directions, np.full(300, 12.0))
    wanted = [walked(space, *ray, 12.0) for ray in zip(starts, directions, strict=True)]
    # A ray that grazes a corner may miss it.
    assert np.mean(np.abs(found - wanted) < 1.1 * space.cell) > 0.95
    assert (found >= np.array(wanted) - 0.05 * space.cell).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9))
def test_distances_are_those_of_a_chessboard(seed, most):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 8, 3))
    occupied = rng.random(shape) < 0.1
    places, own = np.argwhere(occupied), np.indices(shape).reshape(3, -1).T
    wanted = np.full(len(own), most)
    if len(places):
        wanted = np.minimum(np.abs(own[:, None] - places).max(axis=2).min(axis=1), most)
    assert np.array_equal(_distances(occupied, most).reshape(-1), wanted)


def test_sizes_are_those_of_splats_nearby(space):
    near = space.sizes_near(np.array([[3.0, 0, 0], [0, 0, 0.5]]))
    assert near == pytest.approx([0.08, 0.04], rel=0.05)


def test_haze_and_backdrops_are_no_matter():
    haze = dataclasses.replace(sphere(3000, 2.5, 0.05, 3), opacity_logits=np.full(3000, -2.0, np.float32))
    backdrop = flat_splats([[0, 0, 0.9]], [[0.0, 0, 1]], 40, -1.0)
    assert np.mean(Space.of(together(ROOM, haze, backdrop)).free(inside_the_room()) > 0) > 0.97


def terrain(splats: int, height: float, overlap: float):
    """100 x 100 of hills, so often covered."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-50, 50, (splats, 2))
    points = np.column_stack([place, height * np.sin(place[:, 0] / 9) * np.cos(place[:, 1] / 7)])
    size = np.sqrt(overlap * 1e4 / (2 * np.pi * splats))
    return flat_splats(points, np.tile([0.0, 0, 1], (splats, 1)), size)


@pytest.mark.parametrize(("splats", "height", "overlap"), [(50_000, 5, 8), (20_000, 1, 5)])
def test_wide_ground_is_matter(splats, height, overlap):
    ground = terrain(splats, height, overlap)
    space = Space.of(ground)
    rng = np.random.default_rng(1)
    above = np.column_stack([rng.uniform(-45, 45, (1000, 2)), np.full(1000, 20.0)])
    way = space.reach(above, np.tile([0.0, 0, -1], (1000, 1)), np.full(1000, 40.0))
    assert np.mean(way < 40) > 0.97, "rays from above meet it"


def far_sky(count: int, radius: float):
    normals = np.random.default_rng(7).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return flat_splats(radius * normals, normals, radius / 10)


@pytest.mark.parametrize("radius", [100, 1000])
def test_a_few_splats_of_sky_do_not_coarsen_the_grid(radius):
    ball = sphere(20_000, 2.0, 0.05)
    alone, under = Space.of(ball), Space.of(together(ball, far_sky(100, radius)))
    assert under.cell < 2 * alone.cell
    assert np.mean(under.free(ball.means.astype(np.float64)) == 0) > 0.9


@pytest.mark.parametrize(("count", "at", "log_scale"), [(1, 1e3, -40), (5, 1e3, -35), (1, 1e6, -25), (4, 1e20, -3)])
def test_splats_that_coincide_far_from_the_origin(count, at, log_scale):
    scene = flat_splats(np.full((count, 3), at), np.tile([0.0, 0, 1], (count, 1)), 1.0)
    scene = dataclasses.replace(scene, log_scales=np.full((count, 3), log_scale, np.float32))
    space = Space.of(scene)
    assert space.cell > 0
    assert np.isfinite(space.reach(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([5.0]))).all()


def test_a_ray_from_far_away_ends(space):
    start, ahead = np.array([[2e7, 0, 0.3]]), np.array([[-1.0, 0, 0]])
    way = space.reach(start, ahead, np.array([1e9]))
    assert way == pytest.approx(2e7 - 3, abs=0.5)


def test_what_is_seen_from_where_is_what_rays_reach(space, device):
    rng = np.random.default_rng(2)
    places = rng.uniform(-1, 1, (20, 3)) * (6, 8, 4)
    chosen = rng.integers(0, len(space.points), 400)
    targets, sizes = space.points[chosen], np.full(400, 0.08)
    place, target, well = shown_from(device, space, places, np.full(20, 40.0), targets, sizes, 0.25, 4.0)
    rays = targets[None] - places[:, None]
    length = np.linalg.norm(rays, axis=2)
    ends = np.maximum(length - 1.75 * space.cell, 0)
    wanted = np.zeros((20, 400))
    for number in range(20):
        way = space.reach(np.tile(places[number], (400, 1)), rays[number] / length[number, :, None], ends[number])
        clear = way >= ends[number] * (1 - 1e-6)
        wanted[number] = clear * (length[number] > 0.25) * (length[number] < 4 * 3.2)
        wanted[number] *= np.minimum(1, 3.2 / length[number]) ** 2
    found = np.zeros((20, 400))
    found[place, target] = well
    # Rounding may turn a ray that grazes a cell.
    assert np.mean(np.abs(found - wanted) < 0.01) > 0.99
    assert 0.02 < np.mean(wanted > 0) < 0.9


def test_points_are_resolved_by_who_stands_near_and_looks(space, device):
    inside = [looking(np.array([x, 0.0, 1.0]), np.array([x, 4.0, 0.0]), name=str(x)) for x in (-1, 1)]
    outside = [looking(np.array([0.0, 30.0, 0.0]), np.array([0.0, 0, 0]), name="out")]
    points = np.array([[0.0, 4, 0], [0.0, -4, 0], [0.0, 4, 0.2]])
    sizes = np.full(3, 0.08)

    def found(cameras: list[Camera], pixels: float) -> list[int]:
        return resolved_by(device, space, cameras, points, sizes, pixels, 0.25, 2).tolist()

    assert found(inside, 1.0) == [2, 0, 2], "the wall in front, not the one behind"
    assert found(inside, 1e3) == [0, 0, 0], "not large enough"
    assert found(outside, 0.1) == [1, 0, 1], "from outside, but not through the wall"
    assert found([*inside, *outside], 0.1) == [2, 0, 2], "no more than are asked for"


@pytest.mark.parametrize("degree", [2, 3])
def test_energies_are_those_of_numpy(device, degree):
    scene = random_scene(150, degree)
    space = Space.of(scene)
    places = np.random.default_rng(0).normal(size=(9, 3)) * 5
    memory = ViewMemory.of(device, space, scene.means.astype(np.float64), scene.sh, places)
    assert memory is not None
    colours = unit_coefficients(scene.sh[:, 1:])
    wanted = [energy(scene.means.astype(np.float64) - place, colours) for place in places]
    assert np.allclose(memory.best, wanted, rtol=2e-3, atol=1e-5)
    shown = np.ones((9, 150), np.float32)
    means = np.array(wanted).mean(axis=1)
    assert np.allclose(memory.of_places(places, shown), means / np.quantile(means, 0.95), rtol=2e-3)


def test_smooth_colours_remember_nothing(space):
    for degree in (0, 1):
        scene, places = random_scene(150, degree), np.ones((3, 3))
        assert ViewMemory.of(Device(), space, scene.means.astype(np.float64), scene.sh, places) is None
