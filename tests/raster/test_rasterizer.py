"""The rasterizer against its float64 definition, against another renderer's pictures, and under stress."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from potr_cl.errors import DataError, DeviceError, UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer, render
from potr_cl.raster.rules import GSPLAT, INRIA, RasterRules
from potr_cl.raster.view_set import TILE, ViewSet
from tests.cases.once import once
from tests.reference import raster as reference
from tests.reference.scenes import plain_splats as splats
from tests.reference.scenes import random_splats, tilted_camera
from tests.reference.scenes import straight_camera as camera

#: The same for all families of kernels.
definition, projection = once(reference.render, 100), once(reference.project, 3)

#: A pixel whose every alpha and transmittance stays this far, relatively, from 1/255 and 1e-4 cannot flip.
CLEAR = 1e-4


def check(
    device: Device,
    scene: Scene,
    view: Camera,
    rules: RasterRules = INRIA,
    background: tuple[float, float, float] = (0, 0, 0),
    tolerance: float = 2e-5,
) -> reference.Composite:
    """Render and compare with the definition wherever no threshold is near; flips must be few and bounded."""
    image, transmittance = render(scene, view, device, rules, background)
    assert image.dtype == transmittance.dtype == np.float32
    wanted = definition(scene, view, rules, background)
    error = np.maximum(np.abs(image - wanted.image).max(axis=2), np.abs(transmittance - wanted.transmittance))
    clear = wanted.margin > CLEAR
    assert clear.mean() > 0.9
    assert error[clear].max() <= tolerance
    assert (error > tolerance).mean() < 0.005
    return wanted


def read_lists(device: Device, view: ViewSet) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    offsets = device.download(view.offsets, (view.tiles + 1,), np.uint32)
    return offsets, device.download(view.intersections, (view.capacity,), np.uint32)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_against_definition(device: Device, degree: int) -> None:
    for rules in [INRIA, GSPLAT]:
        wanted = check(device, random_splats(400, degree, seed=degree), tilted_camera(degree, 83, 61), rules)
        assert wanted.pairs > 10_000
        assert wanted.transmittance.min() < 1e-3  # dense enough for pixels to end
        few = random_splats(3 + 9 * degree, seed=degree + 10)
        check(device, few, tilted_camera(degree, 37, 70), rules, background=(0.2, 0.9, 0.5))


def test_square_extent_cuts_whole_tiles(device: Device) -> None:
    """An opaque splat reaches 3.3 sigma; the original's square ends at 3 and takes the tiles that it touches."""
    view = camera(96, 96, focal=100.0, fy=100.0)
    scene = splats([[-0.24, 0.05, 1.0]], sigma=0.13, logit=9)
    inria, gsplat = check(device, scene, view, INRIA), check(device, scene, view, GSPLAT)
    changed = np.argwhere(inria.image[..., 0] != gsplat.image[..., 0])
    assert len(changed) > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene_name", "view_names"), [("lego", ("test_r_0", "test_r_66")), ("plush", ("20240212_004037",))]
)
def test_against_another_renderer(
    device: Device, request: pytest.FixtureRequest, scene_name: str, view_names: tuple[str, ...]
) -> None:
    folder: Path = request.getfixturevalue(scene_name)
    scene = load_scene(folder / "point_cloud.ply")
    cameras = {c.name: c for c in load_cameras(folder / "cameras.json")}
    for name in view_names:
        image, transmittance = render(scene, cameras[name], device, GSPLAT)
        with np.load(folder / "reference" / f"{name}.npz") as theirs:
            error = image - theirs["rgb"]
            assert -10 * np.log10(np.mean(np.square(error))) >= 70
            error_alpha = 1 - transmittance - theirs["alpha"]
        # The largest differences must all come from a threshold or a tie in depth that single precision can flip.
        projected = projection(scene, cameras[name], GSPLAT)
        worst = np.maximum(np.abs(error).max(axis=2), np.abs(error_alpha))
        assert (worst > 5e-4).mean() < 1e-3
        for pixel in np.argsort(worst, axis=None)[-8:]:
            row, column = divmod(int(pixel), worst.shape[1])
            traced = reference.composite_pixel(projected, column, row, GSPLAT)
            ours = np.append(image[row, column], transmittance[row, column])
            mistaken = np.abs(ours - np.append(traced.colour, traced.transmittance)).max() > 5e-5
            assert not mistaken or traced.margin < 1e-3 or traced.gap < 5e-7


def test_same_bytes_every_time(device: Device) -> None:
    scene, view = random_splats(3000, 1, seed=3), tilted_camera(3, 100, 90)
    pictures = []
    for _ in range(2):
        with Rasterizer(device, scene) as rasterizer:
            pictures += [rasterizer.render(view), rasterizer.render(view)]
    for image, transmittance in pictures[1:]:
        assert image.tobytes() == pictures[0][0].tobytes()
        assert transmittance.tobytes() == pictures[0][1].tobytes()


@pytest.mark.parametrize("rules", [INRIA, GSPLAT], ids=["inria", "gsplat"])
def test_tile_lists_are_tight_and_sorted(device: Device, rules: RasterRules) -> None:
    """Every splat that reaches alpha 1/255 in a tile's pixel is in its list, few others are, nearest first."""
    scene, view = random_splats(300, 0, seed=8), tilted_camera(8, 91, 77)
    with Rasterizer(device, scene, rules) as rasterizer, rasterizer.prepare_set([view]) as prepared:
        offsets, intersections = read_lists(device, prepared)
    projected = reference.project(scene, view, rules)
    rank = np.empty(len(scene), np.int64)
    rank[projected.index] = np.arange(len(projected.index))
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    touched: set[tuple[int, int]] = set()
    nearly: set[tuple[int, int]] = set()
    for k, splat in enumerate(projected.index):
        d = np.stack([x - projected.centre[k, 0], y - projected.centre[k, 1]], axis=-1)
        q = np.einsum("yxi,ij,yxj->yx", d, np.linalg.inv(projected.covariance[k]), d)
        inside = reference.footprint(projected.centre[k], projected.covariance[k], rules, x.shape)
        log_alpha = np.where(inside, np.log(projected.opacity[k]) - q / 2, -np.inf)
        for found, threshold in ((touched, 1e-5), (nearly, -0.1)):
            rows, columns = np.nonzero(log_alpha >= np.log(1 / 255) + threshold)
            found |= {(tile, int(splat)) for tile in set(rows // TILE * prepared.views[0].columns + columns // TILE)}
    listed = set()
    for tile in range(prepared.tiles):
        run = intersections[offsets[tile] : offsets[tile + 1]]
        assert (np.diff(rank[run]) > 0).all()
        listed |= {(tile, int(splat)) for splat in run}
    assert touched <= listed
    # The ellipse is tested, not the pixels in it: where it touches a tile between pixel centres it is listed too.
    assert len(listed - nearly) <= 0.02 * len(listed)
    assert offsets[0] == 0
    assert offsets[-1] == len(intersections) == prepared.capacity


def test_one_tile_of_any_length_is_sorted(device: Device) -> None:
    for n in [1, 2, 15, 16, 17, 255, 256, 257, 1000, 2047, 2048, 2049, 4096, 5001, 12345]:
        rng = np.random.default_rng(n)
        depth = rng.integers(1, max(n // 3, 2), size=n) / 8 + 1  # many ties
        scene = splats(np.stack([0 * depth, 0 * depth, depth], axis=1), sigma=1e-4, logit=0)
        with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set([camera(16, 16)]) as prepared:
            offsets, intersections = read_lists(device, prepared)
        assert offsets.tolist() == [0, n]
        assert np.array_equal(intersections, np.lexsort((np.arange(n), depth.astype(np.float32))))


# Stress: every case must end, and end finite. Those with a well-defined picture are held against the definition too.


def test_near_plane(device: Device) -> None:
    """Behind, in the camera centre, just behind, on and just in front of the near plane."""
    near = np.float32(INRIA.near)
    depths = [-5, -0.2, 0, np.nextafter(near, np.float32(0)), near, np.nextafter(near, np.float32(1))]
    for k, depth in enumerate(depths):
        image, transmittance = render(splats([0.01, 0.01, depth], sigma=0.02, logit=3), camera(), device)
        drawn = k == len(depths) - 1
        assert (image.max() > 0) == drawn
        assert (transmittance.min() < 1) == drawn
        assert np.isfinite(image).all()


def test_close_to_the_camera_centre_and_to_the_side(device: Device) -> None:
    scene = splats([[3, 2, 0.25], [-0.5, 0.1, 0.21], [0.3, -4, 0.3]], sigma=0.3, logit=2)
    check(device, scene, camera())


def test_sizes_from_nothing_to_the_universe(device: Device) -> None:
    for sigma in [1e-30, 1e-6, 10, 1e3, 1e6, 1e20, 1e38]:
        scene = splats([[0, 0, 2], [0.3, 0.2, 3]], sigma=sigma, logit=1)
        if 1e-7 < sigma < 1e4:
            check(device, scene, camera())
        image, transmittance = render(scene, camera(), device)
        assert np.isfinite(image).all()
        if sigma > 100:  # covers everything evenly
            assert np.allclose(transmittance, (1 - 1 / (1 + np.exp(-1))) ** 2, atol=1e-4)


def test_needles(device: Device) -> None:
    """Aspect ratios up to a million, at every angle."""
    rng = np.random.default_rng(0)
    scene = random_splats(40, 0, seed=9)
    log_scales = np.tile(np.array([-9.0, -9.0, 3.0], np.float32), (40, 1))
    log_scales[20:] = (-20, 2, 2)
    scene = replace(scene, log_scales=log_scales, opacity_logits=rng.normal(2, 1, 40).astype(np.float32))
    check(device, scene, tilted_camera(9, 80, 60), GSPLAT, tolerance=1e-4)


def test_opacities(device: Device) -> None:
    for logit in [-200, -50, -5.6, -5.5, 0, 16.118095, 50, 200]:
        check(device, splats([0.01, 0.02, 2], sigma=0.3, logit=logit), camera(), GSPLAT)
        check(device, splats([0.01, 0.02, 2], sigma=0.3, logit=logit), camera(), INRIA)


def test_quaternions_of_any_length(device: Device) -> None:
    scene, view = random_splats(30, 0, seed=11), tilted_camera(11, 40, 40)
    unit = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    picture = render(scene, view, device)[0]
    for length in [1e-12, 1e-3, 1e6, 1e18]:
        long = replace(scene, quaternions=unit * np.float32(length))
        assert np.allclose(render(long, view, device)[0], picture, atol=2e-5)
    level = splats([0, 0, 2], sigma=(0.3, 0.1, 0.1))
    zero = replace(level, quaternions=0 * level.quaternions)
    assert np.array_equal(render(zero, camera(), device)[0], render(level, camera(), device)[0]), "the identity"


def test_five_thousand_layers_on_a_pixel(device: Device) -> None:
    rng = np.random.default_rng(1)
    means = np.zeros((5000, 3))
    means[:, 2] = rng.uniform(1, 5, 5000)
    scene = splats(means, sigma=5, logit=-5.2, colour=rng.uniform(0, 1, (5000, 3)))
    check(device, scene, camera(24, 20), tolerance=5e-5)


def test_a_tile_with_a_hundred_thousand_intersections(device: Device) -> None:
    rng = np.random.default_rng(2)
    n = 100_000
    means = np.concatenate([rng.uniform(-0.05, 0.05, (n, 2)), rng.uniform(1, 2, (n, 1))], axis=1)
    scene = splats(means, sigma=1e-3, logit=-2, colour=rng.uniform(0, 1, (n, 3)))
    with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set([camera(16, 16)]) as view:
        _, intersections = read_lists(device, view)
        image, _ = rasterizer.composite(view)
    assert len(intersections) > 0.9 * n
    depth = means[intersections, 2].astype(np.float32)
    assert (np.diff(depth) >= 0).all()
    assert np.isfinite(image).all()


def test_image_sizes(device: Device) -> None:
    for width, height in [(1, 1), (1, 40), (8192, 16), (16, 8192), (17, 16), (15, 33)]:
        view = camera(width, height, focal=float(max(width, height)), fy=float(max(width, height)))
        rng = np.random.default_rng(width)
        n = 60
        means = np.concatenate(
            [rng.uniform(-0.6, 0.6, (n, 2)) * (width, height) / max(width, height), 1 + np.zeros((n, 1))], 1
        )
        scene = splats(means, sigma=rng.uniform(1e-3, 3e-2, (n, 3)), logit=rng.normal(0, 2, n))
        # Positions are float32: at 8000 pixels from the left their last digit is worth 5e-4 of a pixel.
        check(device, scene, view, GSPLAT, tolerance=2e-5 * max(1, max(width, height) / 100))


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_far_from_the_origin(device: Device, offset: float) -> None:
    """The digits that float32 leaves of the centres are all kept: the camera centre is subtracted first."""
    scene = random_splats(200, 3, seed=12)
    moved = replace(scene, means=scene.means + np.float32([offset, 0, 0]))
    check(device, moved, tilted_camera(12, 60, 50, offset), tolerance=5e-5)


def test_coordinates_of_a_million(device: Device) -> None:
    rng = np.random.default_rng(4)
    scene = splats(rng.uniform(-1e6, 1e6, (2000, 3)), sigma=np.exp(rng.normal(5, 5, (2000, 3))), logit=1)
    check(device, scene, camera(), tolerance=5e-5)


def test_a_view_that_sees_nothing(device: Device) -> None:
    for means in [[[0, 0, -3]], [[100, 0, 1]], [[0, 0, 0]]]:
        image, transmittance = render(splats(means), camera(), device, background=(0.25, 0.5, 1))
        assert np.array_equal(image, np.broadcast_to(np.float32([0.25, 0.5, 1]), image.shape))
        assert (transmittance == 1).all()


def test_everything_at_once_stays_finite(device: Device) -> None:
    """Random extremes of every parameter."""
    rng = np.random.default_rng(13)
    n = 3000
    extremes = np.float32([-1e30, -1e6, -1, -1e-6, 0, 1e-6, 1, 1e6, 1e30])
    scene = Scene(
        np.where(rng.random((n, 3)) < 0.3, rng.choice(extremes, (n, 3)), rng.normal(size=(n, 3))).astype(np.float32),
        rng.choice(np.float32([-200, -30, -3, 0, 3, 30, 88, 200]), (n, 3)),
        rng.choice(extremes, (n, 4)),
        rng.choice(np.float32([-1e30, -50, -1, 0, 1, 50, 1e30]), n),
        rng.choice(np.float32([-1e30, -1, 0, 1, 1e30]), (n, 16, 3), p=[0.01, 0.3, 0.38, 0.3, 0.01]),
    )
    for seed in range(4):
        for rules in (INRIA, RasterRules(near=1e-6, alpha_cap=0.999, square_extent=False)):
            image, transmittance = render(scene, tilted_camera(seed, 40, 30), device, rules)
            assert np.isfinite(image).all()
            assert np.isfinite(transmittance).all()
            assert transmittance.min() >= 0
            assert transmittance.max() <= 1


@contextmanager
def room_for(device: Device, nbytes: int) -> Iterator[None]:
    """Of the device's memory no more is left."""
    held = device.info.memory - device.allocated - nbytes
    device.allocated += held
    try:
        yield
    finally:
        device.allocated -= held


@pytest.mark.one_runtime
def test_lists_larger_than_the_device_give_an_error(device: Device) -> None:
    scene = splats(np.tile([0.0, 0, 2], (2000, 1)), sigma=100, logit=-5)
    with Rasterizer(device, scene) as rasterizer:
        with room_for(device, 3 << 20), pytest.raises(DeviceError, match="--device"):
            rasterizer.render(camera(1000, 1000))
        image, _ = rasterizer.render(camera(20, 20))  # and the rasterizer still works
        assert np.isfinite(image).all()


@pytest.mark.one_runtime
def test_what_does_not_fit_leaves_nothing_behind(device: Device) -> None:
    """Wherever in making a rasterizer or a view the memory runs out."""
    scene, view = random_splats(3000, 3, seed=1), tilted_camera(1, 100, 100)
    before = device.allocated
    with Rasterizer(device, scene) as rasterizer:
        with_scene = device.allocated - before
        with rasterizer.prepare_set([view]):
            most = device.allocated - before
    assert device.allocated == before

    def make_and_prepare() -> None:
        with Rasterizer(device, scene) as rasterizer:
            rasterizer.prepare_set([view])

    for room in (0.1 * with_scene, 0.5 * with_scene, 0.9 * with_scene, (with_scene + most) / 2):
        with room_for(device, int(room)), pytest.raises(DeviceError, match="cannot hold"):
            make_and_prepare()
        assert device.allocated == before


@pytest.mark.one_runtime
def test_image_with_too_many_tiles_is_refused(device: Device) -> None:
    with pytest.raises(UsageError, match="1048577 x 1"):
        render(splats([0, 0, 2]), camera(1 << 20 | 1, 1), device)


@pytest.mark.parametrize("rules", [{"near": 0.0}, {"near": float("nan")}, {"alpha_cap": 1.0}, {"alpha_cap": 0.0}])
def test_impossible_rules_are_refused(rules: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        RasterRules(**rules)  # type: ignore[arg-type]


def test_impossible_camera_is_refused() -> None:
    with pytest.raises(DataError):
        camera(0, 10)
