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
from potr_cl.stages.pruning.removal import RemovalSweep, planned_sweep
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
from tests.devices import KERNELS, open_device

#: How views are grouped, and the kernel families that do it.
GROUPINGS = {"whole": "cpu gpu", "by view": "gpu", "by cluster": "gpu", "as drawn": "cpu"}
#: Bytes: all views of the street stay, some do, hardly more than the pictures of all fit, nothing does.
RESIDENCY = {"all": None, "some": 1_600_000, "pictures": 1_100_000, "nothing": 0}
#: Devices, and whether the others know nothing but what they are sent.
WORKERS = {"one device": (1, False), "two devices": (2, False), "two workers elsewhere": (3, True)}


@pytest.fixture(scope="module", params=KERNELS)
def kernels(request):
    return request.param


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


def skip_unless(grouping, kernels):
    if str(kernels).partition("-")[0] not in GROUPINGS[grouping]:
        pytest.skip(f"{kernels} kernels do not go {grouping}")


@contextmanager
def sweep(devices, grouping, options, scene, cameras, elsewhere=False, spared=None):
    """A measurement of the street as a plan says, and that it gave all memory back."""
    visibility = None if grouping == "whole" else Visibility.of(scene, cameras)
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        if grouping == "by view":  # as a GPU with memory of its own does
            patch.setattr(resident, "fits_whole", lambda device, scene: True)
        pool = None
        if len(devices) > 1:
            pool = stack.enter_context((ElsewherePool if elsewhere else HostPool)(devices))
        dealt = None
        if elsewhere and visibility is not None:
            names = [worker.name for worker in pool.workers()]
            dealt = ViewShares.of(cameras, visibility, [1.0] * len(names), scene, np.arange(len(scene)), names)
        bench = Workbench(HyperParameters.from_quality(0.5), device=devices[0], memory=options.memory, pool=pool)
        state = State.of(scene, cameras)
        yield stack.enter_context(measurement(state, bench, options, visibility, spared, dealt))
    assert [device.allocated for device in devices] == [0] * len(devices), "not all memory was given back"


@functools.cache
def course(kernels, tolerance):
    """What all views with all splats measure of the street on one device."""
    scene, cameras = street()
    with sweep([open_device(kernels)], "whole", SweepOptions(tolerance), scene, cameras) as wanted:
        return Course.of(wanted, scene)


@pytest.mark.parametrize(
    ("residency", "workers", "grouping"),
    [
        *((*plan, grouping) for plan in (("all", "one device"), ("nothing", "two devices")) for grouping in GROUPINGS),
        ("nothing", "one device", "by view"),
        ("nothing", "one device", "as drawn"),
        ("all", "two workers elsewhere", "whole"),
        ("all", "two workers elsewhere", "by cluster"),
        ("all", "two workers elsewhere", "as drawn"),
        *(pytest.param("some", "one device", grouping, marks=pytest.mark.slow) for grouping in list(GROUPINGS)[1:]),
        pytest.param("some", "two devices", "by cluster", marks=pytest.mark.slow),
        pytest.param("pictures", "two workers elsewhere", "by view", marks=pytest.mark.slow),
        pytest.param("pictures", "two workers elsewhere", "as drawn", marks=pytest.mark.slow),
    ],
)
def test_the_same_bits(kernels, grouping, residency, workers):
    """While splats go and colours change. Which views are resident is another matter: so no tile may be skipped."""
    skip_unless(grouping, kernels)
    scene, cameras = street()
    count, elsewhere = WORKERS[workers]
    devices = [open_device(kernels) for _ in range(count)]
    options = SweepOptions(0.0, memory=RESIDENCY[residency])
    with sweep(devices, grouping, options, scene, cameras, elsewhere) as got:
        if count == 1 and grouping != "whole":
            assert residency != "all" or got.resident_views == len(cameras)
            assert residency != "nothing" or got.resident_views == 0
            assert residency != "some" or 0 < got.resident_views < len(cameras)
        course(kernels, 0.0).check(got)


@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_the_same_tiles_are_skipped(kernels, grouping):
    skip_unless(grouping, kernels)
    scene, cameras = street()
    with sweep([open_device(kernels)], grouping, SweepOptions(0.05), scene, cameras) as got:
        course(kernels, 0.05).check(got)


@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_the_same_choice(kernels, grouping):
    """By the host, or by the device's own controller where there is one."""
    skip_unless(grouping, kernels)
    scene, cameras = street()
    options, schedule = SweepOptions(0.01), PruningOptions(1e-5, 12)
    with (
        sweep([open_device(kernels)], "whole", options, scene, cameras) as wanted,
        sweep([open_device(kernels)], grouping, options, scene, cameras) as got,
    ):
        assert (got.steering is None) == (wanted.steering is None)
        a, b = (prune_scene(removal, schedule) for removal in (wanted, got))
    assert np.array_equal(a.order, b.order)
    assert a.kept == b.kept < len(scene)
    assert np.array_equal(a.iteration_of, b.iteration_of)


@pytest.mark.parametrize(
    ("grouping", "residency"),
    [("whole", "nothing"), ("by view", "nothing"), ("by cluster", "all"), ("as drawn", "nothing")],
)
def test_removal_before_anything_was_measured(kernels, grouping, residency):
    """The targets show the splats that are gone."""
    skip_unless(grouping, kernels)
    scene, cameras = street()
    gone = np.arange(0, len(scene), 3)
    left = np.setdiff1d(np.arange(len(scene)), gone)
    with sweep([open_device(kernels)], "whole", SweepOptions(0.0), scene, cameras) as removal:
        removal.measure()
        removal.remove(gone)
        wanted = removal.measure()
    options = SweepOptions(0.0, memory=RESIDENCY[residency])
    with sweep([open_device(kernels)], grouping, options, scene, cameras) as got:
        got.remove(gone)
        assert np.array_equal(wanted[0][left], got.measure()[0][left])


@pytest.mark.parametrize(
    ("grouping", "residency"), [("by view", "nothing"), ("by cluster", "all"), ("as drawn", "nothing")]
)
def test_views_that_draw_nothing_are_views_too(kernels, grouping, residency):
    skip_unless(grouping, kernels)
    scene, cameras = street(2)
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + np.array([0, 0, -500.0]))
    cameras = [away, *cameras, away]
    options = SweepOptions(0.0, memory=RESIDENCY[residency])
    with (
        sweep([open_device(kernels)], "whole", SweepOptions(0.0), scene, cameras) as wanted,
        sweep([open_device(kernels)], grouping, options, scene, cameras) as got,
    ):
        Course.of(wanted, scene).check(got)
    faint = dataclasses.replace(scene, opacity_logits=np.full(len(scene), -30, np.float32))
    with sweep([open_device(kernels)], grouping, options, faint, cameras) as removal:
        effects, importances = removal.measure()
    assert not effects.any()
    assert not importances.any()


@pytest.mark.parametrize(
    ("grouping", "residency"), [("by view", "all"), ("by cluster", "nothing"), ("as drawn", "all")]
)
def test_spared_splats_stay(kernels, grouping, residency):
    skip_unless(grouping, kernels)
    scene, cameras = street()
    spared = np.random.default_rng(2).random(len(scene)) < 0.3
    options, schedule = SweepOptions(0.0, memory=RESIDENCY[residency]), PruningOptions(1e-2, 4)
    kept = []
    for some in (None, spared):
        with sweep([open_device(kernels)], grouping, options, scene, cameras, spared=some) as removal:
            kept.append(prune_scene(removal, schedule).survivors)
    assert not np.isin(np.flatnonzero(spared), kept[0]).all()
    assert np.isin(np.flatnonzero(spared), kept[1]).all()
    assert len(kept[1]) < len(scene) - 100


@pytest.mark.parametrize("grouping", ["by view", "as drawn"])
def test_streamed_views_wait_until_they_have_lost_enough(kernels, grouping):
    skip_unless(grouping, kernels)
    scene, cameras = street()
    with (
        sweep([open_device(kernels)], grouping, SweepOptions(0.06, memory=0), scene, cameras) as waiting,
        sweep([open_device(kernels)], grouping, SweepOptions(0.0, memory=0), scene, cameras) as eager,
    ):
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


@pytest.mark.parametrize("memory", [800_000, 1_600_000, 3_000_000])
def test_resident_views_keep_to_the_memory(kernels, memory):
    """Where it is the host's."""
    skip_unless("as drawn", kernels)
    device = open_device(kernels)
    scene, cameras = street()
    with planned_sweep(
        device, scene, cameras, SweepOptions(0.0, memory=memory), visibility=Visibility.of(scene, cameras)
    ) as drawn:
        totals = 16 * len(scene) + len(scene)
        assert drawn.resident_views > 0
        assert device.allocated <= memory + totals


def test_from_a_scene_on_the_device(kernels):
    """Copies are gathered there."""
    device = open_device(kernels)
    scene, cameras = street()
    visibility = Visibility.of(scene, cameras)
    with uploaded(device, scene) as whole:
        given = (device, whole, cameras, SweepOptions(0.0, turns=2), (0.0, 0.0, 0.0), visibility, None, None, scene)
        with planned_sweep(*given) as got:
            found = got.measure()
    with Rasterizer(device, scene) as rasterizer, RemovalSweep(rasterizer, cameras, SweepOptions(0.0)) as wanted:
        assert np.array_equal(wanted.measure()[0], found[0])


def test_gathered_on_the_device(kernels):
    device = open_device(kernels)
    scene, cameras = street(2)
    splats = np.arange(1, len(scene), 3)
    with (
        uploaded(device, scene) as whole,
        gathered(whole, splats) as part,
        Rasterizer(device, part) as one,
        Rasterizer(device, scene.subset(splats)) as other,
    ):
        for camera in cameras:
            assert np.array_equal(one.render(camera)[0], other.render(camera)[0])


# ----------------------------------------------------------------------------------------------------- whole encodes


def options_of(**given):
    options = EncodeOptions.for_preset("best", between=False, **given)
    return dataclasses.replace(options, cameras_anyway=True)


@pytest.mark.one_family
@pytest.mark.parametrize("grouping", list(GROUPINGS)[1:])
def test_a_whole_encode_has_the_same_bytes(kernels, grouping, monkeypatch):
    skip_unless(grouping, kernels)
    device = open_device(kernels)
    scene, cameras = street(5, 900)
    options = options_of(prune={"iterations": 6}, refit={"steps": 2})
    whole = encode(scene, cameras, options, device=device)
    made = []
    name = grouping.replace(" ", "_")
    plan = getattr(removal.plans, name)
    monkeypatch.setattr(removal.plans, name, lambda *given: made.append(plan(*given)) or made[-1])
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    if grouping == "by cluster":
        monkeypatch.setattr(SweepOptions, "only_by_tolerance", property(lambda options: False))
    planned_so = encode(scene, cameras, options, device=device)
    assert len(made) == 1
    assert len(made[0].groups) > 2
    assert whole.data == planned_so.data


def test_unseen_splats_are_kept_without_a_copy_of_the_scene(kernels, monkeypatch):
    """And lose their directions, as those do that are set aside."""
    device = open_device(kernels)
    scene, cameras = street(6, 400)
    cameras = [camera for camera in cameras if not camera.name.startswith(("5", "along"))]
    options = options_of(prune={"iterations": 6}, refit=False)
    aside = encode(scene, cameras, options, device=device)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    spared = encode(scene, cameras, options, device=device)
    assert aside.unseen is not None
    assert aside.unseen.splats > 300
    assert spared.unseen == aside.unseen
    assert spared.data == aside.data


def test_groups_are_made_only_where_they_can_be_of_use(kernels, monkeypatch):
    """Where few of the splats tell that a view sees more than half of them, all of them need not be looked at."""
    device = open_device(kernels)
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


def test_copies_of_clusters_wake_one_at_a_time(kernels, monkeypatch):
    """There is room for the largest only."""
    skip_unless("by cluster", kernels)
    awake: set[int] = set()
    most = []
    wake, close = SceneBuffers.wake, SceneBuffers.close

    def woken(self):
        wake(self)
        awake.add(id(self))
        most.append(len(awake))

    def closed(self):
        awake.discard(id(self))
        close(self)

    monkeypatch.setattr(budget, "SCENES", 0.0)
    monkeypatch.setattr(SceneBuffers, "wake", woken)
    monkeypatch.setattr(SceneBuffers, "close", closed)
    scene, cameras = street()
    with sweep([open_device(kernels)], "by cluster", SweepOptions(0.0, memory=1_600_000), scene, cameras) as got:
        sets = got._engine.resident
        assert got._engine.plan.copies_rest
        assert len({id(ready.subset) for ready in sets if ready.shares}) > 1
        most.clear()
        got.measure()
    assert max(most) == 1
