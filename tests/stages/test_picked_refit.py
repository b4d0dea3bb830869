"""A re-fit of a large scene, in which each view has the splats that it reaches: the same bits as with all of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting import colour_map, placement, reached
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.picked_views import PickedViews
from potr_cl.stages.refitting.reached import reached_splats
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.workers.host import HostPool
from tests.cases.streets import street
from tests.devices import KERNELS, open_device
from tests.reference.refit_cases import Case, Linearised
from tests.stages.test_sliced_refit import coarse, grid_of, same


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a re-fit did not give all its memory back"


@pytest.fixture
def picked(monkeypatch):
    """Have views pick their splats, and note which views did."""
    made: list[PickedViews] = []

    class Noting(PickedViews):
        def __init__(self, *args: object) -> None:
            made.append(self)
            super().__init__(*args)  # type: ignore[arg-type]

    def switch(on: bool) -> list[PickedViews]:
        monkeypatch.setattr(reached, "LEAST_SPLATS", 1 if on else 1 << 60)
        monkeypatch.setattr(reached, "WORTH_IT", 1.0)
        made.clear()
        return made

    monkeypatch.setattr(colour_map, "PickedViews", Noting)
    return switch


def crowded(splats: int = 800, degree: int = 1):
    """A street of which some splats stand behind others that nothing is seen through; views of two sizes."""
    scene, cameras = street(4, splats)
    logits = np.where(np.arange(len(scene)) % 2, 6, -1).astype(np.float32)
    rng = np.random.default_rng(3)
    sh = rng.normal(0, 0.3, (len(scene), (degree + 1) ** 2, 3)).astype(np.float32)
    cameras[1] = dataclasses.replace(cameras[1], width=50, height=90)
    return dataclasses.replace(scene, log_scales=scene.log_scales + 0.5, opacity_logits=logits, sh=sh), cameras


def case_of(device, degree: int = 1, splats: int = 400):
    scene, cameras = crowded(splats, degree)
    other = dataclasses.replace(scene, sh=scene.sh[::-1].copy())
    return Case(device, scene, other, cameras, background=(0.2, 0.1, 0.0))


def test_which_splats_are_reached(device, monkeypatch):
    """All that are drawn but some that stand behind others; the picture of these alone is the picture of all."""
    monkeypatch.setattr(reached, "LEAST_SPLATS", 1)
    monkeypatch.setattr(reached, "WORTH_IT", 1.0)
    scene, cameras = crowded()
    with Rasterizer(device, scene) as rasterizer:
        reach = reached_splats(rasterizer, cameras, range(len(cameras)))
        assert reach is not None
        found = [reach.of[number] for number in range(len(cameras))]
        assert (reach.total, reach.most) == (sum(map(len, found)), max(map(len, found)))
        drawn = []
        for camera, numbers in zip(cameras, found, strict=True):
            with rasterizer.prepare_set([camera]) as views:
                listed = device.download(views.intersections, (views.capacity,), np.uint32)
                wanted, _ = rasterizer.composite(views.views[0])
            drawn.append(np.unique(listed))
            assert np.all(np.diff(numbers.astype(np.int64)) > 0)
            assert np.isin(numbers, drawn[-1]).all()
            subset = scene.subset(numbers.astype(np.int64))
            with Rasterizer(device, subset) as alone, alone.prepare_set([camera]) as views:
                got, _ = alone.composite(views.views[0])
            assert np.array_equal(got, wanted)
        assert sum(map(len, found)) < 0.9 * sum(map(len, drawn)) < 0.5 * len(scene) * len(cameras)


def test_fewer_views_together_where_the_device_has_no_room(device, monkeypatch):
    if device.family == "cpu":
        pytest.skip("kernels for CPUs do one view at a time")
    monkeypatch.setattr(reached, "LEAST_SPLATS", 1)
    monkeypatch.setattr(reached, "WORTH_IT", 1.0)
    scene, cameras = crowded(200)
    prepare = Rasterizer.prepare_set
    together, found = [], []

    def failing(self, some, *args):
        together.append(len(some))
        if len(some) > 3:
            raise DeviceMemoryError("no room")
        return prepare(self, some, *args)

    with Rasterizer(device, scene) as rasterizer:
        for full in (False, True):
            if full:
                monkeypatch.setattr(Rasterizer, "prepare_set", failing)
            reach = reached_splats(rasterizer, cameras, range(len(cameras)))
            assert reach is not None
            found.append(reach.of)
    assert max(together) > 3
    for number in range(len(cameras)):
        assert np.array_equal(found[0][number], found[1][number])


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
    made = []

    class Noting(reached.Picker):
        def __init__(self, *args: object) -> None:
            made.append(self)
            super().__init__(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(reached, "Picker", Noting)
    monkeypatch.setattr(reached, "LEAST_SPLATS", 1)
    monkeypatch.setattr(reached, "WORTH_IT", 0.0)
    scene, cameras = crowded(200)
    with ColourRefit(device, scene, cameras, slices=slices):
        assert len(made) == 1


#: Bytes that all lists fit and some geometry, that some views fit, and none.
@pytest.mark.parametrize("memory", [None, 150_000, 0])
def test_products(device, picked, memory):
    with case_of(device, 3) as case:
        direction = np.random.default_rng(5).normal(size=case.scene.sh.shape)
        found = []
        for on in (False, True):
            made = picked(on)
            with Linearised(case, memory=memory) as linear:
                assert len(made) == int(on)
                found.append((linear.error, linear.gradient, linear.blocks, linear.normal(direction)))
    for whole, some in zip(*found, strict=True):
        assert np.array_equal(whole, some)
    assert found[0][0] > 0


def test_a_view_that_sees_nothing(device, picked):
    scene, cameras = crowded()
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + 1000)
    errors = []
    with Case(device, scene, scene, [away, *cameras[:3]], background=(0.2, 0.1, 0.0)) as case:
        case.scene.sh[:, 0] += 0.1
        for on in (False, True):
            picked(on)
            with Linearised(case) as linear:
                errors.append((linear.error, linear.gradient))
    assert errors[0][0] == errors[1][0] > 0
    assert np.array_equal(errors[0][1], errors[1][1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slices", "way"),
    [
        pytest.param(None, "colour_grid", id="in one piece, colour_grid"),
        pytest.param(None, "fix_ac", id="in one piece, fix_ac"),
        pytest.param(256, "solve", id="in slices, solve"),
    ],
)
def test_a_solution(device, picked, way, slices, monkeypatch):
    """Of two parts of the views."""
    monkeypatch.setattr(colour_map, "ENOUGH", 4)
    with case_of(device) as case:
        count = len(case.scene)
        rounding = {
            "colour_grid": {"colour_grid": lambda effects: grid_of(count)},
            "fix_ac": {"fix_ac": coarse},
            "solve": {},
        }[way]

        def fitted(on, memory):
            made = picked(on)
            options = RefitOptions(steps=4, gain=0, drop=1e-7, slices=slices, memory=memory)
            result = refit_colours(
                device, case.scene, case.cameras, case.targets, options, background=case.background, **rounding
            )
            assert len(made) == int(on)
            return result

        whole = fitted(False, None)
        assert same(fitted(True, 300_000), whole)
    assert whole.steps > 3


def test_more_views_stay(device, picked):
    """In the memory that two thirds of them fit with all splats."""
    with case_of(device, splats=800) as case:
        room = {}
        for on in (False, True):
            picked(on)
            with ColourRefit(device, case.scene, case.cameras, memory=10**8) as refit:
                room[on] = refit.colour_map.room
    assert 10**8 - room[True] < 0.6 * (10**8 - room[False])


@pytest.mark.slow
@pytest.mark.one_runtime
@pytest.mark.parametrize("part", [0.3])
def test_little_memory_is_enough(device, picked, part, monkeypatch):
    """What lies on the device keeps to what is given, as soon as that is more than the least."""
    monkeypatch.setattr(placement, "_ANYWAY", 0)
    monkeypatch.setattr(placement, "_LEAST_SLICE", 512)
    device = Device(dataclasses.replace(device.info, kind="gpu", integrated=False), family=device.family)
    scene, cameras = crowded(5000, degree=3)
    one_piece = 3400 * len(scene)
    memory = int(part * one_piece)
    results = []
    with Case(device, scene, dataclasses.replace(scene, sh=-scene.sh), cameras) as case:
        free = device.allocated
        for on, given in ((False, None), (True, memory)):
            picked(on)
            with ColourRefit(device, scene, cameras, memory=given) as refit:
                results.append(refit.solve(scene.sh, case.targets, RefitOptions(steps=2, gain=0, drop=1e-7)))
                taken = device.allocated - free
    assert taken < memory
    assert same(*results)


@pytest.mark.slow
def test_the_same_file(device, picked):
    """Of a whole encode, on one device and on two."""
    scene, cameras = crowded(400)
    options = EncodeOptions.for_preset("best", cameras_anyway=True).changed(prune={"iterations": 4})
    picked(False)
    wanted = encode(scene, cameras, options, device=device)
    made = picked(True)
    assert encode(scene, cameras, options, device=device).data == wanted.data
    assert len(made) == 1
    made.clear()
    with HostPool([device, open_device(device.family)]) as pool:
        assert encode(scene, cameras, options, device=device, pool=pool).data == wanted.data
    assert len(made) == 2
