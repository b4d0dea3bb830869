"""J x: how pictures change along a direction, against float64, and against its transpose."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.fitting.tangents import PictureTangents
from tests.cases.kinds_of_scenes import KINDS_OF_SCENES
from tests.devices import KERNELS, open_device
from tests.reference.raster import render
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene

BACKGROUND = (0.3, 0.6, 0.1)
#: Parameters in the order of the columns, and the columns that end them.
KINDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
ENDS = (3, 6, 10, 11)


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "not all memory was given back"


def scene_and_views(degree, antialiased=False):
    scene = dataclasses.replace(visible_scene(60, degree, seed=degree), antialiased=antialiased)
    unit = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    scene = dataclasses.replace(scene, quaternions=unit)
    scene.opacity_logits[:6] = 7
    scene.opacity_logits[6] = -9
    scene.sh[:8, 0] -= 3
    cameras = [*ring_of_cameras(4, size=40)[:2], tilted_camera(3, 33, 50)]
    scene.means[9] = 2 * cameras[0].centre
    return scene, cameras


def direction_of(scene, seed=0):
    """(N, columns) a change of every parameter; of unit quaternions across themselves."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(len(scene), 11 + scene.sh[0].size))
    direction[:, :3] *= 0.03
    direction[:, 11:] *= 0.2
    unit = scene.quaternions.astype(np.float64)
    along = (direction[:, 6:10] * unit).sum(axis=1, keepdims=True) / (unit**2).sum(axis=1, keepdims=True)
    direction[:, 6:10] -= along * unit
    return direction.astype(np.float32)


def uploaded(device, rasterizer, direction):
    columns = np.zeros((direction.shape[1], rasterizer.stride), np.float32)
    columns[:, : len(direction)] = direction.T
    return device.upload(columns, "the direction")


def changes(device, derivatives, cameras, direction):
    """(pixels, 3) J x of all views."""
    rasterizer = derivatives.rasterizer
    pixels = sum(c.width * c.height for c in cameras)
    x, result = uploaded(device, rasterizer, direction), device.allocate(12 * pixels, "the changes")
    try:
        with PictureTangents(device, rasterizer) as tangents:
            first = 0
            sets = [cameras] if device.family == "gpu" else [[camera] for camera in cameras]
            for some in sets:
                with rasterizer.prepare_set(some) as views:
                    tangents.of(views, x, result, first)
                    first += views.pixels
        return device.download(result, (pixels, 3), np.float32)
    finally:
        for buffer in (x, result):
            device.free(buffer)


def transposed(device, derivatives, cameras, values):
    """(N, columns) Jᵀ W v."""
    target = device.upload(values, "the values")
    try:
        derivatives.forget()
        derivatives.add(cameras, target, given=True)
        return derivatives.read()
    finally:
        device.free(target)


def moved(scene, direction, by):
    """The scene some way along a direction, in float64."""
    result = scene.subset(np.arange(len(scene)))
    for name, part in zip(KINDS, np.split(direction.astype(np.float64), ENDS, axis=1), strict=True):
        array = getattr(scene, name).astype(np.float64)
        object.__setattr__(result, name, array + by * part.reshape(array.shape))  # scenes are made of float32
    return result


@pytest.mark.parametrize(("rules", "antialiased", "degree"), KINDS_OF_SCENES)
def test_central_differences_of_pictures(device, degree, antialiased, rules):
    """Of the float64 renderer; pixels in which something switches between the two pictures are left out, few."""
    scene, cameras = scene_and_views(degree, antialiased)
    direction = direction_of(scene)
    with PictureDerivatives(device, scene, rules, BACKGROUND) as derivatives:
        found = changes(device, derivatives, cameras, direction)
    step, start, left_out = 1e-5, 0, 0
    for camera in cameras:
        pixels = camera.width * camera.height
        pictures = [render(moved(scene, direction, by), camera, rules, BACKGROUND).image for by in (-step, 0, step)]
        here = [(b - a).reshape(-1, 3) / step for a, b in itertools.pairwise(pictures)]
        smooth = np.abs(here[1] - here[0]).max(axis=1) < 1e-2 * (1 + np.abs(here[0]).max(axis=1))
        exact = (here[0] + here[1])[smooth] / 2
        error = np.linalg.norm(found[start : start + pixels][smooth] - exact) / np.linalg.norm(exact)
        assert error < 1e-4, f"{error:.1e}"
        start, left_out = start + pixels, left_out + np.count_nonzero(~smooth)
    assert left_out < 0.01 * start


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_transpose(device, degree, antialiased):
    """x . Jᵀ W v = v . W J x, to 1e-6 of their lengths for any x and v, and of the product itself where v = J x."""
    scene, cameras = scene_and_views(degree, antialiased)
    weights = np.concatenate([np.full(c.width * c.height, REFERENCE_PIXELS / (c.width * c.height)) for c in cameras])
    for seed in range(3):
        direction = direction_of(scene, seed)
        with PictureDerivatives(device, scene, INRIA, BACKGROUND) as derivatives:
            forth = changes(device, derivatives, cameras, direction)
            values = np.random.default_rng(seed).normal(size=forth.shape).astype(np.float32)
            back = transposed(device, derivatives, cameras, values)
            normal = transposed(device, derivatives, cameras, forth)
        x, y = direction.astype(np.float64), forth.astype(np.float64) * weights[:, None]
        lengths = np.linalg.norm(y) * np.linalg.norm(values)
        assert abs((x * back).sum() - (y * values).sum()) < 1e-6 * lengths
        square = (y * forth).sum()
        assert abs((x * normal).sum() - square) < 1e-6 * square


def test_a_tall_list(device):
    """Several batches of splats, and pixels that end in the middle of them."""
    scene = visible_scene(1400, 1)
    scene.log_scales[:] -= 0.5
    scene.opacity_logits[:] = -2
    camera = ring_of_cameras(1, size=20)
    direction = direction_of(scene)
    with PictureDerivatives(device, scene, GSPLAT, BACKGROUND) as derivatives:
        forth = changes(device, derivatives, camera, direction)
        normal = transposed(device, derivatives, camera, forth)
    square = REFERENCE_PIXELS / 400 * (forth.astype(np.float64) ** 2).sum()
    assert abs((direction.astype(np.float64) * normal).sum() - square) < 1e-6 * square


def test_the_same_bits_every_time(device):
    scene, cameras = scene_and_views(3)
    direction = direction_of(scene)
    with PictureDerivatives(device, scene, INRIA, BACKGROUND) as derivatives:
        first = changes(device, derivatives, cameras, direction)
        assert first.any()
        assert np.array_equal(changes(device, derivatives, cameras, direction), first)


def test_no_change_no_change(device):
    scene, cameras = scene_and_views(1)
    with PictureDerivatives(device, scene, INRIA, BACKGROUND) as derivatives:
        assert not changes(device, derivatives, cameras, 0 * direction_of(scene)).any()
