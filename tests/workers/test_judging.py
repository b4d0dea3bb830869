"""Judging shared out gives the figures of one device, bit for bit, whoever is lost on the way."""

from __future__ import annotations

import dataclasses
import threading
from collections import Counter

import numpy as np
import pytest

import potr_cl
from potr_cl.errors import DeviceError
from potr_cl.formats.images import write_png
from potr_cl.model import splat_groups
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.outputs.output import CodedScene
from potr_cl.outputs.potr import Potr
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.evaluator import EvaluationViews, Evaluator, judge_by_photographs
from potr_cl.quality.judging import JudgingPart
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster import resident
from potr_cl.raster.rasterizer import Rasterizer, render
from potr_cl.raster.resident import ResidentScene
from potr_cl.raster.scene_buffers import SceneBuffers, uploaded
from potr_cl.views import pictures, visibility
from potr_cl.views.pictures import SeenRasterizer, rasterizer_of
from potr_cl.workers.host import HostPool
from tests.cases.cameras import small
from tests.cases.elsewhere import ElsewherePool
from tests.cases.streets import street
from tests.devices import open_device

OPTIONS = EncodeOptions.for_preset("best", q=0.3, prune={"iterations": 2}, refit={"steps": 1}, between=False)
BACKGROUND = (0.1, 0.2, 0.3)


@pytest.fixture(scope="module")
def cameras(plush_excerpt_cameras):
    """Eleven views, small, five of which are held out."""
    return [
        dataclasses.replace(small(camera), split="test" if number % 2 else "train")
        for number, camera in enumerate(plush_excerpt_cameras[:11])
    ]


@pytest.fixture(scope="module")
def coded(plush_excerpt):
    """A file that has lost something."""
    options = OPTIONS.changed(prune=False, refit=False, compact=False)
    return CodedScene(Potr(), encode(plush_excerpt, None, options).data)


def judged(device, scene, coded, views, pool=None):
    with Evaluator(device, scene, views, BACKGROUND, pool, remember=False) as evaluator, coded.on(device) as candidate:
        told = []
        comparison, beside = evaluator.judge(candidate, lambda _, done: told.append(done), coded)
    assert told == sorted(told)
    assert told[-1] == 1
    return comparison, beside


@pytest.fixture(scope="module")
def alone(family, plush_excerpt, cameras, coded):
    """The figures of one device."""
    return judged(open_device(family), plush_excerpt, coded, EvaluationViews.of(cameras))


@pytest.fixture
def done(monkeypatch):
    """How many views each device has judged."""
    counts, figures = Counter(), JudgingPart.figures

    def noted(self, numbers, *told):
        counts[self._device] += len(numbers)
        return figures(self, numbers, *told)

    monkeypatch.setattr(JudgingPart, "figures", noted)
    return counts


@pytest.mark.parametrize("kind", [HostPool, ElsewherePool])
def test_the_same_figures(plush_excerpt, cameras, coded, alone, family, kind, done):
    views, expected = EvaluationViews.of(cameras), alone
    assert len(views.views) == 5
    assert len(views.beside) == 4
    assert 20 < expected[1] < 90
    devices = [open_device(family) for _ in range(3)]
    with kind(devices) as pool:
        assert judged(devices[0], plush_excerpt, coded, views, pool) == expected
        others = [done[device] for device in devices[1:]]
        assert min(others) >= 3
        assert sum(others) == (6 if pool.in_process else 9)
        assert pool.traffic.sent > 0
    assert [device.allocated for device in devices] == [0] * 3


@pytest.mark.one_family
def test_a_scene_that_is_kept_is_not_sent_again(plush_excerpt, cameras, coded, alone, family, monkeypatch):
    views, expected = EvaluationViews.of(cameras), alone
    devices = [open_device(family) for _ in range(2)]
    with HostPool(devices) as pool, ResidentScene(devices[0], plush_excerpt) as kept:
        for device in devices:
            assert isinstance(kept.found_on(device), SceneBuffers)
        monkeypatch.setattr("potr_cl.raster.rasterizer.uploaded", None)
        assert judged(devices[0], kept, coded, views, pool) == expected
    assert [device.allocated for device in devices] == [0] * 2


@pytest.mark.slow
@pytest.mark.one_family
def test_a_candidate_of_the_host_is_judged_too(plush_excerpt, cameras, coded, family):
    """As files are whose readers make no scene on a device; and pictures are remembered from one to the next."""
    views, worse = EvaluationViews.of(cameras), coded.output.read(coded.data)
    device = open_device(family)
    with Evaluator(device, plush_excerpt, views, BACKGROUND) as alone:
        expected = alone.psnr(worse), alone.psnr(plush_excerpt), alone.psnr(worse, most=3)
    assert expected[1] == np.inf
    for kind in (HostPool, ElsewherePool):
        devices = [open_device(family) for _ in range(2)]
        with kind(devices) as pool, Evaluator(devices[0], plush_excerpt, views, BACKGROUND, pool) as together:
            assert (together.psnr(worse), together.psnr(plush_excerpt), together.psnr(worse, most=3)) == expected
        assert [device.allocated for device in devices] == [0] * 2


@pytest.mark.one_family
def test_views_of_the_same_name(plush_excerpt, cameras, coded, family):
    """As cameras made in Python may have it."""
    alike = [dataclasses.replace(camera, name="view", split="test") for camera in cameras[:3]]
    device, another = open_device(family), open_device(family)
    settings = {"background": BACKGROUND}
    expected = [potr_cl.compare(plush_excerpt, coded.data, [c], device=device, **settings).psnr for c in alike]
    assert len(set(expected)) == 3
    for devices in (device, [device, another]):
        found = potr_cl.compare(plush_excerpt, coded.data, alike, device=devices, **settings)
        assert [view.figures["b_against_a"].psnr for view in found.figures.views] == expected
    with Evaluator(device, plush_excerpt, EvaluationViews.of(alike), BACKGROUND) as remembering:
        for _ in range(2):
            with coded.on(device) as candidate:
                assert remembering.psnr(candidate) == pytest.approx(np.mean(expected))
    assert [device.allocated, another.allocated] == [0, 0]


@pytest.mark.slow
@pytest.mark.one_family
@pytest.mark.parametrize(
    ("kind", "command", "lost"),
    [
        (HostPool, "__init__", "one"),
        (ElsewherePool, "take", "one"),
        (ElsewherePool, "__init__", "all"),
        (ElsewherePool, "figures", "all"),
    ],
)
def test_a_worker_that_is_lost(plush_excerpt, cameras, coded, alone, family, kind, command, lost, monkeypatch, caplog):
    views, expected = EvaluationViews.of(cameras), alone
    devices = [open_device(family) for _ in range(3)]
    real = getattr(JudgingPart, command)

    def failing(self, *args):
        device = args[0] if command == "__init__" else self._device
        others = threading.current_thread() is not threading.main_thread()
        if device is devices[1] or (lost == "all" and others):
            raise DeviceError("the device failed")
        return real(self, *args)

    monkeypatch.setattr(JudgingPart, command, failing)
    with kind(devices) as pool:
        assert judged(devices[0], plush_excerpt, coded, views, pool) == expected
    assert ("no worker can judge" in caplog.text) == (lost == "all")
    assert "reassigning its views to" in caplog.text
    assert [device.allocated for device in devices] == [0] * 3


def test_a_large_scene_is_not_sent_to_be_judged(plush_excerpt, cameras, coded, monkeypatch):
    views = EvaluationViews.of(cameras)
    devices = [open_device("cpu") for _ in range(2)]
    expected = judged(devices[0], plush_excerpt, coded, views)
    monkeypatch.setattr("potr_cl.quality.judging._SENT_ANYWAY", plush_excerpt.nbytes - 1)
    with ElsewherePool(devices) as pool:
        assert judged(devices[0], plush_excerpt, coded, views, pool) == expected
        assert pool.scenes == pool.traffic.sent == 0
        monkeypatch.setattr(pool, "has", lambda thing: thing is plush_excerpt)
        assert judged(devices[0], plush_excerpt, coded, views, pool) == expected
        assert len(coded.data) <= pool.traffic.sent < 2 * len(coded.data) + 1000


@pytest.mark.slow
def test_a_search_for_a_psnr_judges_together(plush_excerpt, cameras, done):
    options = EncodeOptions.for_preset("best", prune={"iterations": 2}, refit={"steps": 1}, between=False)
    devices = [open_device("cpu") for _ in range(2)]
    alone = potr_cl.encode(plush_excerpt, cameras, options, device=devices[0], min_psnr=32)
    done.clear()
    together = potr_cl.encode(plush_excerpt, cameras, options, device=devices, min_psnr=32)
    assert together.data == alone.data
    assert together.shared is not None
    assert set(done) == set(devices)
    assert [device.allocated for device in devices] == [0] * 2


@pytest.mark.one_family
def test_photographs_are_judged_by_together(plush_excerpt, cameras, coded, tmp_path, family):
    for camera in cameras[1:4]:
        with (tmp_path / f"{camera.name}.png").open("wb") as file:
            write_png(file, np.clip(255 * render(plush_excerpt, camera)[0], 0, 255).astype(np.uint8))
    truth = GroundTruth(tmp_path, cameras)
    device = open_device(family)
    with coded.on(device) as candidate:
        expected = judge_by_photographs(truth, cameras, (plush_excerpt, candidate), device)
    assert expected.views == [cameras[1].name, cameras[3].name]
    assert min(expected.uncompressed) > 55 > max(expected.file)
    devices = [open_device(family) for _ in range(2)]
    for kind in (HostPool, ElsewherePool):
        with kind(devices) as pool, coded.on(devices[0]) as candidate:
            assert judge_by_photographs(truth, cameras, (plush_excerpt, candidate), devices[0], pool=pool) == expected
    alone, together = (
        potr_cl.compare(plush_excerpt, coded.data, cameras, truth=tmp_path, device=some) for some in (device, devices)
    )
    assert "b_against_truth" in alone.worst.figures
    assert together.figures == alone.figures
    assert [device.allocated for device in devices] == [0] * 2


@pytest.fixture(scope="module")
def large(family):
    """A street, its views, a file of it, and how one device judges that as a whole."""
    scene, cameras = street(5, 250, across=True)
    cameras = [dataclasses.replace(c, split="test" if k % 2 else "train") for k, c in enumerate(cameras)]
    coded = CodedScene(Potr(), encode(scene, None, OPTIONS.changed(prune=False, refit=False, compact=False)).data)
    views = EvaluationViews.of(cameras)
    return scene, cameras, views, coded, judged(open_device(family), scene, coded, views)


@pytest.fixture
def projected(large, monkeypatch):
    """The numbers of splats that rasterizers are made of, where scenes count as large, and devices as small."""
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(pictures, "_PART", 0)
    monkeypatch.setattr(visibility, "_SAMPLED", 2)
    noted, made = [], Rasterizer.__init__

    def noting(self, device, scene, *args, **named):
        noted.append(len(scene))
        made(self, device, scene, *args, **named)

    monkeypatch.setattr(Rasterizer, "__init__", noting)
    return noted


@pytest.mark.slow
@pytest.mark.one_family
def test_views_of_a_large_scene_are_judged_by_what_they_see(family, large, projected, monkeypatch):
    scene, _, views, coded, expected = large
    devices = [open_device(family) for _ in range(2)]
    assert judged(devices[0], scene, coded, views) == expected
    # Each view once, of the uncompressed scene; the candidate is projected whole.
    assert len(projected) == len(views.views) + len(views.beside) + 1
    assert np.mean(sorted(projected)[:-1]) < 0.4 * len(scene)
    with HostPool(devices) as pool:
        assert judged(devices[0], scene, coded, views, pool) == expected
        with ResidentScene(devices[0], scene, memory=0) as kept:
            kept.groups = SplatGroups.of(scene)
            monkeypatch.setattr(visibility, "LEAST_SPLATS", 1 << 30)
            assert judged(devices[0], kept, coded, views, pool) == expected
            assert devices[0].allocated == 0
    assert [device.allocated for device in devices] == [0] * 2


def test_with_little_memory_a_decoded_file_is_judged_by_what_views_see_too(family, large, projected):
    """On a CPU, whose memory is the host's: neither scene lies whole on the device."""
    scene, _, views, coded, expected = large
    device = open_device(family)
    with (
        ResidentScene(device, scene, memory=scene.nbytes) as kept,
        Potr().seen(coded.data, device, memory=scene.nbytes) as candidate,
        Evaluator(device, kept, views, BACKGROUND) as evaluator,
    ):
        if device.info.kind != "cpu":
            assert isinstance(candidate, SceneBuffers)
            return
        assert device.allocated == 0
        assert evaluator.judge(candidate, lambda _what, _done: None) == expected
        assert len(projected) == 2 * (len(views.views) + len(views.beside))
        assert np.mean(projected) < 0.4 * len(scene)


@pytest.mark.slow
@pytest.mark.usefixtures("projected")
@pytest.mark.one_family
def test_an_encode_leaves_the_groups_that_it_has_found(family, large):
    scene, cameras, *_ = large
    device = open_device(family)
    with ResidentScene(device, scene) as kept:
        encode(scene, cameras, dataclasses.replace(OPTIONS, cameras_anyway=True), device=device, kept=kept)
        assert kept.groups is not None
        assert len(kept.groups.group_of) == len(scene)


@pytest.mark.usefixtures("projected")
@pytest.mark.parametrize(("where", "rules"), [("host", "inria"), ("device", "gsplat")])
def test_pictures_of_what_views_see(family, large, where, rules):
    """Of the host's scene and of one that lies on the device, one view and several, one of which sees nothing."""
    scene, cameras, *_ = large
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + np.array([0, 0, -500.0]))
    device, rules = open_device(family), potr_cl.raster.rules.RULES[rules]
    groups = SplatGroups.of(scene)
    assert not groups.visible(away, rules.near).any()
    drawable = uploaded(device, scene) if where == "device" else scene
    with (
        Rasterizer(device, scene, rules, BACKGROUND) as whole,
        rasterizer_of(device, drawable, rules, BACKGROUND, groups) as some,
    ):
        assert isinstance(some, SeenRasterizer)
        for camera in (*cameras[:4], away):
            for wanted, got in zip(whole.render(camera), some.render(camera), strict=True):
                assert np.array_equal(wanted, got)
        chosen = [*cameras[3:6], away]
        pixels = sum(3 * camera.width * camera.height for camera in chosen)
        buffers = [device.allocate(4 * pixels, "pictures") for _ in range(2)]
        for rasterizer, buffer in zip((whole, some), buffers, strict=True):
            rasterizer.render_into(chosen, buffer)
        wanted, got = (device.download(buffer, (pixels,), np.float32) for buffer in buffers)
        assert np.array_equal(wanted, got)
        assert wanted.std() > 0.02
        for buffer in buffers:
            device.free(buffer)
    if isinstance(drawable, SceneBuffers):
        drawable.close()
    assert device.allocated == 0


@pytest.mark.one_family
def test_scenes_are_compared_together(plush_excerpt, cameras, coded, family, done):
    """Scenes of the host and scenes of files."""
    devices = [open_device(family) for _ in range(2)]
    worse = coded.output.read(coded.data)
    expected = potr_cl.compare(plush_excerpt, coded.data, cameras, device=devices[0])
    done.clear()
    for a, b in ((plush_excerpt, coded.data), (plush_excerpt, worse)):
        found = potr_cl.compare(a, b, cameras, device=devices)
        assert found.figures == expected.figures
        assert found.worst == expected.worst
    assert done[devices[1]] == 2 * 2
    assert potr_cl.compare(coded.data, plush_excerpt, cameras, device=devices).psnr == expected.psnr
    assert [device.allocated for device in devices] == [0] * 2


@pytest.mark.slow
def test_a_ladder_keeps_the_scene_on_the_devices(plush_excerpt, cameras, tmp_path, monkeypatch):
    options = EncodeOptions.for_preset("fast", prune={"iterations": 2}, between=False)
    expected = potr_cl.encode_ladder(plush_excerpt, tmp_path / "alone", "0.2,0.4", cameras, options)
    sent = []
    for how in ("uploaded", "copied"):  # to the first device, and from there to the other one
        bring = getattr(resident, how)
        monkeypatch.setattr(
            resident, how, lambda device, scene, bring=bring: sent.append(device) or bring(device, scene)
        )
    devices = [open_device("cpu") for _ in range(2)]
    found = potr_cl.encode_ladder(plush_excerpt, tmp_path / "together", "0.2,0.4", cameras, options, device=devices)
    assert found.rungs == expected.rungs
    assert set(sent) == set(devices)
    assert len(sent) == 2
    assert [device.allocated for device in devices] == [0] * 2
