"""The contract of plans: whatever is grouped, resident or shared out, removal effects are the same bits.

Grouping x residency x family x workers, against one sweep of all views with all splats on one device.
"""

from __future__ import annotations

import dataclasses
import functools
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.model import splat_groups
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster import resident
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers, gathered, uploaded
from potr_cl.stages import prune
from potr_cl.stages.pruning import removal
from potr_cl.stages.pruning.controller import prune_scene
from potr_cl.stages.pruning.helpers import measurement
from potr_cl.stages.pruning.removal import RemovalSweep, Wanted, planned_sweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.views import budget, visibility
from potr_cl.views.shares import ViewShares
from potr_cl.views.visibility import Visibility
from potr_cl.workers.host import HostPool
from tests.cases.elsewhere import ElsewherePool
from tests.cases.streets import street
from tests.cases.sweeps import Course
from tests.devices import KERNELS, shared_device

#: How views are grouped, and the kernel families that do it.
GROUPINGS = {"whole": "cpu gpu", "by view": "gpu", "by cluster": "gpu", "as drawn": "cpu"}
#: Bytes: all views of the street stay, some do, hardly more than the pictures of all fit, nothing does.
RESIDENCY = {"all": None, "some": 1_200_000, "pictures": 850_000, "nothing": 0}
#: Devices, and whether the others know nothing but what they are sent.
WORKERS = {"one device": (1, False), "two devices": (2, False), "two workers elsewhere": (3, True)}
SCENE, CAMERAS = street(4, 200)
GONE = np.arange(0, len(SCENE), 3)


@pytest.fixture(scope="module", params=KERNELS)
def kernels(request):
    return request.param


@pytest.fixture
def device(kernels):
    return shared_device(kernels)


@pytest.fixture(autouse=True)
def _small_groups(request, kernels, monkeypatch):
    grouping = request.node.callspec.params.get("grouping", "whole")
    if kernels.partition("-")[0] not in GROUPINGS[grouping]:
        pytest.skip(f"{kernels} kernels do not go {grouping}")
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    yield
    assert shared_device(kernels).allocated == 0, "not all memory was given back"


@contextmanager
def sweep(kernels, grouping="whole", tolerance=0.0, residency="all", workers="one device", of=(SCENE, CAMERAS)):
    """A measurement of the street as a plan says, and that it gave all memory back."""
    (scene, cameras), (count, elsewhere) = of, WORKERS[workers]
    devices = [shared_device(kernels, number) for number in range(count)]
    options = SweepOptions(tolerance, memory=RESIDENCY[residency])
    visibility = None if grouping == "whole" else Visibility.of(scene, cameras)
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        # A GPU with memory of its own looks at each view by itself.
        patch.setattr(resident, "fits_whole", lambda device, scene: grouping == "by view")
        pool = None
        if count > 1:
            pool = stack.enter_context((ElsewherePool if elsewhere else HostPool)(devices))
        dealt = None
        if elsewhere and visibility is not None:
            names = [worker.name for worker in pool.workers()]
            dealt = ViewShares.of(cameras, visibility, [1.0] * len(names), scene, np.arange(len(scene)), names)
        bench = Workbench(HyperParameters.from_quality(0.5), device=devices[0], memory=options.memory, pool=pool)
        yield stack.enter_context(measurement(State.of(scene, cameras), bench, options, visibility, dealt))
    assert not any(helper.allocated for helper in devices[1:]), "not all memory was given back"


@functools.cache
def course(kernels, tolerance=0.0):
    """What all views with all splats measure of the street on one device."""
    with sweep(kernels, tolerance=tolerance) as wanted:
        return Course.of(wanted, SCENE)


@functools.cache
def choice(kernels, limit, iterations, tolerance):
    """What pruning makes of that, and whether the device steers it."""
    with sweep(kernels, tolerance=tolerance) as wanted:
        return prune_scene(wanted, PruningOptions(limit, iterations)), wanted.can_steer


@pytest.mark.parametrize(
    ("residency", "workers", "grouping"),
    [
        ("nothing", "one device", "by view"),
        ("nothing", "one device", "as drawn"),
        *(("nothing", "two devices", grouping) for grouping in GROUPINGS),
        *(("all", "two workers elsewhere", grouping) for grouping in ("whole", "by cluster", "as drawn")),
        *(pytest.param("some", "one device", grouping, marks=pytest.mark.slow) for grouping in list(GROUPINGS)[1:]),
        pytest.param("some", "two devices", "by cluster", marks=pytest.mark.slow),
        pytest.param("pictures", "two workers elsewhere", "by view", marks=pytest.mark.slow),
        pytest.param("pictures", "two workers elsewhere", "as drawn", marks=pytest.mark.slow),
    ],
)
def test_the_same_bits(kernels, grouping, residency, workers):
    """While splats go and colours change. Which views are resident is another matter: so no tile may be skipped."""
    with sweep(kernels, grouping, 0.0, residency, workers) as got:
        if workers == "one device":
            assert residency != "nothing" or got.ready_views == 0
            assert residency != "some" or 0 < got.ready_views < len(CAMERAS)
        course(kernels).check(got)


@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_the_same_tiles_are_skipped(kernels, grouping):
    """By a tolerance, where all views are resident."""
    with sweep(kernels, grouping, 0.05) as got:
        assert got.ready_views == len(CAMERAS)
        course(kernels, 0.05).check(got)


@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_the_same_choice(kernels, grouping):
    """By the host, or by the device's own controller where there is one."""
    wanted, steered = choice(kernels, 1e-5, 12, 0.01)
    with sweep(kernels, grouping, 0.01) as got:
        assert got.can_steer == steered
        found = prune_scene(got, PruningOptions(1e-5, 12))
    assert np.array_equal(found.order, wanted.order)
    assert found.kept == wanted.kept < len(SCENE)
    assert np.array_equal(found.iteration_of, wanted.iteration_of)


@functools.cache
def without_the_gone(kernels):
    with sweep(kernels) as removal:
        removal.measure()
        removal.remove(GONE)
        return removal.measure()[0]


@pytest.mark.parametrize(
    ("grouping", "residency"),
    [("whole", "nothing"), ("by view", "nothing"), ("by cluster", "all"), ("as drawn", "nothing")],
)
def test_removal_before_anything_was_measured(kernels, grouping, residency):
    """The targets show the splats that are gone."""
    with sweep(kernels, grouping, residency=residency) as got:
        got.remove(GONE)
        wanted, found = without_the_gone(kernels), got.measure()[0]
        assert np.array_equal(np.delete(found, GONE), np.delete(wanted, GONE))


@pytest.mark.parametrize(
    ("grouping", "residency"), [("by view", "nothing"), ("by cluster", "all"), ("as drawn", "nothing")]
)
def test_views_that_draw_nothing_are_views_too(kernels, grouping, residency):
    scene, cameras = street(2, 200)
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + np.array([0, 0, -500.0]))
    cameras = [away, *cameras, away]
    with (
        sweep(kernels, of=(scene, cameras)) as wanted,
        sweep(kernels, grouping, residency=residency, of=(scene, cameras)) as got,
    ):
        Course.of(wanted, scene).check(got)
    faint = dataclasses.replace(scene, opacity_logits=np.full(len(scene), -30, np.float32))
    with sweep(kernels, grouping, residency=residency, of=(faint, cameras)) as removal:
        effects, importances = removal.measure()
    assert not effects.any()
    assert not importances.any()


@pytest.mark.parametrize(
    ("grouping", "residency"), [("by view", "all"), ("by cluster", "nothing"), ("as drawn", "all")]
)
def test_spared_splats_stay(kernels, grouping, residency):
    spared = np.random.default_rng(2).random(len(SCENE)) < 0.3
    with sweep(kernels, grouping, residency=residency) as removal:
        kept = prune_scene(removal, PruningOptions(1e-2, 4), spared=spared).survivors
    assert not np.isin(np.flatnonzero(spared), choice(kernels, 1e-2, 4, 0.0)[0].survivors).all()
    assert np.isin(np.flatnonzero(spared), kept).all()
    assert len(kept) < len(SCENE) - 100


@pytest.mark.slow
@pytest.mark.parametrize("grouping", ["by view", "as drawn"])
def test_streamed_views_wait_until_they_have_lost_enough(kernels, grouping):
    with sweep(kernels, grouping, 0.06, "nothing") as waiting, sweep(kernels, grouping, 0.0, "nothing") as eager:
        (_, importances), first = eager.measure(), waiting.measure()
        order = np.argsort(importances)
        covered = np.cumsum(importances[order])
        little, much = order[covered < 0.02], order[covered < 0.06]
        assert 0 < len(little) < len(much)
        for removal in (eager, waiting):
            removal.remove(little)
        after = waiting.measure()
        assert np.array_equal(after[0], first[0])  # nothing was measured
        assert not np.array_equal(eager.measure()[0][much], first[0][much])
        for removal in (eager, waiting):
            removal.remove(np.setdiff1d(much, little))
        left = np.setdiff1d(order, much)
        assert np.array_equal(waiting.measure()[0][left], eager.measure()[0][left])


@pytest.mark.parametrize("grouping", ["as drawn"])
@pytest.mark.parametrize("memory", [500_000, 1_600_000])
def test_resident_views_keep_to_the_memory(device, grouping, memory):
    """Where it is the host's."""
    seen = Visibility.of(SCENE, CAMERAS)
    with planned_sweep(device, SCENE, Wanted(CAMERAS, SweepOptions(0.0, memory=memory), visibility=seen)) as drawn:
        totals = 16 * len(SCENE) + len(SCENE)
        assert 0 < drawn.ready_views < len(CAMERAS)
        assert device.allocated <= memory + totals


def test_from_a_scene_on_the_device(device, kernels):
    """Copies are gathered there."""
    visibility = Visibility.of(SCENE, CAMERAS)
    with uploaded(device, SCENE) as whole:
        wanted = Wanted(CAMERAS, SweepOptions(0.0, turns=2), visibility=visibility)
        with planned_sweep(device, whole, wanted, SCENE) as got:
            found = got.measure()
    with Rasterizer(device, SCENE) as rasterizer, RemovalSweep(rasterizer, CAMERAS, SweepOptions(0.0)) as wanted:
        assert np.array_equal(wanted.measure()[0], found[0])


def test_gathered_on_the_device(device):
    splats = np.arange(1, len(SCENE), 3)
    with (
        uploaded(device, SCENE) as whole,
        gathered(whole, splats) as part,
        Rasterizer(device, part) as one,
        Rasterizer(device, SCENE.subset(splats)) as other,
    ):
        for camera in CAMERAS[:4]:
            assert np.array_equal(one.render(camera)[0], other.render(camera)[0])


@pytest.mark.parametrize("grouping", ["by cluster"])
def test_copies_of_clusters_wake_one_at_a_time(kernels, grouping, monkeypatch):
    """There is room for the largest only."""
    awake: set[int] = set()
    most, wake, close = [], SceneBuffers.wake, SceneBuffers.close

    def woken(self):
        wake(self)
        awake.add(id(self))
        most.append((id(self), len(awake)))

    def closed(self):
        awake.discard(id(self))
        close(self)

    monkeypatch.setattr(budget, "SCENES", 0.0)
    monkeypatch.setattr(SceneBuffers, "wake", woken)
    monkeypatch.setattr(SceneBuffers, "close", closed)
    with sweep(kernels, grouping, residency="some") as got:
        assert got.ready_views > 0
        most.clear()
        got.measure()
    copies, together = zip(*most, strict=True)
    assert len(set(copies)) > 1
    assert max(together) == 1


# ----------------------------------------------------------------------------------------------------- whole encodes


def options_of(**given):
    options = EncodeOptions.for_preset("best", between=False, **given)
    return dataclasses.replace(options, cameras_anyway=True)


@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_a_whole_encode_has_the_same_bytes(device, grouping, monkeypatch):
    scene, cameras = street(5, 300)
    options = options_of(prune={"iterations": 3}, refit={"steps": 2})
    whole = encode(scene, cameras, options, device=device)
    made = []
    name = grouping.replace(" ", "_")
    plan = getattr(removal.plans, name)
    monkeypatch.setattr(removal.plans, name, lambda *given: made.append(plan(*given)) or made[-1])
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    if grouping == "by view":
        monkeypatch.setattr(resident, "fits_whole", lambda device, scene: True)
    if grouping == "by cluster":
        monkeypatch.setattr(SweepOptions, "only_by_tolerance", property(lambda options: False))
    planned_so = encode(scene, cameras, options, device=device)
    assert len(made) == 1
    assert len(made[0].groups) > 2
    assert whole.data == planned_so.data


def test_unseen_splats_are_kept_without_a_copy_of_the_scene(device, monkeypatch):
    """And lose their directions, as those do that are set aside."""
    scene, cameras = street(6, 200)
    cameras = [camera for camera in cameras if not camera.name.startswith(("5", "along"))]
    options = options_of(prune={"iterations": 4}, refit=False)
    aside = encode(scene, cameras, options, device=device)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    spared = encode(scene, cameras, options, device=device)
    assert aside.unseen is not None
    assert aside.unseen.splats > 150
    assert spared.unseen == aside.unseen
    assert spared.data == aside.data


@pytest.mark.one_family
def test_groups_are_made_only_where_they_can_be_of_use(device, monkeypatch):
    """Where few of the splats tell that a view sees more than half of them, all of them need not be looked at."""
    scene, cameras = street(2, 300)
    options = options_of(prune={"iterations": 2}, refit=False, compact=False)
    grouped = []
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(prune, "groups_of_large", lambda scene, run: grouped.append(scene))
    for part in (0.55, 0.45):
        monkeypatch.setattr(prune, "seen_part", lambda scene, views, part=part: part)
        encode(scene, cameras, options, device=device)
    assert len(grouped) == 1
    assert 0.2 < visibility.seen_part(*street(5, 900)) < 0.45
