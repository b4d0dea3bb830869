"""The derivatives of pictures that the kernels find, against float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model.scene import Scene
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from tests.cases.derivatives import case_of_derivatives
from tests.cases.kinds_of_scenes import KINDS_OF_SCENES
from tests.cases.once import once
from tests.reference.derivatives import gradient
from tests.reference.scenes import plain_splats, ring_of_cameras, straight_camera, tilted_camera, visible_scene

BACKGROUND = (0.3, 0.6, 0.1)


def products(device, scene, cameras, values, rules=INRIA, given=True, unit=1.0):
    """(N, columns) Jᵀ W v of all views together, from the kernels."""
    with PictureDerivatives(device, scene, rules, BACKGROUND) as derivatives:
        rows = np.concatenate([each.reshape(-1, 3) for each in values]).astype(np.float32)
        target = device.upload(rows, "the values")
        try:
            derivatives.add(cameras, target, given, unit)
            return derivatives.read()
        finally:
            device.free(target)


def of_group(columns):
    """The gradient's columns by kind of parameter."""
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return dict(zip(names, np.split(columns, [3, 6, 10, 11], axis=1), strict=True))


def in_float64(scene, cameras, values, rules=INRIA):
    sums = {}
    for camera, v in zip(cameras, values, strict=True):
        weight = REFERENCE_PIXELS / (camera.width * camera.height)
        found = gradient(scene, camera, rules, v, BACKGROUND)
        for name, array in vars(found).items():
            sums[name] = sums.get(name, 0) + weight * array.reshape(len(scene), -1)
    return sums


#: The same in float64, once for all devices.
wanted = once(in_float64, 40)


def agree(found, exact, tolerance=1e-4):
    for name, array in exact.items():
        assert np.isfinite(found[name]).all()
        error = np.linalg.norm(found[name] - array)
        assert error < tolerance * np.linalg.norm(array), f"{name}: {error / np.linalg.norm(array):.1e}"


@pytest.mark.parametrize(("rules", "antialiased", "degree"), KINDS_OF_SCENES)
def test_every_kind_of_parameter(device, degree, antialiased, rules):
    scene, cameras, values = case_of_derivatives(degree, antialiased)
    found = of_group(products(device, scene, cameras, values, rules))
    agree(found, wanted(scene, cameras, values, rules))


@pytest.mark.parametrize(("size", "unit"), [(0.3, 1.0), (0.3, 16.0), (1e-4, 2.0**12)])
def test_differences_to_pictures(device, size, unit):
    """v is the picture's difference to a target. The sums are integers: a unit brings small ones into their range."""
    scene, cameras, rng = visible_scene(40, 1), ring_of_cameras(3, size=40), np.random.default_rng(0)
    with Rasterizer(device, scene, background=BACKGROUND) as rasterizer:
        pictures = [rasterizer.render(camera)[0] for camera in cameras]
    targets = [picture + rng.normal(scale=size, size=picture.shape).astype(np.float32) for picture in pictures]
    differences = [(picture - target).astype(np.float64) for picture, target in zip(pictures, targets, strict=True)]
    exact = wanted(scene, cameras, differences)
    agree(of_group(products(device, scene, cameras, targets, given=False, unit=unit)), exact)


def test_lists_of_more_splats_than_are_walked_at_a_time(device):
    """CPU kernels take 1024 at a time; pixels do not end before."""
    scene = visible_scene(1400, 1)
    scene.log_scales[:] -= 0.5
    scene.opacity_logits[:] = -4.6
    cameras = ring_of_cameras(1, size=16)
    values = [np.random.default_rng(0).normal(size=(16, 16, 3))]
    agree(of_group(products(device, scene, cameras, values)), wanted(scene, cameras, values))


def test_the_same_bits_every_time(device):
    scene = visible_scene(300, 3)
    cameras = ring_of_cameras(5, size=70)
    values = [np.random.default_rng(0).normal(size=(70, 70, 3)) for _ in cameras]
    first = products(device, scene, cameras, values)
    assert first.any()
    assert np.array_equal(products(device, scene, cameras, values), first)


def test_a_view_after_another_in_the_same_memory(device):
    """Views take the place of earlier ones; nothing of these is left."""
    scene = visible_scene(80, 1)
    cameras = ring_of_cameras(4, size=40)
    values = [np.random.default_rng(k).normal(size=(40, 40, 3)) for k in range(4)]
    with PictureDerivatives(device, scene, INRIA, BACKGROUND) as derivatives:
        for camera, v in zip(cameras, values, strict=True):
            target = device.upload(v.astype(np.float32), "the values")
            derivatives.add([camera], target, given=True)
            device.free(target)
        found = of_group(derivatives.read())
    agree(found, wanted(scene, cameras, values))


def stressful() -> dict[str, Scene]:
    """Splats at the limits of what a scene can hold."""
    straight = [[0, 0, 3], [0.3, 0.2, 4], [-0.4, 0.1, 5]]
    scene = plain_splats(straight)

    def with_(**values) -> Scene:
        arrays = {name: np.full_like(getattr(scene, name), value) for name, value in values.items()}
        return dataclasses.replace(scene, **arrays)

    return {
        "huge": plain_splats(straight, sigma=1e9),
        "immense": plain_splats(straight, sigma=np.exp(80.0)),
        "tiny": plain_splats(straight, sigma=1e-12),
        "needle": with_(log_scales=(-80, -1, 4)),
        "line": with_(log_scales=(-200, -200, -1)),
        "coincident": plain_splats([[0, 0, 3]] * 300, logit=2.0),
        "opaque": plain_splats([[0, 0, 3]] * 5, logit=80.0),
        "transparent": plain_splats(straight, logit=-80.0),
        "behind": plain_splats([[0, 0, -3], [0, 0, -1e-3]]),
        "at the near plane": plain_splats([[0, 0, 0.2], [0, 0, np.nextafter(np.float32(0.2), 1)], [0.1, 0, 0.2001]]),
        "at the camera": plain_splats([[0, 0, 0], [1e-30, 0, 1e-30]]),
        "far away": plain_splats([[1e15, 0, 1e15], [0, 1e18, 1e18]], sigma=1e15),
        "bright": with_(sh=1e30),
        "dark": with_(sh=-1e30),
        "unturned": with_(quaternions=0),
    }


def noise(camera):
    return [np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))]


@pytest.mark.parametrize("antialiased", [False, True])
def test_everything_is_finite(device, antialiased):
    camera = straight_camera()
    for scene in stressful().values():
        scene = dataclasses.replace(scene, antialiased=antialiased)
        assert np.isfinite(products(device, scene, [camera], noise(camera))).all()


def test_degenerate_splats_have_their_derivatives(device):
    camera = straight_camera()
    for name in ["tiny", "needle", "line", "coincident", "opaque"]:
        scene = stressful()[name]
        found = of_group(products(device, scene, [camera], noise(camera)))
        exact = wanted(scene, [camera], noise(camera))
        scale = max(np.linalg.norm(array) for array in exact.values())
        for kind, array in exact.items():
            assert np.isfinite(array).all()
            assert np.linalg.norm(found[kind] - array) < 1e-4 * max(np.linalg.norm(array), 1e-3 * scale), kind


def test_thin_needles_keep_their_digits(device):
    """Axes of 1 : 100,000, 20 world units long, seen from 4: what the long axis does on screen cancels, unless it is
    made of what is left."""
    rng = np.random.default_rng(9)
    scene = visible_scene(40, 0, seed=9)
    scene = dataclasses.replace(scene, log_scales=np.tile(np.array([-9, -9, 3], np.float32), (40, 1)))
    camera = tilted_camera(9, 80, 60)
    values = [rng.normal(size=(camera.height, camera.width, 3))]
    found = of_group(products(device, scene, [camera], values, GSPLAT))
    agree(found, wanted(scene, [camera], values, GSPLAT), 2e-4)
