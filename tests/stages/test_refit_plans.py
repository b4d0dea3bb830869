"""A re-fit finds the same bits wherever its vectors lie, whichever splats its views have, and whoever does them."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.picked_splats import IndexSubset
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages import refit as refit_stage
from potr_cl.stages.refitting import coefficients, colour_map, exchange, helpers, own_views
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views import reached
from potr_cl.views.reached import reached_splats
from potr_cl.views.shares import HelpFrom
from potr_cl.views.subsets import ListedSplats
from potr_cl.workers.host import HostPool
from tests.cases.elsewhere import ElsewherePool
from tests.cases.memory import taken_of
from tests.cases.noting import noted
from tests.cases.streets import street
from tests.devices import another_like
from tests.reference.refit_cases import Case, Linearised, Pictures
from tests.reference.rounding import grid_of
from tests.reference.scenes import ring_of_cameras, visible_scene

#: Slices of 256 splats, the fewest that there can be.
SLICES = 256


#: Of a slice of vectors on the host, and how many vectors lie on the device even so; whether views have only the splats
#: that they reach; bytes for views; who share the views out, and whether these know nothing but what they are sent, and
#: the master does no views.
PLANS = {
    "slices": {"slices": SLICES, "resident": 0},
    "slices, three vectors on the device": {"slices": SLICES, "resident": 3},
    "slices, all vectors on the device, no view kept": {"slices": SLICES, "resident": 7, "memory": 0},
    "own splats, some views kept": {"picked": True, "memory": 200_000},
    "own splats, slices": {"picked": True, "slices": SLICES},
    "two devices": {"workers": 2},
    "two devices, own splats": {"workers": 2, "picked": True},
    "a cluster of three": {"workers": 4, "elsewhere": True},
    "a cluster of three, own splats, no view kept": {"workers": 4, "elsewhere": True, "picked": True, "memory": 0},
    "two devices, slices": {"workers": 2, "slices": SLICES, "resident": 0},
    "three devices, own splats, slices": {"workers": 3, "picked": True, "slices": SLICES, "resident": 3},
}
#: What becomes of the solution: left as it is, rounded in rounds, or by somebody who asks what coefficients are worth.
WAYS = ("solve", "colour_grid", "fix_ac")


@pytest.fixture
def picked(monkeypatch):
    """Have views pick their splats, and note which views did."""
    made = noted(monkeypatch, own_views, "ListedSplats")

    def switch(on: bool) -> list[ListedSplats]:
        monkeypatch.setattr(reached, "LEAST_SPLATS", 1 if on else 1 << 60)
        monkeypatch.setattr(reached, "WORTH_IT", 1.0)
        made.clear()
        return made

    return switch


def crowded(splats: int = 200, degree: int = 1, houses: int = 4):
    """A street of which some splats stand behind others that nothing is seen through; views of two sizes."""
    scene, cameras = street(houses, splats)
    logits = np.where(np.arange(len(scene)) % 2, 6, -1).astype(np.float32)
    rng = np.random.default_rng(3)
    sh = rng.normal(0, 0.3, (len(scene), (degree + 1) ** 2, 3)).astype(np.float32)
    cameras[1] = dataclasses.replace(cameras[1], width=50, height=90)
    return dataclasses.replace(scene, log_scales=scene.log_scales + 0.5, opacity_logits=logits, sh=sh), cameras


def crowded_case(device, degree: int = 1, **size: int):
    scene, cameras = crowded(degree=degree, **size)
    other = dataclasses.replace(scene, sh=scene.sh[::-1].copy())
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + 1000)
    return Case(device, scene, other, [*cameras, away], background=(0.2, 0.1, 0.0))


def case_of(device, degree: int, count: int, seed: int = 0) -> Case:
    scene, other = visible_scene(count, degree, seed), visible_scene(200, 2, seed + 7)
    return Case(device, scene, other, ring_of_cameras(3, size=40))


def same(one, other) -> bool:
    return np.array_equal(one.sh, other.sh) and one.errors == other.errors and one.steps == other.steps


def coarse(sh, refit):
    return np.concatenate([sh[:, :1], np.round(sh[:, 1:] * 10 + refit.worth()[:, 1:, None]) / 10], axis=1)


def fitted(device, way: str, slices=None, memory=None, workers=1, elsewhere=False):
    """By some of the pixels."""
    case = crowded_case(device)
    grid, other = grid_of(len(case.scene)), dataclasses.replace(case.scene, sh=case.scene.sh[::-1].copy())
    rounding = {"solve": {}, "colour_grid": {"colour_grid": lambda effects: grid}, "fix_ac": {"fix_ac": coarse}}[way]
    options = RefitOptions(steps=4, gain=0, drop=1e-7, selection_lam=0.3, slices=slices, memory=memory)
    active = np.random.default_rng(1).random(case.scene.sh.shape) < 0.8
    with case, ExitStack() as stack:
        help_from = None
        if workers > 1:
            devices = [device, *(another_like(device, number) for number in range(1, workers))]
            help_from = HelpFrom(stack.enter_context((ElsewherePool if elsewhere else HostPool)(devices)), other)
        return refit_colours(
            device, case.scene, case.cameras, case.targets, options, active, case.background,
            help_from=help_from, **rounding,
        )  # fmt: skip


@pytest.fixture(scope="module")
def plain(device):
    """Solutions with everything on one device, and all splats in each view."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(colour_map, "ENOUGH", 4)
        return {way: fitted(device, way) for way in WAYS}


#: Each plan with one of them; slices, own splats, devices and a cluster with two at least.
TOGETHER = [(name, WAYS[place % 3]) for place, name in enumerate(PLANS)]
SLOW = [("two devices", "solve"), ("a cluster of three", "fix_ac")]


@pytest.mark.parametrize(
    ("plan", "way"),
    [*TOGETHER, *(pytest.param(*both, marks=[pytest.mark.slow, pytest.mark.one_family]) for both in SLOW)],
)
def test_the_same_solution(device, plain, picked, plan, way, monkeypatch):
    plan = dict(PLANS[plan])
    on = plan.pop("picked", False)
    monkeypatch.setattr(colour_map, "ENOUGH", 4)
    monkeypatch.setattr(exchange, "_WORTH_IT", 1.0)
    monkeypatch.setattr(coefficients, "_FEWEST", plan.pop("resident", 1))
    made, rows = picked(on), noted(monkeypatch, helpers, "DrawnRows")
    found = fitted(device, way, **plan)
    assert bool(rows) == bool(plan.get("elsewhere")), "workers elsewhere get the coefficients that they draw"
    assert bool(made) == on
    assert same(found, plain[way])
    assert found.steps > 3


@pytest.mark.parametrize(("degree", "count"), [(0, 700), (2, 257), (3, 300), (1, 1), (1, 256)])
def test_slices_change_no_bit(device, degree, count):
    """Nor any of what is known of coefficients; in the dark scene of degree 3 coefficients are chosen twice."""
    options, found, known = RefitOptions(steps=4, gain=0.0, drop=1e-9, prior=0), [], []
    with case_of(device, degree, count, seed=degree) as case:
        case.scene.sh[:, 0] -= 5 if degree == 3 else 0
        for slices in (None, SLICES):
            with ColourRefit(device, case.scene, case.cameras, slices=slices) as refit:
                found.append(refit.solve(case.scene.sh, case.targets, options))
                known.append([refit.worth(), refit.worth_of_constants(), refit.blocks(), refit.active()])
    assert same(*found)
    for whole, sliced in zip(*known, strict=True):
        assert np.array_equal(whole, sliced)


@pytest.mark.one_family
@pytest.mark.one_runtime
@pytest.mark.parametrize(
    ("kind", "on"),
    [
        pytest.param({"kind": "cpu"}, False, id="the host's memory"),
        pytest.param({"kind": "gpu", "integrated": False}, False, id="memory of its own"),
        pytest.param({"kind": "gpu", "integrated": False}, True, id="views with splats of their own"),
    ],
)
def test_little_memory_is_enough(device, picked, kind, on, monkeypatch):
    """Vectors that are too large for the memory that is given do not come to the device: most of them are not there."""
    monkeypatch.setattr(coefficients, "_ANYWAY", 0)
    monkeypatch.setattr(coefficients, "_LEAST_SLICE", 512)
    device = Device(dataclasses.replace(device.info, **kind), family=device.family)
    found = []
    with crowded_case(device, 3, splats=1500) as case:
        free, one_piece = device.allocated, 3400 * len(case.scene)
        for memory in (None, one_piece // 2):
            picked(on and memory is not None)
            with ColourRefit(device, case.scene, case.cameras, memory=memory) as refit:
                result = refit.solve(case.scene.sh, case.targets, RefitOptions(steps=1, gain=0, memory=memory))
                found.append((device.allocated - free, result))
    (whole, one), (sliced, other) = found
    assert same(one, other)
    assert sliced < 0.6 * one_piece < whole


@pytest.mark.one_runtime
def test_memory_is_that_of_vectors_and_views_together(device, monkeypatch):
    """Also where the vectors lie on the device."""
    monkeypatch.setattr(coefficients, "_ANYWAY", 0)
    count = 3000
    one_piece = 3400 * count
    with case_of(device, 3, count) as case:
        free, room = device.allocated, []
        for memory in (4 * one_piece, 12 * one_piece):
            with ColourRefit(device, case.scene, case.cameras, memory=memory) as refit:
                refit.solve(case.scene.sh, case.targets, RefitOptions(steps=1, gain=0))
                assert device.allocated - free < memory
                room.append(refit.colour_map.own.room)
    assert room[1] - room[0] == pytest.approx(8 * one_piece, rel=0.01)
    assert room[0] < 3 * one_piece


def test_which_splats_are_reached(device, picked):
    """All that are drawn but some that stand behind others; the picture of these alone is the picture of all."""
    picked(True)
    scene, cameras = crowded(800)
    with Rasterizer(device, scene) as rasterizer:
        reach = reached_splats(rasterizer, cameras, range(len(cameras)))
        assert reach is not None
        found = [reach.of[number] for number in range(len(cameras))]
        assert (reach.total, reach.most) == (sum(map(len, found)), max(map(len, found)))
        drawn = []
        for camera, numbers in zip(cameras, found, strict=True):
            with rasterizer.prepare_set([camera]) as views:
                listed = device.download(views.intersections, (views.capacity,), np.uint32)
                wanted, _ = rasterizer.composite(views)
            drawn.append(np.unique(listed))
            assert np.all(np.diff(numbers.astype(np.int64)) > 0)
            assert np.isin(numbers, drawn[-1]).all()
            subset = scene.subset(numbers.astype(np.int64))
            with Rasterizer(device, subset) as alone, alone.prepare_set([camera]) as views:
                got, _ = alone.composite(views)
            assert np.array_equal(got, wanted)
        assert sum(map(len, found)) < 0.9 * sum(map(len, drawn)) < 0.5 * len(scene) * len(cameras)


def test_not_where_views_reach_much(device, monkeypatch):
    scene, cameras = crowded()
    with Rasterizer(device, scene) as rasterizer:
        assert reached_splats(rasterizer, cameras, range(5)) is None
        monkeypatch.setattr(reached, "LEAST_SPLATS", len(scene))
        monkeypatch.setattr(reached, "WORTH_IT", 1.0)
        assert reached_splats(rasterizer, cameras, range(5)) is not None
        monkeypatch.setattr(reached, "WORTH_IT", 0.01)
        assert reached_splats(rasterizer, cameras, range(5)) is None
        monkeypatch.setattr(reached, "LEAST_SPLATS", len(scene) + 1)
        assert reached_splats(rasterizer, cameras, range(5)) is None


@pytest.mark.parametrize("slices", [None, 256], ids=["in one piece", "in slices"])
def test_what_views_reach_is_found_once(device, monkeypatch, slices):
    """Also where it is not worth it."""
    made = noted(monkeypatch, reached, "Picker")
    monkeypatch.setattr(reached, "LEAST_SPLATS", 1)
    monkeypatch.setattr(reached, "WORTH_IT", 0.0)
    scene, cameras = crowded(200)
    with ColourRefit(device, scene, cameras, slices=slices):
        assert len(made) == 1


def test_products(device, picked):
    """With as many bytes as all fit, all lists and some geometry, some views, and none; one view sees nothing."""
    with crowded_case(device, 3) as case:
        direction = np.random.default_rng(5).normal(size=case.scene.sh.shape)
        found = []
        for on, memory in ((False, None), (True, None), (True, 200_000), (True, 75_000), (True, 0)):
            made = picked(on)
            with Linearised(case, memory=memory) as linear:
                assert len(made) == int(on)
                found.append((linear.error, linear.gradient, linear.blocks, linear.normal(direction)))
    for some in found[1:]:
        for one, other in zip(found[0], some, strict=True):
            assert np.array_equal(one, other)
    assert found[0][0] > 0


@pytest.mark.parametrize("on", [False, True], ids=["all splats", "own splats"])
def test_fewer_views_together_where_the_device_has_no_room(gpu, picked, monkeypatch, on):
    """Also where it is looked which splats they reach. Kernels for CPUs do one view at a time anyway."""
    prepare, together, found = Rasterizer.prepare_set, [], []

    def failing(self, some, *args):
        together.append((isinstance(self.parameters, IndexSubset), len(some)))
        if len(some) > 1:
            raise DeviceMemoryError("no room")
        return prepare(self, some, *args)

    made = picked(on)
    with crowded_case(gpu) as case:
        for full in (False, True):
            if full:
                monkeypatch.setattr(Rasterizer, "prepare_set", failing)
            with Linearised(case) as linear:
                found.append((linear.error, linear.gradient))
    assert len(made) == 2 * on
    assert max(views for _, views in together) > 1
    assert {of_own for of_own, _ in together} == ({False, True} if on else {False})
    assert found[0][0] == found[1][0] > 0
    assert np.array_equal(found[0][1], found[1][1])


def test_more_views_stay(device, picked):
    """In the memory that two thirds of them fit with all splats."""
    with crowded_case(device, splats=800) as case:
        room = {}
        for on in (False, True):
            picked(on)
            with ColourRefit(device, case.scene, case.cameras, memory=10**8) as refit:
                room[on] = refit.colour_map.own.room
    assert 10**8 - room[True] < 0.6 * (10**8 - room[False])


@pytest.mark.one_family
@pytest.mark.one_runtime
def test_the_same_file(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """Of a whole encode: with the vectors on the device, or with them and the target pictures on the host."""
    small = plush_excerpt_cameras[:12]
    options = EncodeOptions.for_preset("best", between=False).changed(prune={"iterations": 4})
    whole = encode(plush_excerpt, small, options, device=device)
    monkeypatch.setattr(refit_stage, "_LARGE", 0)
    remembered = encode(plush_excerpt, small, options.changed(memory=1 << 30), device=device)
    assert remembered.data == whole.data
    for name in ("_ANYWAY", "_OF_FREE", "_OF_GIVEN"):
        monkeypatch.setattr(coefficients, name, 0)
    sliced = encode(plush_excerpt, small, options, device=device)
    assert sliced.data == whole.data
    assert sliced.refitted.errors == whole.refitted.errors


@pytest.mark.parametrize("own_splats", [False, True])
def test_pictures_are_kept_in_what_streamed_views_leave(device, picked, own_splats):
    """Streamed views take their memory last: what is given for less than one of them is not filled with pictures."""
    scene, cameras = crowded(400)
    picked(own_splats)
    peaks = []
    with Case(device, scene, scene, cameras) as case, Pictures(device, case.pictures) as pictures:
        with ColourRefit(device, scene, cameras, memory=10**9) as refit:
            every = int(10**9 - refit.colour_map.own.room)
        for memory in (0, every // 20):
            with ColourRefit(device, scene, cameras, memory=memory) as refit:
                x, result = (refit.coefficients.vector() for _ in range(2))
                for each in (x, result):
                    refit.coefficients.zero(each)
                with taken_of(device) as taken:
                    refit.colour_map.gradient(x, pictures, result)
                peaks.append(max(in_all for _, in_all in taken))
    assert peaks[0] == peaks[1]
