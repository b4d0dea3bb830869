"""Pictures that a CPU draws as pruning first looks at its views: the same bits as later, each of them once."""

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
from potr_cl.stages.pruning.sweep import SweepOptions
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
        removal.measure_on_device()
        given = pictures.before(RenderedTargets(rasterizer, views), views)
        buffer = memory.allocate(3 * size, "pictures")
        wanted = np.stack([rasterizer.render(view)[0] for view in views])
        for told in ([2], [2, 0, 1, 2]):
            given.into([0, 1, 2], buffer)
            assert np.array_equal(cpu.download(buffer, wanted.shape, np.float32), wanted)
            assert rendered == told


@pytest.mark.parametrize(("splats", "logit"), [(3000, 2.0), (9000, -3.0)])
def test_they_are_the_rasterizers_where_lists_are_long(cpu, splats, logit):
    """Their pixels end before those of pruning: early, or segments later in a tile's list."""
    scene = visible_scene(splats)
    scene = dataclasses.replace(scene, opacity_logits=scene.opacity_logits + np.float32(logit))
    with (
        Rasterizer(cpu, scene, background=BACKGROUND) as rasterizer,
        Memory(cpu) as memory,
        PicturesInPassing.wanted(cpu, CAMERAS) as pictures,
        RemovalSweep(rasterizer, CAMERAS, pictures=pictures) as removal,
    ):
        removal.measure_on_device()
        buffer = memory.allocate(target_bytes(CAMERAS[0]), "a picture")
        for view in CAMERAS:
            wanted, _ = rasterizer.render(view)
            assert pictures.give(view, buffer, 0)
            assert np.array_equal(cpu.download(buffer, wanted.shape, np.float32), wanted)


def test_they_are_not_drawn_where_pruning_ends_pixels_earlier(cpu):
    with (
        Rasterizer(cpu, SCENE) as rasterizer,
        PicturesInPassing.wanted(cpu, CAMERAS) as pictures,
        RemovalSweep(rasterizer, CAMERAS, SweepOptions(transmittance_threshold=1e-3), pictures=pictures) as removal,
        Memory(cpu) as memory,
    ):
        removal.measure_on_device()
        assert not pictures.give(CAMERAS[0], memory.allocate(target_bytes(CAMERAS[0]), "a picture"), 0)


def test_a_view_that_counts_twice_has_one(cpu):
    views = [CAMERAS[0], CAMERAS[1], CAMERAS[0]]
    with (
        Rasterizer(cpu, SCENE) as rasterizer,
        PicturesInPassing.wanted(cpu, views) as pictures,
        RemovalSweep(rasterizer, views, pictures=pictures) as removal,
        Memory(cpu) as memory,
    ):
        removal.measure_on_device()
        buffer = memory.allocate(target_bytes(CAMERAS[0]), "a picture")
        assert [pictures.give(view, buffer, 0) for view in views] == [True, True, False]


def test_pruning_goes_on_once_they_are_given(cpu):
    totals = []
    for drawn in (True, False):
        with (
            Rasterizer(cpu, SCENE) as rasterizer,
            PicturesInPassing.wanted(cpu, CAMERAS) as pictures,
            RemovalSweep(rasterizer, CAMERAS, pictures=pictures if drawn else None) as removal,
            Memory(cpu) as memory,
        ):
            removal.measure_on_device()
            buffer = memory.allocate(target_bytes(CAMERAS[0]), "a picture")
            assert all(pictures.give(view, buffer, 0) == drawn for view in CAMERAS)
            removal.remove(np.arange(10))
            totals.append(removal.measure_totals())
    assert np.array_equal(*totals)


def test_views_that_do_not_stay_have_none(cpu):
    """There is room for the pictures of all before it is known which views stay."""
    scene = visible_scene(3000)
    with Rasterizer(cpu, scene) as rasterizer:
        with rasterizer.prepare_set(CAMERAS[:1]) as views:
            room = int(2.5 * views.nbytes)
        with (
            PicturesInPassing.wanted(cpu, CAMERAS) as pictures,
            RemovalSweep(rasterizer, CAMERAS, SweepOptions(memory=room), pictures=pictures) as removal,
            Memory(cpu) as memory,
        ):
            assert 0 < removal.ready_views < len(CAMERAS)
            removal.measure_on_device()
            buffer = memory.allocate(target_bytes(CAMERAS[0]), "a picture")
            given = [view for view in CAMERAS if pictures.give(view, buffer, 0)]
            assert len(given) == removal.ready_views
            wanted, _ = rasterizer.render(given[-1])
            assert np.array_equal(cpu.download(buffer, wanted.shape, np.float32), wanted)


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
    monkeypatch.setattr(PicturesInPassing, "room_for", lambda self, *args: taken.append(args))
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
                assert (pictures.room_for(prepared) is None) == (view is there)
        pictures.are_drawn(views)
        buffer = memory.allocate(target_bytes(there), "a picture")
        assert [pictures.give(view, buffer, 0) for view in views] == [True] * 3 + [False]
