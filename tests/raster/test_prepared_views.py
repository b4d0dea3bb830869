"""Views that are prepared and kept, alone and in sets: what is drawn of them is what is rendered at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.preparation import Preparation
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import ViewSet
from tests.devices import open_device
from tests.raster.test_rasterizer import read_lists
from tests.reference.scenes import plain_splats as splats
from tests.reference.scenes import random_splats, tilted_camera
from tests.reference.scenes import straight_camera as camera


def test_prepared_views_composite_as_rendered(device: Device) -> None:
    scene = random_splats(2000, 2, seed=4)
    rasterizer = Rasterizer(device, scene)
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 120, 33), tilted_camera(3, 17, 15)]
    views = [rasterizer.prepare_set([c]) for c in cameras]
    for view in views * 2:
        image, transmittance = rasterizer.composite(view)
        rendered = rasterizer.render(view.views[0].camera)
        assert image.tobytes() == rendered[0].tobytes()
        assert transmittance.tobytes() == rendered[1].tobytes()
    for view in views:
        assert view.capacity == view.views[0].intersection_count > 0
        view.close()
    rasterizer.close()


def test_a_prepared_view_takes_another_camera_in_its_memory(device: Device) -> None:
    """With more intersections and with fewer, and back; not one of another size."""
    scene = random_splats(2000, 2, seed=4)
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 61, 50), tilted_camera(3, 64, 64, offset=1e4)]
    with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set([cameras[2]]) as views:
        for camera in [cameras[0], cameras[1], cameras[2], cameras[0]]:
            assert rasterizer.prepare_again(views, [camera])
            image, transmittance = rasterizer.composite(views)
            rendered = rasterizer.render(camera)
            assert image.tobytes() == rendered[0].tobytes()
            assert transmittance.tobytes() == rendered[1].tobytes()
        before = rasterizer.composite(views)[0]
        assert not rasterizer.prepare_again(views, [tilted_camera(1, 64, 65)])
        assert np.array_equal(rasterizer.composite(views)[0], before)


def test_a_set_takes_other_cameras_in_its_memory(device: Device) -> None:
    if device.family == "cpu":
        pytest.skip("CPU kernels take one view at a time")
    scene = random_splats(2000, 2, seed=4)
    first = [tilted_camera(seed, 64, 64, offset=1e4 * (seed == 2)) for seed in (1, 2, 3)]
    then = [tilted_camera(seed, 64, 64, offset=1e4 * (seed == 4)) for seed in (4, 5, 6)]
    with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set(first) as views:
        for cameras in (then, first, then):
            assert rasterizer.prepare_again(views, cameras)
            intersections = device.download(views.intersections, (views.capacity,), np.uint32)
            for view, offsets, start, camera in zip(
                views.views, views.read_offsets(), views.intersection_starts, cameras, strict=False
            ):
                with rasterizer.prepare_set([camera]) as alone:
                    own_offsets, own_intersections = read_lists(device, alone)
                assert np.array_equal(offsets, own_offsets)
                assert np.array_equal(intersections[start : start + view.intersection_count], own_intersections)


def test_views_of_a_set_are_those_prepared_alone(device: Device) -> None:
    """Different sizes, one view that sees nothing, lists one behind the other."""
    if device.family == "cpu":
        pytest.skip("CPU kernels take one view at a time")
    scene = random_splats(2000, 2, seed=4)
    rasterizer = Rasterizer(device, scene)
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 120, 33, offset=1e4), tilted_camera(3, 17, 15)]
    views = rasterizer.prepare_set(cameras)
    offsets = views.read_offsets()
    intersections = device.download(views.intersections, (views.capacity,), np.uint32)
    subtiles = device.download(views.subtiles, (views.capacity,), np.uint16)
    for i, view in enumerate(cameras):
        alone = rasterizer.prepare_set([view])
        part = slice(views.intersection_starts[i], views.intersection_starts[i + 1])
        own_offsets, own_intersections = read_lists(device, alone)
        assert np.array_equal(offsets[i], own_offsets)
        assert np.array_equal(intersections[part], own_intersections)
        own_subtiles = device.download(alone.subtiles, (alone.capacity,), np.uint16)
        assert np.array_equal(subtiles[part], own_subtiles)
        assert views.views[i].intersection_count == alone.capacity
        assert (alone.capacity == 0) == (i == 1)
        alone.close()
    views.close()
    rasterizer.close()


@pytest.mark.parametrize("most", [None, 2])
def test_pictures_of_several_views_in_one_buffer(
    device: Device, monkeypatch: pytest.MonkeyPatch, most: int | None
) -> None:
    """Those of one after the other, also where the device holds no more than two views at a time."""
    rasterizer = Rasterizer(device, random_splats(500, 1, seed=5))
    prepare_set = Preparation.prepare_set

    def at_most(self: Preparation, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        if most is not None and len(cameras) > most:
            raise DeviceMemoryError("too many views")
        return prepare_set(self, cameras, memory)

    monkeypatch.setattr(Preparation, "prepare_set", at_most)
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 50, 33), *(tilted_camera(seed, 17, 15) for seed in range(3))]
    wanted = [rasterizer.render(view)[0].reshape(-1, 3) for view in cameras]
    pixels = sum(map(len, wanted))
    with rasterizer, Memory(device) as memory:
        buffer = memory.allocate(12 * pixels, "pictures")
        rasterizer.render_into(cameras, buffer)
        assert np.array_equal(device.download(buffer, (pixels, 3), np.float32), np.concatenate(wanted))


def test_sets_of_pictures_take_the_memory_of_those_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the first of them takes memory, where the others have as many tiles; pictures are the same."""
    device = open_device("gpu")
    prepare_set, made = Preparation.prepare_set, []

    def at_most_two(self: Preparation, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        if len(cameras) > 2:
            raise DeviceMemoryError("too many views")
        made.append(len(cameras))
        return prepare_set(self, cameras, memory)

    cameras = [tilted_camera(seed, 50, 33) for seed in range(4)]
    with Rasterizer(device, random_splats(500, 1, seed=5)) as rasterizer, Memory(device) as memory:
        wanted = [rasterizer.render(view)[0] for view in cameras]
        buffer = memory.allocate(12 * 50 * 33 * 4, "pictures")
        monkeypatch.setattr(Preparation, "prepare_set", at_most_two)
        rasterizer.render_into(cameras, buffer)
        assert np.array_equal(device.download(buffer, (4, 33, 50, 3), np.float32), wanted)
    assert made == [2]
    assert device.allocated == 0


def test_lists_that_do_not_fit_are_made_again(device: Device) -> None:
    """A frame begins with room for 65,536 intersections; a prepared view counts its own first."""
    rng = np.random.default_rng(6)
    depths = np.stack([0 * rng.random(300), 0 * rng.random(300), rng.uniform(1, 5, 300)], axis=1)
    scene, view = splats(depths, sigma=5, logit=-4, colour=rng.uniform(0, 1, (300, 3))), camera(256, 256)
    with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set([view]) as prepared:
        assert prepared.capacity > 1 << 16
        expected = rasterizer.composite(prepared)
        for _ in range(2):  # the second frame has room
            image, transmittance = rasterizer.render(view)
            assert image.tobytes() == expected[0].tobytes()
            assert transmittance.tobytes() == expected[1].tobytes()
