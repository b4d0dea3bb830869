"""Workers elsewhere get of a large scene what their views may draw, and the file is the same."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import pickle
from itertools import chain

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.model import splat_groups
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.resident import SceneSubset
from potr_cl.raster.rules import INRIA
from potr_cl.stages.pruning import helpers
from potr_cl.stages.refitting.exchange import DrawnRows
from potr_cl.stages.refitting.helpers import ColourPart
from potr_cl.views import visibility
from potr_cl.views.shares import ViewShares
from potr_cl.views.visibility import Visibility
from tests.cases.cameras import small
from tests.cases.elsewhere import ElsewherePool
from tests.cases.streets import street
from tests.devices import open_device
from tests.reference.surfaces import together

#: Splats go, colours are made sparse and re-fitted on the way, coefficients are given up, and AC is rounded.
OPTIONS = dataclasses.replace(
    EncodeOptions.for_preset(
        "best", q=0.3, prune={"keep": 0.4, "iterations": 4}, refit={"at": (0.4,), "steps": 2, "drop": 1e-7},
        compact=True, between=False,
    ),
    cameras_anyway=True,
)  # fmt: skip


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)


@functools.cache
def street_with_a_house_that_nobody_sees():
    scene, cameras = street(5, 150, across=True)
    behind = scene.subset(np.arange(150))
    behind = dataclasses.replace(behind, means=behind.means - np.float32([500, 0, 0]))
    return together(scene, behind), cameras


@functools.cache
def visible_of_a_street():
    scene, cameras = street(across=True)
    return scene, cameras, Visibility.of(scene, cameras, INRIA.near)


#: A GPU decides itself, and what nobody sees stays; no re-fits on the way.
IN_THE_END = OPTIONS.changed(prune={"keep": None}, refit={"at": ()})


@functools.cache
def in_the_end_alone():
    """What one device makes of that street."""
    return encode(*street_with_a_house_that_nobody_sees(), IN_THE_END, device=open_device("cpu"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "options"),
    [
        ("cpu", OPTIONS),  # the host decides, as it does on a CPU whatever the options
        # Nothing is kept of any view; tests/workers/test_host.py has that without slow ones.
        ("cpu", OPTIONS.changed(memory=0, prune={"tolerance": 0.0})),
        ("gpu", OPTIONS.changed(prune={"keep": None})),  # a GPU decides itself, and what nobody sees stays
    ],
    ids=["by number", "little memory", "by threshold"],
)
def test_the_same_bytes(family, options, monkeypatch):
    scene, cameras = street_with_a_house_that_nobody_sees()
    expected = encode(scene, cameras, options, device=open_device(family)).data
    made = []

    class Noting(helpers.RemovalPart):
        def __init__(self, device, memory, given, *more):
            made.append(len(given))
            super().__init__(device, memory, given, *more)

    class NotingColours(ColourPart):
        def __init__(self, device, memory, constant, sh_count, rules, background, source, *more):
            made.append(len(source))
            super().__init__(device, memory, constant, sh_count, rules, background, source, *more)

    monkeypatch.setattr("potr_cl.stages.pruning.helpers.RemovalPart", Noting)
    monkeypatch.setattr("potr_cl.stages.refitting.helpers.ColourPart", NotingColours)
    devices = [open_device(family) for _ in range(4)]
    with ElsewherePool(devices) as pool:
        assert encode(scene, cameras, options, device=devices[0], pool=pool).data == expected
        # Of five houses and one that nobody sees, a worker has half or less, but for the view along the street.
        assert len(made) == 9  # of three workers, for pruning and two re-fits
        assert sorted(made)[5] < 0.6 * len(scene)
        # These travelled once: the rest is what the re-fits need of the splats that are left.
        constant = 2 * 56 * len(scene)
        assert pool.scenes < sum(made[:3]) * scene.nbytes / len(scene) + constant
    assert [device.allocated for device in devices] == [0] * 4


@pytest.mark.slow
def test_a_re_fit_sends_what_views_draw(monkeypatch):
    """Of a direction, each worker gets the coefficients of these splats alone; what it finds is the same."""
    scene, cameras = street_with_a_house_that_nobody_sees()
    found, sent = [], []
    for left_out in (False, True):
        with monkeypatch.context() as patched, ElsewherePool([open_device("cpu") for _ in range(4)]) as pool:
            if not left_out:
                patched.setattr(DrawnRows, "are_worth_it", lambda drawn: False)
            found.append(encode(scene, cameras, IN_THE_END, device=pool.first, pool=pool).data)
            sent.append(pool.traffic.of["normal"].sent)
    assert found[0] == found[1] == in_the_end_alone().data
    assert 0 < sent[1] < 0.8 * sent[0]


@pytest.mark.slow
@pytest.mark.parametrize("lost_at", [3, 6])
def test_who_is_told_again_is_told_the_colours_of_then(lost_at, monkeypatch, plush_excerpt, plush_excerpt_cameras):
    """Of two re-fits on the way; the worker is lost after the first or the second one."""
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1 << 40)
    options = EncodeOptions.for_preset(
        "best", q=0.3, prune={"keep": 0.4, "iterations": 8}, refit={"at": (0.3, 0.6), "steps": 3, "drop": 1e-7},
        between=False,
    )  # fmt: skip
    cameras = [small(camera) for camera in plush_excerpt_cameras[:5]]
    devices = [open_device("cpu") for _ in range(3)]
    expected = encode(plush_excerpt, cameras, options, device=devices[0]).data
    measure, asked = helpers.RemovalPart.changes, []

    def losing(removal, *again):
        if not asked or asked[0] is removal:
            asked.append(removal)
            if asked.count(removal) == lost_at:
                raise DeviceMemoryError("no room")
        return measure(removal, *again)

    monkeypatch.setattr(helpers.RemovalPart, "changes", losing)
    with ElsewherePool(devices) as pool:
        assert encode(plush_excerpt, cameras, options, device=devices[0], pool=pool).data == expected
    assert asked.count(asked[0]) == lost_at


@pytest.mark.slow
def test_a_re_fit_without_room_for_that_sends_all(monkeypatch):
    """The bytes are the same, and nothing stays taken."""
    scene, cameras = street_with_a_house_that_nobody_sees()
    devices = [open_device("cpu") for _ in range(4)]
    expected = in_the_end_alone().data
    refused = []

    class WithoutRoom(DrawnRows):
        def take_flags(self, active):
            refused.append(self)
            raise DeviceMemoryError("no room")

    monkeypatch.setattr("potr_cl.stages.refitting.helpers.DrawnRows", WithoutRoom)
    with ElsewherePool(devices) as pool:
        assert encode(scene, cameras, IN_THE_END, device=devices[0], pool=pool).data == expected
    assert refused
    assert [device.allocated for device in devices] == [0] * 4


@pytest.mark.slow
def test_the_uncompressed_scene_travels_once(monkeypatch):
    """Where workers get all of it: of what is pruned, once unseen splats are set aside, they get the numbers."""
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1 << 40)
    scene, cameras = street_with_a_house_that_nobody_sees()
    devices = [open_device("cpu") for _ in range(3)]
    expected = in_the_end_alone()
    assert expected.unseen.splats > 100
    with ElsewherePool(devices) as pool:
        assert encode(scene, cameras, IN_THE_END, device=devices[0], pool=pool).data == expected.data
        constant = 56 * len(scene)
        assert pool.scenes < scene.nbytes + constant


@pytest.mark.slow
def test_workers_with_gpus_look_at_each_view_with_what_it_may_draw(monkeypatch):
    """As a GPU with memory of its own does: a CPU that runs its kernels has none."""
    scene, cameras = street_with_a_house_that_nobody_sees()
    options = OPTIONS.changed(prune={"keep": None})
    devices = [open_device("gpu") for _ in range(3)]
    expected = encode(scene, cameras, options, device=devices[0]).data
    monkeypatch.setattr("potr_cl.raster.resident.fits_whole", lambda device, scene: True)
    made = []
    for where, name in (("stages.pruning.removal", "NamedSplats"), ("views.targets", "SeenRasterizer")):
        where = f"potr_cl.{where}"
        kind = importlib.import_module(where).__dict__[name]

        def noting(self, *args, kind=kind, **named):
            made.append(kind.__name__)
            kind.__init__(self, *args, **named)

        monkeypatch.setattr(f"{where}.{name}", type(name, (kind,), {"__init__": noting}))
    with ElsewherePool(devices) as pool:
        assert encode(scene, cameras, options, device=devices[0], pool=pool).data == expected
    assert made.count("NamedSplats") == 2
    assert made.count("SeenRasterizer") == 2 * 3  # two re-fits, of two workers and of the master
    assert [device.allocated for device in devices] == [0] * 3


def test_neighbours_go_to_the_same():
    scene, cameras, visibility = visible_of_a_street()
    dealt = ViewShares.of(cameras, visibility, [1.0, 1.0], scene, np.arange(len(scene)))
    numbers = [share.numbers for share in dealt.shares]
    assert sorted(chain(*numbers)) == list(range(len(cameras)))
    assert all(own == sorted(own) for own in numbers)
    least = min(len(share.splats) for share in dealt.shares)
    assert least < 0.75 * len(scene)
    in_turn = [visibility.of_views(range(first, len(cameras), 2))[0] for first in range(2)]
    assert sum(len(share.splats) for share in dealt.shares) < 0.9 * sum(map(len, in_turn))


def test_twice_as_fast_gets_twice_as_much():
    scene, cameras = street(8, across=True)
    visibility = Visibility.of(scene, cameras, INRIA.near)
    work = [int(visibility.totals[own].sum()) for own in visibility.dealt([2.0, 1.0])]
    assert 1.4 < work[0] / work[1] < 2.8


def test_a_share_names_its_splats_by_their_places():
    _, _, visibility = visible_of_a_street()
    splats, own = visibility.of_views([3, 4])
    assert np.array_equal(splats, visibility.groups.splats(visibility.seen[3] | visibility.seen[4]))
    assert own.totals[3] == visibility.totals[3]
    assert own.totals[4] == visibility.totals[4]
    assert np.array_equal(splats[own.groups.splats(own.seen[3])], visibility.groups.splats(visibility.seen[3]))


def test_views_that_see_nothing_have_a_share_too():
    scene, cameras, _ = visible_of_a_street()
    away = dataclasses.replace(cameras[0], translation=cameras[0].translation + np.array([0, 0, -500.0]))
    visibility = Visibility.of(scene, [*cameras, away, away], INRIA.near)
    assert visibility.totals[-1] == 0
    splats, _ = visibility.of_views([len(cameras)])
    assert len(splats) > 0
    assert all(len(each.splats) for each in visibility.clusters([len(cameras), len(cameras) + 1]))


def test_an_excerpt_arrives_as_a_scene():
    scene, *_ = visible_of_a_street()
    sent = SceneSubset(scene, np.array([3, 5, 900]))
    there = pickle.loads(pickle.dumps(sent))
    assert type(there) is type(scene)
    assert np.array_equal(there.sh, scene.sh[[3, 5, 900]])
    assert sent.nbytes == there.nbytes
