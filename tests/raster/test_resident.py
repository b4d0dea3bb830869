"""A scene that stays on the device: the same results, one upload, and nothing left behind."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster import resident
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import ResidentScene, ResidentSubset, scene_on
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import State, Workbench
from potr_cl.workers.host import HostPool
from tests.reference.scenes import random_splats, straight_camera

pytestmark = pytest.mark.one_runtime
OPTIONS = EncodeOptions.for_preset("best", prune={"iterations": 2}, refit={"steps": 1}, compact={"on": True})


@pytest.fixture
def uploads(monkeypatch):
    """The colours that have gone to a device."""
    found, write_sh = [], SceneBuffers.write_sh
    monkeypatch.setattr(SceneBuffers, "write_sh", lambda self, to, sh: found.append(sh) or write_sh(self, to, sh))
    return found


def test_only_the_scene_itself_is_on_its_device(device):
    scene = random_splats(100)
    with ResidentScene(device, scene) as kept:
        assert isinstance(kept.drawable(device, scene), SceneBuffers)
        other = replace(scene)
        assert kept.drawable(device, other) is other
        another = Device(device.info, family=device.family)
        assert kept.drawable(another, scene) is scene


def test_a_scene_is_not_kept_where_it_would_take_much_of_the_memory(device, monkeypatch):
    scene = random_splats(5000)
    monkeypatch.setattr(device, "info", replace(device.info, memory=2 * scene.nbytes))
    with ResidentScene(device, scene) as kept:
        assert kept.drawable(device, scene) is scene
        assert device.allocated == 0


def test_a_large_scene_is_not_there_twice_where_a_device_has_the_memory_of_the_host(device):
    if device.info.kind != "cpu":
        pytest.skip("this device has memory of its own")
    scene = random_splats(5000)
    with ResidentScene(device, scene, memory=2 * scene.nbytes) as kept:
        assert kept.drawable(device, scene) is scene
    with ResidentScene(device, scene, memory=20 * scene.nbytes) as kept:
        assert kept.drawable(device, scene) is not scene


def test_other_colours_leave_the_kept_ones_alone(device):
    scene, camera = random_splats(400, seed=3), straight_camera()
    other = random_splats(400, seed=4).sh
    with ResidentScene(device, scene) as kept:
        with Rasterizer(device, kept.drawable(device, scene)) as rasterizer:
            before = rasterizer.render(camera)[0]
            assert rasterizer.replace_sh(other) is None  # those of the kept scene are nobody's to free
            after = rasterizer.render(camera)[0]
            former = rasterizer.replace_sh(scene.sh)
            assert former is not None
            device.free(former)
            assert np.array_equal(rasterizer.render(camera)[0], before)
        with Rasterizer(device, replace(scene, sh=other)) as wanted:
            assert np.array_equal(wanted.render(camera)[0], after)
            assert not np.array_equal(before, after)
        with Rasterizer(device, kept.drawable(device, scene)) as rasterizer:
            assert np.array_equal(rasterizer.render(camera)[0], before)


def test_other_devices_keep_it_too(device):
    scene, camera = random_splats(300, seed=5), straight_camera()
    other = Device(device.info, family=device.family)
    with ResidentScene(device, scene) as kept:
        assert kept.found_on(device) is kept.drawable(device, scene)
        kept.bring_to(other)
        there = kept.found_on(other)
        assert isinstance(there, SceneBuffers)
        assert kept.found_on(other) is there
        with Rasterizer(other, there) as moved, Rasterizer(device, scene) as wanted:
            assert np.array_equal(moved.render(camera)[0], wanted.render(camera)[0])
    assert other.allocated == 0
    # A device without the room is given the host's.
    small = Device(replace(device.info, memory=2 * scene.nbytes), family=device.family)
    with ResidentScene(device, scene) as kept:
        assert kept.found_on(small) is scene
        assert small.allocated == 0


@pytest.mark.one_family
@pytest.mark.parametrize("count", [1, 2])
def test_an_encode_uploads_its_scene_once(device, plush_excerpt, plush_excerpt_cameras, uploads, count):
    """A second device has it from the first."""
    devices = [device, Device(device.info, family=device.family)][:count]
    with HostPool(devices) as pool:
        pool = pool if count > 1 else None
        encode(plush_excerpt, plush_excerpt_cameras[:6], OPTIONS, device=device, pool=pool)
    assert sum(sh is plush_excerpt.sh for sh in uploads) == 1
    assert [each.allocated for each in devices] == [0] * count


def test_a_part_of_what_is_kept_is_taken_on_the_device(device):
    scene, camera = random_splats(700, seed=6), straight_camera()
    numbers = np.flatnonzero(np.random.default_rng(7).random(700) < 0.4)
    other = Device(device.info, family=device.family)
    with ResidentScene(device, scene) as kept, Rasterizer(device, scene.subset(numbers)) as wanted:
        expected = wanted.render(camera)[0]
        for place in (device, other):
            with scene_on(place, ResidentSubset(kept, numbers)) as part:
                assert isinstance(part, SceneBuffers)
                with Rasterizer(place, part) as rasterizer:
                    assert np.array_equal(rasterizer.render(camera)[0], expected)
    assert other.allocated == 0


def test_without_what_no_view_sees_the_scene_is_still_uploaded_once(
    device, plush_excerpt, plush_excerpt_cameras, monkeypatch, uploads
):
    """Splats behind all cameras are set aside, and the others taken from what is kept."""
    means = plush_excerpt.means.copy()
    means[::10] += 1e4
    scene, cameras = replace(plush_excerpt, means=means), plush_excerpt_cameras[:6]
    options = OPTIONS.changed(refit=False, compact=False)
    found = encode(scene, cameras, options, device=device)
    assert found.unseen is not None
    assert found.unseen.splats > 0
    assert [len(sh) for sh in uploads] == [len(scene)]
    for name in ("_PART", "_PART_OF_HOST"):
        monkeypatch.setattr(resident, name, 1 << 40)
    assert encode(scene, cameras, options, device=device).data == found.data
    assert [len(sh) for sh in uploads[1:]] == [len(scene) - found.unseen.splats]


def test_pruning_copies_no_more_of_a_scene_than_is_left(device):
    """Splats that no view sees stay where they are, and those that are seen are gathered on the device."""
    scene = random_splats(30_000, degree=3, seed=9)
    scene.means[:] = scene.means * np.float32(0.1) + np.float32((0, 0, 4))
    scene.log_scales[:] -= 4
    scene.means[::20, 2] = -50  # behind the camera
    state = State.of(scene, [replace(straight_camera(), name=f"{k}") for k in range(2)])
    parameters = replace(HyperParameters.from_quality(0.1, "best"), delta_mse_max=1e-3)
    with ResidentScene(device, scene) as kept:
        bench = Workbench(parameters, device=device, kept=kept)
        Prune(iterations=2).run(state, bench)  # what is made once is made
        tracemalloc.start()
        try:
            left = Prune(iterations=2).run(state, bench)
            _, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert left.results.unseen.splats == 1500
    assert not left.scene.sh[np.isin(left.survivors, np.arange(0, 30_000, 20)), 1:].any()
    assert np.array_equal(left.scene.means, scene.means[left.survivors])
    assert len(left.scene) < 10_000
    assert most < 0.8 * scene.nbytes


def test_another_device_gets_the_same_bits(device):
    scene, other = random_splats(3000, degree=3, seed=4), Device(device.info, family=device.family)
    with ResidentScene(device, scene, others=[other]) as kept:
        assert other.allocated or kept.bring_to(other).result()  # it has begun, or is done
        first, second = kept.found_on(device), kept.bring_to(other).result()
        assert isinstance(first, SceneBuffers)
        assert second is not None
        for name in ("means", "scales", "quaternions", "log2_opacities", "sh"):
            size = getattr(first, name).size
            both = [
                where.download(getattr(its, name), (size,), np.uint8)
                for where, its in ((device, first), (other, second))
            ]
            assert np.array_equal(*both), name
    assert other.allocated == 0
