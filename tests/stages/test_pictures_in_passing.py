"""Pictures that a CPU renders while pruning prepares its views: the same bits as later, each of them once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl import EncodeOptions
from potr_cl.errors import DeviceError
from potr_cl.model.camera import train_views
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages import prune, refit
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.views import targets
from potr_cl.views.targets import PicturesInPassing, RenderedTargets, target_bytes
from tests.devices import shared_device
from tests.reference.scenes import ring_of_cameras, visible_scene
from tests.reference.surfaces import together

SCENE, CAMERAS = visible_scene(60), ring_of_cameras(4, size=40)
BACKGROUND = (0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def cpu():
    device = shared_device("cpu")
    yield device
    assert device.allocated == 0


@pytest.fixture
def rendered(monkeypatch):
    """Numbers of the views that are rendered when somebody asks."""
    found, into = list[int](), RenderedTargets.into

    def noted(self, numbers, *args):
        found.extend(numbers)
        into(self, numbers, *args)

    monkeypatch.setattr(RenderedTargets, "into", noted)
    return found


def test_they_are_given_once(cpu, rendered):
    views = [CAMERAS[0], CAMERAS[2], CAMERAS[3]]
    size = target_bytes(CAMERAS[0])
    with (
        Rasterizer(cpu, SCENE, background=BACKGROUND) as rasterizer,
        Memory(cpu) as memory,
        PicturesInPassing.wanted(cpu, views[:2]) as pictures,
        RemovalSweep(rasterizer, CAMERAS, pictures=pictures) as removal,
    ):
        given = pictures.before(RenderedTargets(rasterizer, views), views)
        buffer = memory.allocate(3 * size, "pictures")
        wanted = np.stack([rasterizer.render(view)[0] for view in views])
        for told in ([2], [2, 0, 1, 2]):
            given.into([0, 1, 2], buffer)
            assert np.array_equal(cpu.download(buffer, wanted.shape, np.float32), wanted)
            assert rendered == told
        removal.measure_on_device()


def test_a_gpu_and_a_cpu_with_little_memory_take_none(cpu, monkeypatch):
    assert PicturesInPassing.wanted(shared_device("gpu"), CAMERAS) is None
    monkeypatch.setattr(cpu, "info", dataclasses.replace(cpu.info, memory=20 * target_bytes(CAMERAS[0])))
    assert PicturesInPassing.wanted(cpu, CAMERAS[:1]) is not None
    assert PicturesInPassing.wanted(cpu, CAMERAS) is None


@pytest.mark.parametrize(("preset", "more"), [("best", {}), ("smallest", {"fit": {"steps": 4, "compared": False}})])
def test_an_encode_takes_them_and_the_bytes_stay(cpu, monkeypatch, rendered, plush_excerpt, small_views, preset, more):
    """Of a scene with splats that no given view sees."""
    beyond = plush_excerpt.subset(np.arange(0, len(plush_excerpt), 10))
    scene = together(plush_excerpt, dataclasses.replace(beyond, means=beyond.means + np.float32(30)))
    options = EncodeOptions.for_preset(preset, prune={"iterations": 2}, refit={"steps": 2}, **more)
    made = encode(scene, small_views, options, device=cpu)
    fewer = len(rendered)
    monkeypatch.setattr(targets, "AHEAD", 0.0)
    rendered.clear()
    assert encode(scene, small_views, options, device=cpu).data == made.data
    assert len(rendered) - fewer == len(train_views(small_views)) + made.between.added
    monkeypatch.setattr(targets, "AHEAD", 1.0)
    taken = []
    monkeypatch.setattr(PicturesInPassing, "take", lambda self, *args: taken.append(args))
    encode(scene, small_views, options.changed(memory=1 << 26), device=cpu)
    encode(scene, small_views, options.changed(refit=False, fit=False), device=cpu)
    assert not taken


@pytest.mark.parametrize(("module", "name"), [(prune, "prune_scene"), (refit, "refit_colours")])
def test_they_are_given_back_if_pruning_or_a_later_stage_fails(
    cpu, monkeypatch, plush_excerpt, small_views, module, name
):
    def failing(*args, **more):
        assert cpu.allocated
        raise DeviceError("it failed")

    monkeypatch.setattr(module, name, failing)
    with pytest.raises(DeviceError, match="it failed"):
        encode(plush_excerpt, small_views, EncodeOptions.for_preset("fast", prune={"iterations": 1}), device=cpu)
    assert cpu.allocated == 0


def test_none_is_taken_of_views_that_show_what_pruning_has_not_got(cpu):
    """Splats that no given view sees are not there when it prepares views; those between may show them."""
    away = dataclasses.replace(SCENE, means=SCENE.means + np.float32([0, 0, 40]))
    centre = CAMERAS[0].centre
    there = dataclasses.replace(CAMERAS[0], translation=-CAMERAS[0].rotation @ (centre + np.array([0, 0, 40])))
    views = [*CAMERAS[:3], there]
    with (
        Rasterizer(cpu, SCENE) as rasterizer,
        PicturesInPassing.wanted(cpu, views) as pictures,
        Memory(cpu) as memory,
    ):
        pictures.leave_out(away)
        for view in views:
            with rasterizer.prepare_set([view]) as prepared:
                pictures.take(rasterizer, prepared)
        buffer = memory.allocate(target_bytes(there), "a picture")
        assert [pictures.give(view, buffer, 0) for view in views] == [True] * 3 + [False]
