"""A re-fit whose vectors lie on the host and go through the device in slices: the same bits as in one piece."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages import refit as refit_stage
from potr_cl.stages.refitting import placement
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.devices import KERNELS, open_device
from tests.reference.refit_cases import Case
from tests.reference.scenes import ring_of_cameras, visible_scene

#: Slices of 256 splats, the fewest that there can be: three of the scene, and three pieces of its vectors.
SLICES = 256
SPLATS = 700


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a re-fit did not give all its memory back"


def case_of(device, degree: int = 3, count: int = SPLATS) -> Case:
    return Case(device, visible_scene(count, degree), visible_scene(200, 2, seed=7), ring_of_cameras(5, size=40))


def grid_of(count: int) -> ColourGrid:
    rng = np.random.default_rng(0)
    steps = (0.1 * 2.0 ** rng.uniform(-1, 1, (2, count))).astype(np.float32)
    return ColourGrid(steps[0], steps[1], rng.permutation(count))


def same(one, other) -> bool:
    return np.array_equal(one.sh, other.sh) and one.errors == other.errors and one.steps == other.steps


def coarse(sh, refit):
    return np.concatenate([sh[:, :1], np.round(sh[:, 1:] * 10 + refit.worth()[:, 1:, None]) / 10], axis=1)


@pytest.mark.parametrize(("degree", "memory"), [(0, 0), (2, None), pytest.param(3, 0, marks=pytest.mark.slow)])
def test_a_solution(device, degree, memory):
    options = {"steps": 6, "gain": 0.0, "drop": 1e-7, "selection_lam": 0.3, "memory": memory}
    with case_of(device, degree) as case:
        active = np.random.default_rng(1).random(case.scene.sh.shape) < 0.8
        whole = case.solve(RefitOptions(**options), active)
        sliced = case.solve(RefitOptions(**options, slices=SLICES), active)
    assert same(sliced, whole)
    assert whole.steps > 3


@pytest.mark.parametrize("way", ["colour_grid", "fix_ac"])
@pytest.mark.parametrize("resident", [0, 3, 7], ids="{} vectors on the device".format)
def test_what_a_file_holds(device, way, resident, monkeypatch):
    """Rounded in rounds, and rounded by somebody who asks what coefficients are worth."""
    monkeypatch.setattr(placement, "_FEWEST", resident)
    with case_of(device) as case:
        rounding = {"colour_grid": lambda effects: grid_of(SPLATS)} if way == "colour_grid" else {"fix_ac": coarse}

        def fitted(slices):
            options = RefitOptions(steps=4, gain=0, drop=1e-7, slices=slices)
            return refit_colours(device, case.scene, case.cameras, case.targets, options, **rounding)

        whole, sliced = fitted(None), fitted(SLICES)
    assert same(sliced, whole)


def test_a_solution_that_is_taken_back(device):
    """More than the start could be worse: then the choice is made anew, among all coefficients."""
    with case_of(device, 1) as case:
        case.scene.sh[:, 0] -= 2
        options = {"steps": 3, "gain": 0.0, "drop": 1e-3}
        whole, sliced = (case.solve(RefitOptions(**options, slices=slices)) for slices in (None, SLICES))
    assert same(sliced, whole)


def test_what_is_known_of_coefficients(device):
    with case_of(device, 2) as case:
        known = []
        for slices in (None, SLICES):
            with ColourRefit(device, case.scene, case.cameras, slices=slices) as refit:
                refit.solve(case.scene.sh, case.targets, RefitOptions(steps=2, drop=1e-7))
                known.append([refit.worth(), refit.worth_of_constants(), refit.blocks(), refit.active()])
    for whole, sliced in zip(*known, strict=True):
        assert np.array_equal(whole, sliced)


@pytest.mark.one_runtime
@pytest.mark.parametrize("count", [1, 256, 257])
def test_any_number_of_splats(device, count):
    with case_of(device, 1, count) as case:
        options = {"steps": 3, "gain": 0.0}
        whole, sliced = (case.solve(RefitOptions(**options, slices=slices)) for slices in (None, SLICES))
    assert same(sliced, whole)


@pytest.mark.slow
@pytest.mark.one_family
@pytest.mark.one_runtime
@pytest.mark.parametrize("own", [False, True], ids=["the host's memory", "memory of its own"])
def test_little_memory_is_enough(device, own, monkeypatch):
    """Vectors that are too large for the memory that is given do not come to the device: most of them are not there."""
    monkeypatch.setattr(placement, "_ANYWAY", 0)
    kind = {"kind": "gpu", "integrated": False} if own else {"kind": "cpu"}
    device = Device(dataclasses.replace(device.info, **kind), family=device.family)
    count = 20_000
    one_piece = 3400 * count
    peaks = []
    with case_of(device, 3, count) as case:
        free = device.allocated
        for memory in (None, one_piece // 2):
            with ColourRefit(device, case.scene, case.cameras, memory=memory) as refit:
                result = refit.solve(case.scene.sh, case.targets, RefitOptions(steps=1, gain=0, memory=memory))
                peaks.append((device.allocated - free, result))
    (whole, one), (sliced, other) = peaks
    assert same(one, other)
    assert sliced < 0.6 * one_piece < whole


@pytest.mark.one_runtime
def test_slices_of_nothing():
    with pytest.raises(UsageError, match="slices of 0 splats"):
        RefitOptions(slices=0)


@pytest.mark.slow
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
        monkeypatch.setattr(placement, name, 0)
    sliced = encode(plush_excerpt, small, options, device=device)
    assert sliced.data == whole.data
    assert sliced.refitted.errors == whole.refitted.errors


@pytest.mark.one_runtime
def test_memory_is_that_of_vectors_and_views_together(device, monkeypatch):
    """Also where the vectors lie on the device."""
    monkeypatch.setattr(placement, "_ANYWAY", 0)
    count = 3000
    one_piece = 3400 * count
    with case_of(device, 3, count) as case:
        free, room = device.allocated, []
        for memory in (4 * one_piece, 12 * one_piece):
            with ColourRefit(device, case.scene, case.cameras, memory=memory) as refit:
                refit.solve(case.scene.sh, case.targets, RefitOptions(steps=1, gain=0))
                assert device.allocated - free < memory
                room.append(refit.colour_map.room)
    assert room[1] - room[0] == pytest.approx(8 * one_piece, rel=0.01)
    assert room[0] < 3 * one_piece


@pytest.mark.one_family
@pytest.mark.one_runtime
def test_with_many_views(device):
    """Of which some steps look at every second one."""
    cameras = ring_of_cameras(70, size=20)
    with Case(device, visible_scene(SPLATS, 1), visible_scene(100, 1, seed=7), cameras) as case:

        def fitted(slices):
            options = RefitOptions(steps=3, gain=0, drop=1e-7, slices=slices)
            return refit_colours(
                device, case.scene, case.cameras, case.targets, options, colour_grid=lambda effects: grid_of(SPLATS)
            )

        whole, sliced = fitted(None), fitted(SLICES)
    assert same(sliced, whole)
