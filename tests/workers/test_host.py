"""Several devices of this computer give the bytes that one gives."""

from __future__ import annotations

import dataclasses
import threading
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

import potr_cl
from potr_cl.errors import DeviceError, DeviceMemoryError, UsageError
from potr_cl.model import splat_groups
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device, choose_devices
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster import resident
from potr_cl.stages.pruning import removal
from potr_cl.stages.pruning.helpers import RemovalPart
from potr_cl.stages.refitting.helpers import ColourPart
from potr_cl.views import targets, visibility
from potr_cl.views.targets import RenderedTargets
from potr_cl.workers.host import HostPool, open_workers
from potr_cl.workers.parts import Parts
from potr_cl.workers.pool import Part
from tests.cases.cameras import small
from tests.cases.streets import street
from tests.devices import open_device
from tests.reference.surfaces import together

#: Splats go, colours are made sparse and re-fitted on the way, coefficients are given up, and AC is rounded.
OPTIONS = EncodeOptions.for_preset(
    "best",
    q=0.3,
    prune={"keep": 0.4, "iterations": 5},
    refit={"at": (0.4,), "steps": 2, "drop": 1e-7},
    compact=True,
    between={"views": 0},
)


def few(cameras):
    """Five training views and a test view, small."""
    chosen = [c for c in cameras if c.split == "train"][:5] + [c for c in cameras if c.split == "test"][:1]
    return [small(camera) for camera in chosen]


#: Nothing is kept of any view, and a GPU decides itself.
LITTLE_MEMORY, BY_THRESHOLD = OPTIONS.changed(memory=0), OPTIONS.changed(prune={"keep": None})


@pytest.mark.parametrize(
    ("family", "options", "views", "count"),
    [
        ("cpu", LITTLE_MEMORY, 6, 3),
        ("gpu", BY_THRESHOLD, 6, 3),
        pytest.param("cpu", OPTIONS, 2, 4, id="more devices than views", marks=pytest.mark.slow),
        pytest.param("gpu", LITTLE_MEMORY, 6, 3, marks=pytest.mark.slow),
    ],
)
def test_the_same_bytes(plush_excerpt, plush_excerpt_cameras, family, options, views, count):
    """And all that is known of the course: the order in which splats went, and the sums of each iteration."""
    cameras = few(plush_excerpt_cameras)[:views]
    expected = encode(plush_excerpt, cameras, options, device=open_device(family))
    assert expected.shared is None
    devices = [open_device(family) for _ in range(count)]
    with HostPool(devices) as pool:
        found = encode(plush_excerpt, cameras, options, device=devices[0], pool=pool)
    assert found.data == expected.data
    assert np.array_equal(found.pruned.order, expected.pruned.order)
    assert found.pruned.history == expected.pruned.history
    assert len(expected.pruned.history) > 1
    assert len(found.shared.workers) == count
    assert found.shared.sent > 0
    assert found.shared.received > 0
    assert [device.allocated for device in devices] == [0] * count


@pytest.mark.slow
def test_steps_by_some_of_the_pixels_give_the_same_bytes(plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """Every device knows which ones these are: it goes by the views' numbers among all."""
    cameras = few(plush_excerpt_cameras)
    options = OPTIONS.changed(prune={"iterations": 2}, compact=False)
    devices = [Device() for _ in range(4)]
    every = encode(plush_excerpt, cameras, options, device=devices[0]).data
    monkeypatch.setattr("potr_cl.stages.refitting.colour_map.ENOUGH", 2)
    expected = encode(plush_excerpt, cameras, options, device=devices[0]).data
    assert expected != every
    with HostPool(devices) as pool:
        assert encode(plush_excerpt, cameras, options, device=devices[0], pool=pool).data == expected


@pytest.mark.slow
def test_pictures_are_rendered_ahead_by_the_device_that_needs_them(plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """Each its own, before the re-fit asks for any; nobody renders one again; and the bytes are those without."""
    cameras = few(plush_excerpt_cameras)
    options = OPTIONS.changed(prune={"iterations": 2}, compact=False, refit={"at": ()})
    devices = [open_device("gpu") for _ in range(3)]
    rendered, renderers = [], set()
    into = RenderedTargets.into

    def noted(self, numbers, *where):
        rendered.extend(numbers)
        renderers.add(threading.current_thread().name)
        into(self, numbers, *where)

    monkeypatch.setattr(RenderedTargets, "into", noted)
    found = []
    for room in (targets.AHEAD, 0):
        monkeypatch.setattr(targets, "AHEAD", room)
        with HostPool(devices) as pool:
            for some in (None, pool):
                rendered.clear()
                renderers.clear()
                found.append(encode(plush_excerpt, cameras, options, device=devices[0], pool=some).data)
                assert sorted(rendered) == list(range(5))
                asking = {name for name in renderers if name.startswith(("MainThread", "potr_cl device"))}
                assert asking == (set() if room else renderers)
    assert len(set(found)) == 1
    assert [device.allocated for device in devices] == [0] * 3


def poor(device: Device, memory: int) -> Device:
    """The same device with less memory."""
    return Device(dataclasses.replace(device.info, memory=memory), family=device.family)


def test_a_device_with_too_little_memory_leaves_its_views_to_others(plush_excerpt, plush_excerpt_cameras, caplog):
    cameras = few(plush_excerpt_cameras)
    options = OPTIONS.changed(prune={"iterations": 2}, refit={"at": ()}, compact=False)
    first = Device(choose_device())
    expected = encode(plush_excerpt, cameras, options, device=first).data
    devices = [first, poor(first, 100_000)]
    with HostPool(devices) as pool:
        assert encode(plush_excerpt, cameras, options, device=first, pool=pool).data == expected
    assert "reassigning its views to 0:" in caplog.text
    assert [device.allocated for device in devices] == [0, 0]


@pytest.fixture(scope="module")
def pruned_by_threshold(plush_excerpt, plush_excerpt_cameras):
    """The file that one device makes with options with which a GPU decides itself."""
    return encode(plush_excerpt, few(plush_excerpt_cameras), BY_THRESHOLD, device=open_device("gpu")).data


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "command", "call"),
    [
        (RemovalPart, "lend_totals", 4),
        (RemovalPart, "remove_marked", 3),
        (ColourPart, "gradient", 2),
        (ColourPart, "normal", 4),
    ],
)
def test_a_device_that_fails_on_the_way(
    plush_excerpt, plush_excerpt_cameras, pruned_by_threshold, monkeypatch, caplog, kind, command, call
):
    """Its part is made again on the first device, from what is lent, and repeats what it was told."""
    cameras = few(plush_excerpt_cameras)
    devices = [open_device("gpu") for _ in range(2)]
    real, calls = getattr(kind, command), []

    def failing(self, *args):
        calls.append(None)
        if len(calls) == call:
            raise DeviceError("the device failed")
        return real(self, *args)

    monkeypatch.setattr(kind, command, failing)
    with HostPool(devices) as pool:
        found = encode(plush_excerpt, cameras, BY_THRESHOLD, device=devices[0], pool=pool)
    assert found.data == pruned_by_threshold
    assert len(calls) > call
    assert "reassigning its views to 0:" in caplog.text
    assert [device.allocated for device in devices] == [0, 0]


def test_no_device_has_enough_memory(plush_excerpt, plush_excerpt_cameras):
    devices = [poor(Device(choose_device()), 100_000) for _ in range(2)]
    with HostPool(devices) as pool, pytest.raises(DeviceMemoryError):
        encode(plush_excerpt, few(plush_excerpt_cameras), OPTIONS, device=devices[0], pool=pool)
    assert [device.allocated for device in devices] == [0, 0]


def test_devices_of_two_kinds_are_refused(plush_excerpt):
    with pytest.raises(UsageError, match="run different kernels"):
        HostPool([open_device("cpu"), open_device("gpu")])


def test_devices_that_round_differently_are_told(caplog):
    with HostPool([SimpleNamespace(family="cpu", info=name) for name in ("one", "another")]):
        pass
    assert "devices of several kinds (another, one), which round differently" in caplog.text


def test_devices_by_name():
    best = choose_device()
    alike = choose_devices("all")
    assert alike[0] == best
    assert {(info.kind, info.platform) for info in alike} == {(best.kind, best.platform)}
    assert choose_devices(str(best.index)) == [best]
    with pytest.raises(DeviceError, match="twice"):
        choose_devices(f"{best.index},{best.index}")
    with pytest.raises(DeviceError, match="no OpenCL device fits '99'"):
        choose_devices(f"{best.index},99")
    for named in ("all", f"{best.index}, {best.index + 1}"):
        with pytest.raises(DeviceError, match="only encode and compare share"):
            choose_device(named)


def test_all_devices_of_this_process_are_known():
    """Each loads what the last encode has needed, not the first one alone."""
    devices = [Device(choose_device()) for _ in range(3)]
    with open_workers(devices) as workers:
        assert list(workers.devices) == devices
    with open_workers(devices[0]) as workers:
        assert list(workers.devices) == devices[:1]


def test_the_environment_may_name_several(monkeypatch, plush_excerpt, plush_excerpt_cameras):
    monkeypatch.setenv("POTR_CL_DEVICE", "all")
    with open_workers() as workers:
        assert workers.device.info == choose_devices("all")[0]
    quick = OPTIONS.changed(prune=False, refit=False, compact=False)
    assert potr_cl.encode(plush_excerpt, few(plush_excerpt_cameras), quick).nbytes > 0


@pytest.mark.slow
def test_python_takes_several_devices(plush_excerpt, plush_excerpt_cameras):
    cameras = few(plush_excerpt_cameras)
    device = Device()
    expected = potr_cl.encode(plush_excerpt, cameras, OPTIONS, device=device).data
    assert potr_cl.encode(plush_excerpt, cameras, OPTIONS, device=[device, Device()]).data == expected
    assert potr_cl.encode(plush_excerpt, cameras, OPTIONS, device=[device.info]).data == expected
    with pytest.raises(UsageError, match="named twice"):
        potr_cl.encode(plush_excerpt, cameras, OPTIONS, device=[device.info, device.info])
    with pytest.raises(UsageError, match="list of devices is empty"):
        potr_cl.encode(plush_excerpt, cameras, OPTIONS, device=[])


@pytest.mark.slow
@pytest.mark.parametrize("kept", [True, False], ids=["kept", "copied for each stage"])
def test_large_scenes_view_by_view(kept, monkeypatch):
    """Each device, the first one too, looks at its views with what these may draw; some splats nobody sees.

    Nobody but the first device makes the scene ready: it goes from there to the others.
    """
    seen, cameras = street(4, 200, across=True)
    behind = seen.subset(np.arange(200))
    scene = together(seen, dataclasses.replace(behind, means=behind.means - np.float32([500, 0, 0])))
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 3}, refit={"steps": 1})
    options = dataclasses.replace(options, cameras_anyway=True)
    alone = open_device("gpu")
    expected = encode(scene, cameras, options, device=alone)
    assert expected.unseen.splats >= 200
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    monkeypatch.setattr(resident, "fits_whole", lambda device, scene: True)
    if not kept:
        for name in ("_PART", "_PART_OF_HOST"):
            monkeypatch.setattr(resident, name, 1 << 40)
    shares, plans, ready = [], [], []
    made, by_view, uploaded = removal.RemovalSweep.__init__, removal.plans.by_view, resident.uploaded

    def noting(self, *given, **named):
        made(self, *given, **named)
        shares.append(self.ready_views)

    monkeypatch.setattr(removal.RemovalSweep, "__init__", noting)
    monkeypatch.setattr(removal.plans, "by_view", lambda *given: plans.append(len(given[2])) or by_view(*given))
    monkeypatch.setattr(resident, "uploaded", lambda *given: ready.append(given[0]) or uploaded(*given))
    devices = [open_device("gpu") for _ in range(3)]
    with HostPool(devices) as pool:
        found = encode(scene, cameras, options, device=devices[0], pool=pool)
    assert len(shares) == len(plans) == 3
    assert sum(plans) == len(cameras)
    *helpers, master = sorted(shares)
    assert master == len(cameras), "the master's own, and those of others"
    assert 0 < sum(helpers) < len(cameras)
    # For the re-fit's pictures each has it made ready once more, if it is not kept.
    assert ready[0] is devices[0]
    assert len(ready) == (1 if kept else 4)
    assert found.data == expected.data
    assert [device.allocated for device in devices] == [0] * 3


class SlowToMake(Part):
    """Takes memory once it may, and goes on being made when somebody else has lost patience."""

    def __init__(self, device, memory, begun, go):
        begun.set()
        assert go.wait(60)
        self._memory = Memory(device)
        self._memory.allocate(1 << 16, "a test")

    def close(self):
        self._memory.close()


def test_what_is_still_being_made_is_given_back_after_ctrl_c():
    devices = [open_device("cpu"), open_device("cpu")]
    begun, go = threading.Event(), threading.Event()

    def interrupted():
        with HostPool(devices) as pool, ExitStack() as stack:
            stack.callback(go.set)  # when nobody wants the part any more
            stack.enter_context(Parts(pool, SlowToMake, [(begun, go)]))
            assert begun.wait(60)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [device.allocated for device in devices] == [0, 0]
