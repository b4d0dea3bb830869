"""Pictures that a CPU renders while pruning prepares its views: the same bits as later, each of them once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl import EncodeOptions
from potr_cl.errors import DeviceError
from potr_cl.model.camera import train_views
from potr_cl.model.splat_groups import unseen_splats
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages import refit
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.views import targets
from potr_cl.views.targets import PicturesInPassing, RenderedTargets, target_bytes
from tests.devices import shared_device
from tests.reference.scenes import plain_splats, ring_of_cameras, straight_camera, visible_scene
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


def test_they_are_given_back_if_a_later_stage_fails(cpu, monkeypatch, plush_excerpt, small_views):
    def failing(*args, **more):
        assert cpu.allocated
        raise DeviceError("it failed")

    monkeypatch.setattr(refit, "refit_colours", failing)
    with pytest.raises(DeviceError, match="it failed"):
        encode(plush_excerpt, small_views, EncodeOptions.for_preset("fast", prune={"iterations": 1}), device=cpu)
    assert cpu.allocated == 0


def beside(views, splats, seed=0):
    """Large splats that wide views do not see, though their ellipses reach into some of these."""
    rng = np.random.default_rng(seed)
    depths = rng.uniform(0.6, 4, splats)
    means = rng.uniform(-4, 4, (splats, 3)) * depths[:, None]
    means[:, 2] = depths
    scene = plain_splats(means, rng.uniform(0.3, 1.5, (splats, 1)), 3.0, rng.uniform(0, 1, (splats, 3)))
    return scene.subset(np.flatnonzero(unseen_splats(scene, views)))


def test_none_is_taken_of_views_that_show_what_pruning_has_not_got(cpu, monkeypatch, rendered):
    """Splats that no given view sees are not there when it prepares views, but later they are drawn."""
    rng = np.random.default_rng(1)
    ahead = straight_camera(64, 64, 24.0)
    views = [dataclasses.replace(ahead, name=str(k), translation=np.array([0.02 * k, 0, 0])) for k in range(4)]
    depths = rng.uniform(1, 4, 3000)
    means = np.stack([*(rng.uniform(-1, 1, (2, 3000)) * depths), depths], axis=1)
    seen = plain_splats(means, 0.03, 1.0, rng.uniform(0, 1, (3000, 3)))
    hidden = beside(views, 600)
    scene = together(seen, hidden.subset(np.arange(min(len(hidden), 300))))
    assert len(scene) > 3050
    options = EncodeOptions.for_preset("best", prune={"iterations": 2}, refit={"steps": 2}, between={"views": 0.0})
    made = encode(scene, views, options, device=cpu, in_frame=True)
    assert rendered
    monkeypatch.setattr(targets, "AHEAD", 0.0)
    assert encode(scene, views, options, device=cpu, in_frame=True).data == made.data
    monkeypatch.setattr(targets, "AHEAD", 1.0)
    monkeypatch.setattr(PicturesInPassing, "leave_out", lambda *args: None)
    assert encode(scene, views, options, device=cpu, in_frame=True).data != made.data
