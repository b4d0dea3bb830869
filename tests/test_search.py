"""Encoding to a size or a PSNR: targets are met, never passed, and impossible ones are refused."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from potr_cl.compaction import ViewWeights
from potr_cl.compare import compare, mean_view
from potr_cl.decoder import PotrFile, decode
from potr_cl.device import Device
from potr_cl.encoder import encode
from potr_cl.errors import UnreachableError, UsageError
from potr_cl.options import EncodeOptions
from potr_cl.quantize import PRESETS, HyperParameters
from potr_cl.rasterizer import Rasterizer
from potr_cl.removal import SweepOptions
from potr_cl.search import _SAME, Target, _Axis, _of_splats, _solve, _with_steps, encode_to_target
from tests.scenes import random_scene, ring_of_cameras

FEW = EncodeOptions(iterations=6)
AXIS = _Axis(FEW)


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0, "a search did not give all its memory back"


@pytest.fixture(scope="module")
def cameras(lego_excerpt_cameras):
    return lego_excerpt_cameras


def psnr(device, scene, file, cameras):
    a, b = Rasterizer(device, scene), Rasterizer(device, decode(file))
    views = compare(a, b, [camera for camera in cameras if camera.split == "test"]).views
    a.free()
    b.free()
    return mean_view(views).figures["b_against_a"].psnr


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("size", [18_000, 24_000])
def test_a_size_is_filled_and_not_passed(device, lego_excerpt, cameras, size, preset):
    lines = []
    options = EncodeOptions.for_preset(preset, iterations=6)
    found = encode_to_target(lego_excerpt, cameras, Target(max_bytes=size), options, device=device, tell=lines.append)
    file = b"".join(found.encoded.pieces)
    assert 0.98 * size <= len(file) <= size
    assert len(file) == found.encoded.nbytes == round(math.exp(found.value))
    assert len(decode(file)) == len(found.encoded.order) == found.encoded.pruned.kept
    assert len(lines) == len(found.tries)
    assert sum(step.kind == "encode" for step in found.tries) <= 4


@pytest.mark.parametrize("target", [Target(max_bytes=24_000), Target(min_psnr=46)])
def test_colours_may_be_refitted(device, lego_excerpt, cameras, target):
    """The estimates leave that out."""
    options = dataclasses.replace(FEW, compact=False, refit=3, drop=1e-10)
    found = encode_to_target(lego_excerpt, cameras, target, options, device=device)
    low, high = target.window
    assert low <= found.value <= high
    assert found.encoded.refitted is not None


@pytest.mark.parametrize(("preset", "wanted"), [("paper", 38.0), ("paper", 45.0), ("best", 46.0)])
def test_a_psnr_is_reached_with_little_to_spare(device, lego_excerpt, cameras, preset, wanted):
    options = EncodeOptions.for_preset(preset, iterations=6)
    found = encode_to_target(lego_excerpt, cameras, Target(min_psnr=wanted), options, device=device)
    reached = psnr(device, lego_excerpt, b"".join(found.encoded.pieces), cameras)
    assert wanted <= reached <= wanted + 0.1
    assert found.value == pytest.approx(reached)


def test_only_the_steps_of_the_quantiser_may_be_of_another_q(device, lego_excerpt, cameras):
    runs = (
        encode_to_target(lego_excerpt, cameras, Target(max_bytes=size), FEW, device=device)
        for size in range(16_000, 30_000, 1_000)
    )
    found = next(run for run in runs if run.tries[-1].kind == "steps")
    pruned = encode(lego_excerpt, cameras, dataclasses.replace(FEW, q=found.options.q), device=device).pruned
    assert np.array_equal(pruned.survivors, found.encoded.pruned.survivors)
    header = PotrFile.from_bytes(b"".join(found.encoded.pieces)).header
    assert header.sf_ac == found.options.sf_sh == pytest.approx(1 + 100 * found.tries[-1].q)
    parameters = HyperParameters.from_quality(found.options.q)
    for name in ("lam", "alpha", "delta_mse_max"):
        assert getattr(found.options.parameters, name) == getattr(parameters, name)


def test_the_same_file_every_time(device, lego_excerpt, cameras):
    target = Target(max_bytes=20_000)
    runs = [encode_to_target(lego_excerpt, cameras, target, FEW, device=device) for _ in range(2)]
    assert runs[0].encoded.pieces == runs[1].encoded.pieces
    assert runs[0].tries == runs[1].tries


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (
            Target(max_bytes=1000),
            "at most 1,000 bytes cannot be .*: quality 0 gives .* bytes, quality 1 gives about .*",
        ),
        (Target(min_psnr=90), "at least 90 dB cannot be reached: quality 0 gives about .* dB, quality 1 gives 4.* dB"),
    ],
)
def test_targets_out_of_reach(device, lego_excerpt, cameras, target, said):
    with pytest.raises(UnreachableError, match=said):
        encode_to_target(lego_excerpt, cameras, target, FEW, device=device)


def test_targets_that_every_quality_meets(device, lego_excerpt, cameras):
    best = encode_to_target(lego_excerpt, cameras, Target(max_bytes=10**7), FEW, device=device)
    assert best.options.q == 1
    smallest = encode_to_target(lego_excerpt, cameras, Target(min_psnr=5), FEW, device=device)
    assert smallest.options.q == 0


def test_without_cameras_the_quantiser_alone_is_left(lego_excerpt):
    options = dataclasses.replace(FEW, prune=False, compact=False)
    found = encode_to_target(lego_excerpt, None, Target(max_bytes=25_000), options)
    assert 24_500 <= found.encoded.nbytes <= 25_000
    assert len(found.encoded.order) == len(lego_excerpt)
    with pytest.raises(UsageError, match="cameras"):
        encode_to_target(lego_excerpt, None, Target(min_psnr=40), options)


def test_what_is_given_stays(device, lego_excerpt, cameras):
    options = dataclasses.replace(FEW, count=500, sf_scale=777.0, sweep=SweepOptions(memory=0))
    found = encode_to_target(lego_excerpt, cameras, Target(max_bytes=9_000), options, device=device)
    assert len(found.encoded.order) == 500
    assert found.options.parameters.sf_scale == 777
    assert 8_820 <= found.encoded.nbytes <= 9_000


def test_nothing_to_see(device):
    """Identical pictures have an infinite PSNR."""
    scene = random_scene(60, 1)
    away = [dataclasses.replace(c, translation=np.array([0, 0, -50.0])) for c in ring_of_cameras(4)]
    found = encode_to_target(scene, away, Target(min_psnr=40), FEW, device=device)
    assert found.value == 200


@pytest.mark.parametrize("bad", [{}, {"max_bytes": 1, "min_psnr": 1.0}, {"max_bytes": 0}, {"min_psnr": math.nan}])
def test_bad_targets(bad):
    with pytest.raises(UsageError):
        Target(**bad)


@settings(deadline=None)
@given(st.floats(0, 1), st.floats(0.5, 3), st.floats(0.5, 6), st.integers(0, 100))
@example(root=0.01, curve=0.5, steepness=3.0, first=0)
def test_growing_functions_are_solved(root, curve, steepness, first):
    end = AXIS.fineness(1)
    target = Target(max_bytes=1_000_000)
    low, high = target.window
    # What passes by the whole window between two qualities that count as the same has no solution.
    apart = _SAME / end
    assume(steepness * ((root + apart) ** curve - max(root - apart, 0) ** curve) < high - low)
    asked = []

    def value(q):
        asked.append(q)
        return target.aim + steepness * ((AXIS.fineness(q) / end) ** curve - root**curve)

    q, reached = _solve(value, target.aim, target, AXIS, first / 100)
    assert reached == target.aim + steepness * ((AXIS.fineness(q) / end) ** curve - root**curve)
    assert low <= reached <= high
    assert len(asked) <= 12


@settings(deadline=None)
@given(st.floats(0.01, 5), st.integers(0, 100))
def test_a_root_beyond_an_end_gives_the_end(beyond, first):
    target = Target(min_psnr=40)
    assert _solve(lambda q: target.aim + 20 * (q - 1 - beyond), target.aim, target, AXIS, first / 100)[0] == 1
    assert _solve(lambda q: target.aim + 20 * (q + beyond), target.aim, target, AXIS, first / 100)[0] == 0


def test_qualities_from_fineness():
    for axis in (AXIS, _Axis(dataclasses.replace(FEW, sf_sh=7.0))):
        for q in (0, 0.00123, 0.1, 0.5, 1):
            assert axis.quality(axis.fineness(q)) == pytest.approx(q, abs=1e-5)
        assert axis.quality(axis.fineness(0) - 1) == 0
        assert axis.quality(axis.fineness(1) + 1) == 1


def test_steps_of_another_quality():
    given = dataclasses.replace(FEW, q=0.5, sf_scale=9.0)
    mixed, finer = _with_steps(given, 0.7).parameters, dataclasses.replace(given, q=0.7).parameters
    for field in dataclasses.fields(mixed):
        source = finer if field.name.startswith("sf_") or field.name in ("beta", "gamma") else given.parameters
        assert getattr(mixed, field.name) == getattr(source, field.name), field.name


def test_weights_of_some_splats():
    rng = np.random.default_rng(0)
    offsets = np.concatenate([[0], np.cumsum(rng.integers(0, 7, 50))])
    weights = ViewWeights(offsets, rng.permutation(offsets[-1]).astype(np.int32), rng.random(offsets[-1], np.float32))
    some = np.array([3, 4, 20, 49])
    part = _of_splats(weights, some)
    for place, splat in enumerate(some):
        ours, theirs = (slice(w.offsets[k], w.offsets[k + 1]) for w, k in ((part, place), (weights, splat)))
        assert np.array_equal(part.views[ours], weights.views[theirs])
        assert np.array_equal(part.weights[ours], weights.weights[theirs])
