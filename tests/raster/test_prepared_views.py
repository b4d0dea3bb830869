"""Views that are prepared and kept, alone and in sets: what is drawn of them is what is rendered at once."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.raster.preparation import Preparation
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.view_set import ViewSet
from tests.raster.test_rasterizer import read_lists
from tests.reference.scenes import plain_splats as splats
from tests.reference.scenes import random_splats, tilted_camera
from tests.reference.scenes import straight_camera as camera

SCENE = random_splats(2000, 2, seed=4)


def test_prepared_views_composite_as_rendered(device: Device) -> None:
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 120, 33), tilted_camera(3, 17, 15)]
    with Rasterizer(device, SCENE) as rasterizer, ExitStack() as stack:
        views = [stack.enter_context(rasterizer.prepare_set([camera])) for camera in cameras]
        for view, camera in list(zip(views, cameras, strict=True)) * 2:
            assert_as_rendered(rasterizer, view, camera)
        for view in views:
            assert view.capacity == view.views[0].intersection_count > 0


def assert_as_rendered(rasterizer: Rasterizer, views: ViewSet, camera: Camera) -> None:
    found, wanted = rasterizer.composite(views), rasterizer.render(camera)
    assert [array.tobytes() for array in found] == [array.tobytes() for array in wanted]


def test_a_prepared_view_takes_another_camera_in_its_memory(device: Device) -> None:
    """With more intersections and with fewer, and back; not one of another size."""
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 61, 50), tilted_camera(3, 64, 64, offset=1e4)]
    with Rasterizer(device, SCENE) as rasterizer, rasterizer.prepare_set([cameras[2]]) as views:
        for camera in [cameras[0], cameras[1], cameras[2], cameras[0]]:
            assert rasterizer.prepare_again(views, [camera])
            assert_as_rendered(rasterizer, views, camera)
        before = rasterizer.composite(views)[0]
        assert not rasterizer.prepare_again(views, [tilted_camera(1, 64, 65)])
        assert np.array_equal(rasterizer.composite(views)[0], before)


def assert_as_alone(device: Device, rasterizer: Rasterizer, views: ViewSet, cameras: list[Camera]) -> None:
    """The lists of a set, one behind the other, are those of its views prepared alone."""
    starts, all_offsets = views.intersection_starts, views.read_offsets()
    intersections = device.download(views.intersections, (views.capacity,), np.uint32)
    subtiles = device.download(views.subtiles, (views.capacity,), np.uint16)
    for number, view in enumerate(cameras):
        count = views.views[number].intersection_count
        part = slice(starts[number], starts[number] + count)
        with rasterizer.prepare_set([view]) as alone:
            own_offsets, own_intersections = read_lists(device, alone)
            own_subtiles = device.download(alone.subtiles, (alone.capacity,), np.uint16)
        assert count == len(own_intersections)
        assert np.array_equal(all_offsets[number], own_offsets)
        assert np.array_equal(intersections[part], own_intersections)
        assert np.array_equal(subtiles[part], own_subtiles)


def test_views_of_a_set_are_those_prepared_alone(gpu: Device) -> None:
    """Of different sizes; and of other cameras in the set's memory. Each time one view sees nothing."""
    cameras = [tilted_camera(1, 64, 64), tilted_camera(2, 120, 33, offset=1e4), tilted_camera(3, 17, 15)]
    first = [tilted_camera(seed, 64, 64, offset=1e4 * (seed == 2)) for seed in (1, 2, 3)]
    then = [tilted_camera(seed, 64, 64, offset=1e4 * (seed == 4)) for seed in (4, 5, 6)]
    with Rasterizer(gpu, SCENE) as rasterizer:
        with rasterizer.prepare_set(cameras) as views:
            assert [view.intersection_count > 0 for view in views.views] == [True, False, True]
            assert_as_alone(gpu, rasterizer, views, cameras)
        with rasterizer.prepare_set(first) as views:
            for others in (then, first, then):
                assert rasterizer.prepare_again(views, others)
                assert_as_alone(gpu, rasterizer, views, others)


@pytest.mark.parametrize("most", [None, 2])
def test_pictures_of_several_views_in_one_buffer(
    device: Device, monkeypatch: pytest.MonkeyPatch, most: int | None
) -> None:
    """Those of one after the other, also where the device holds no more than two views at a time.

    Then only the first of the sets takes memory, where the others have as many tiles.
    """
    prepare_set, made = Preparation.prepare_set, []

    def at_most(self: Preparation, cameras: Sequence[Camera], memory: Memory | None = None) -> ViewSet:
        if most is not None and len(cameras) > most:
            raise DeviceMemoryError("too many views")
        made.append(len(cameras))
        return prepare_set(self, cameras, memory)

    of_some_sizes = [tilted_camera(1, 64, 64), tilted_camera(2, 50, 33), *(tilted_camera(k, 17, 15) for k in range(3))]
    of_one_size = [tilted_camera(seed, 50, 33) for seed in range(4)]
    with Rasterizer(device, random_splats(500, 1, seed=5)) as rasterizer, Memory(device) as memory:
        for cameras in (of_some_sizes, of_one_size):
            wanted = [rasterizer.render(view)[0].reshape(-1, 3) for view in cameras]
            pixels = sum(map(len, wanted))
            buffer = memory.allocate(12 * pixels, "pictures")
            made.clear()
            with monkeypatch.context() as patch:
                patch.setattr(Preparation, "prepare_set", at_most)
                rasterizer.render_into(cameras, buffer)
            assert np.array_equal(device.download(buffer, (pixels, 3), np.float32), np.concatenate(wanted))
    if most and device.family == "gpu":
        assert made == [2]


def test_lists_that_do_not_fit_are_made_again(device: Device) -> None:
    """A frame begins with room for 65,536 intersections; a prepared view counts its own first."""
    rng = np.random.default_rng(6)
    depths = np.stack([0 * rng.random(300), 0 * rng.random(300), rng.uniform(1, 5, 300)], axis=1)
    scene, view = splats(depths, sigma=5, logit=-4, colour=rng.uniform(0, 1, (300, 3))), camera(256, 256)
    with Rasterizer(device, scene) as rasterizer, rasterizer.prepare_set([view]) as prepared:
        assert prepared.capacity > 1 << 16
        for _ in range(2):  # the second frame has room
            assert_as_rendered(rasterizer, prepared, view)
