"""Encoding to a size or a PSNR: targets are met, never passed, and impossible ones are refused."""

from __future__ import annotations

import dataclasses
import logging
import math
from dataclasses import dataclass

import numpy as np
import pytest

from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder
from potr_cl.errors import UnreachableError, UsageError
from potr_cl.formats.images import to_8_bits, write_png
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import KINDS, Target
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.stage import Stage
from tests.cases import judging
from tests.devices import skip_without_cpu
from tests.reference.scenes import random_scene, ring_of_cameras

FEW = EncodeOptions.for_preset("paper", prune={"iterations": 6})


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0, "a search did not give all its memory back"


@pytest.fixture(scope="module")
def cameras(plush_excerpt_cameras):
    return plush_excerpt_cameras


def psnr(device, scene, file, cameras):
    return judging.psnr(device, scene, decode(file), [camera for camera in cameras if camera.split == "test"])


@pytest.fixture(scope="module")
def to_46_db(device, plush_excerpt, cameras):
    """A search for a PSNR in preset best, and what it has told."""
    lines = []
    options = EncodeOptions.for_preset("best", prune={"iterations": 6})
    found = encode_to_target(plush_excerpt, cameras, Target(min_psnr=46), options, device=device, tell=lines.append)
    return found, lines


def filled(found, size, lines=None):
    """Whether the file fills a size and is what the search says of it."""
    file = found.encoded.data
    assert 0.98 * size <= len(file) <= size
    assert len(file) == found.encoded.nbytes == round(math.exp(found.value))
    assert len(decode(file)) == len(found.encoded.order) == found.encoded.pruned.kept
    assert sum(step.kind == "encode" for step in found.tries) <= 4
    if lines is not None:
        assert sum(not line.startswith("fit: ") for line in lines) == len(found.tries)


@pytest.mark.slow
def test_a_size_is_filled_and_not_passed_with_a_fit(device, plush_excerpt, cameras):
    size, lines = 18_000, []
    options = EncodeOptions.for_preset("smallest", prune={"iterations": 6}, fit={"steps": 20})
    found = encode_to_target(plush_excerpt, cameras, Target(max_bytes=size), options, device=device, tell=lines.append)
    filled(found, size, lines)


@dataclass(frozen=True)
class HalfOpaque(Stage):
    """Lowers all logits of opacities."""

    name = "half opaque"
    title = ""
    needs_views = False

    def run(self, state, bench):
        scene = dataclasses.replace(state.scene, opacity_logits=state.scene.opacity_logits - np.float32(1))
        return dataclasses.replace(state, scene=scene, geometry=None)


@pytest.mark.parametrize(("preset", "place"), [("paper", 0), pytest.param("best", -1, marks=pytest.mark.slow)])
def test_a_stage_of_ones_own_takes_part_in_a_search_as_in_an_encode(device, plush_excerpt, cameras, preset, place):
    refit = {"steps": 3} if preset == "best" else False
    options = EncodeOptions.for_preset(preset, between=False, prune={"iterations": 4}, refit=refit)
    stages = list(options.stages)
    stages.insert(place, HalfOpaque())
    options = EncodeOptions(stages=tuple(stages))
    found = encode_to_target(plush_excerpt, cameras, Target(max_bytes=24_000), options, device=device)
    logits = decode(found.encoded.data).opacity_logits
    changes = logits - plush_excerpt.opacity_logits[found.encoded.order]
    assert np.median(changes) == pytest.approx(-1, abs=0.1)  # less than the quantiser's steps


@pytest.mark.slow
def test_colours_may_be_refitted_in_any_preset(device, plush_excerpt, cameras):
    options = FEW.changed(compact=False, refit={"steps": 3, "drop": 1e-10})
    found = encode_to_target(plush_excerpt, cameras, Target(max_bytes=24_000), options, device=device)
    filled(found, 24_000)
    assert found.encoded.refitted is not None


@pytest.mark.parametrize(("preset", "wanted"), [("paper", 40.0), ("best", 46.0)])
def test_a_psnr_is_reached_with_little_to_spare(device, plush_excerpt, cameras, preset, wanted, to_46_db):
    options = EncodeOptions.for_preset(preset, prune={"iterations": 6})
    if preset == "best":
        found, _ = to_46_db
    else:
        found = encode_to_target(plush_excerpt, cameras, Target(min_psnr=wanted), options, device=device)
    reached = psnr(device, plush_excerpt, found.encoded.data, cameras)
    assert wanted <= reached <= wanted + 0.1
    assert found.value == pytest.approx(reached)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "target"),
    [
        ("best", Target(max_bytes=22_000)),
        ("fast", Target(min_psnr=46)),
    ],
)
def test_what_is_found_is_what_a_plain_encode_makes(device, plush_excerpt, cameras, preset, target):
    """So it lies on the plain encodes' curve, as far as its parameters are those of one q."""
    options = EncodeOptions.for_preset(preset, prune={"iterations": 6})
    found = encode_to_target(plush_excerpt, cameras, target, options, device=device)
    if target.max_bytes is not None:
        filled(found, target.max_bytes)
    assert encode(plush_excerpt, cameras, found.options, device=device).pieces == found.encoded.pieces
    plain = options.changed(q=found.options.q)
    free = {"prune": {"delta_mse_max": None}, "code": {"sf_dc": None, "sf_sh": None}}
    assert found.options.changed(**free) == plain.changed(**free)
    pruning = math.log10(found.options.parameters.delta_mse_max / plain.parameters.delta_mse_max)
    assert abs(pruning) <= 2 * 0.12 / math.log(10) + 1e-4  # ΔMSE_MAX goes with the square of the steps
    colours = {getattr(found.options.parameters, name) / getattr(plain.parameters, name) for name in ("sf_dc", "sf_sh")}
    assert max(abs(math.log(factor)) for factor in colours) <= 0.5
    assert max(colours) == pytest.approx(min(colours))


@pytest.mark.slow
def test_a_rough_encode_comes_first_where_it_saves_time(device, plush_excerpt, cameras):
    target = Target(max_bytes=20_000)
    for options, first in (
        (FEW, "encode"),
        (FEW.changed(compact=False, prune={"iterations": 48}), "scout"),
        (EncodeOptions.for_preset("best", between=False, prune={"iterations": 6}, refit={"steps": 2}), "encode"),
        (FEW.changed(prune={"iterations": 48, "on": False}), "encode"),
    ):
        found = encode_to_target(plush_excerpt, cameras, target, options, device=device)
        kinds = [step.kind for step in found.tries]
        assert kinds[0] == first
        assert "scout" not in kinds[1:]
        assert target.inside(found.value)


def test_a_try_is_not_what_is_found_by_it(to_46_db):
    """A scout is never the result, nor is the file that a PSNR was judged by."""
    found, _ = to_46_db
    assert found.tries[0].kind == "scout"
    assert found.value in [step.value for step in found.tries[1:]]
    assert len(found.encoded.order) == found.encoded.pruned.kept
    assert open_file(found.encoded.data).blocks[0].coder == Coder.BUNDLES


def test_without_a_refit_only_the_steps_of_the_quantiser_may_be_of_another_q(device, plush_excerpt, cameras):
    runs = (
        encode_to_target(plush_excerpt, cameras, Target(max_bytes=size), FEW, device=device)
        for size in range(16_000, 30_000, 1_000)
    )
    found = next(run for run in runs if run.tries[-1].kind == "steps")
    pruned = encode(plush_excerpt, cameras, FEW.changed(q=found.options.q), device=device).pruned
    assert np.array_equal(pruned.survivors, found.encoded.pruned.survivors)
    header = open_file(found.encoded.data).blocks[0]
    assert header.sf_ac == np.float32(found.options.code.sf_sh)
    assert found.options.code.sf_sh == pytest.approx(1 + 100 * found.tries[-1].q)
    parameters = HyperParameters.from_quality(found.options.q)
    for name in ("lam", "alpha", "delta_mse_max"):
        assert getattr(found.options.parameters, name) == getattr(parameters, name)


def test_a_size_is_filled_by_the_same_file_every_time(device, plush_excerpt, cameras):
    target, lines = Target(max_bytes=20_000), []
    runs = [
        encode_to_target(plush_excerpt, cameras, target, FEW, device=device, tell=told.append) for told in (lines, [])
    ]
    filled(runs[0], 20_000, lines)
    assert runs[0].encoded.pieces == runs[1].encoded.pieces
    assert runs[0].tries == runs[1].tries


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (
            Target(max_bytes=1000),
            "cannot reach at most 1,000 bytes: quality 0 gives {} bytes, quality 1 gives {} bytes",
        ),
        (Target(min_psnr=90), "cannot reach at least 90 dB: quality 0 gives .* dB, quality 1 gives 5.* dB"),
    ],
)
def test_targets_out_of_reach(device, plush_excerpt, cameras, target, said):
    ends = (encode(plush_excerpt, cameras, FEW.changed(q=q), device=device).nbytes for q in (0.0, 1.0))
    with pytest.raises(UnreachableError, match=said.format(*(f"{nbytes:,}" for nbytes in ends))):
        encode_to_target(plush_excerpt, cameras, target, FEW, device=device)


def test_targets_that_every_quality_meets(device, plush_excerpt, cameras):
    best = encode_to_target(plush_excerpt, cameras, Target(max_bytes=10**7), FEW, device=device)
    assert best.options.q == 1
    smallest = encode_to_target(plush_excerpt, cameras, Target(min_psnr=5), FEW, device=device)
    assert smallest.options.q == 0


def test_without_cameras_the_quantiser_alone_is_left(plush_excerpt):
    options = FEW.changed(prune=False, compact=False)
    found = encode_to_target(plush_excerpt, None, Target(max_bytes=25_000), options)
    assert 24_500 <= found.encoded.nbytes <= 25_000
    assert len(found.encoded.order) == len(plush_excerpt)
    with pytest.raises(UsageError, match="cameras"):
        encode_to_target(plush_excerpt, None, Target(min_psnr=40), options)


def test_what_is_given_stays(device, plush_excerpt, cameras):
    options = FEW.changed(prune={"count": 500}, code={"sf_scale": 777.0}, memory=0)
    found = encode_to_target(plush_excerpt, cameras, Target(max_bytes=9_000), options, device=device)
    assert len(found.encoded.order) == 500
    assert found.options.parameters.sf_scale == 777
    assert 8_820 <= found.encoded.nbytes <= 9_000


def test_nothing_to_see(device):
    """Identical pictures have an infinite PSNR."""
    scene = random_scene(60, 1)
    away = [dataclasses.replace(c, translation=np.array([0, 0, -50.0])) for c in ring_of_cameras(4)]
    found = encode_to_target(scene, away, Target(min_psnr=40), FEW.changed(cameras_anyway=True), device=device)
    assert found.value == 200


@pytest.mark.slow
def test_colours_may_be_fitted_to_ground_truth(device, plush_excerpt, cameras, tmp_path):
    """Which sets a bound to the PSNR against the renders that no quality passes."""
    with Rasterizer(device, dataclasses.replace(plush_excerpt, sh=plush_excerpt.sh * np.float32(0.9))) as shown:
        for camera in (camera for camera in cameras if camera.split == "train"):
            with (tmp_path / f"{camera.name}.png").open("wb") as file:
                write_png(file, to_8_bits(shown.render(camera)[0]))
    # Views between would be fitted to renders, which are brighter than these photographs.
    options = EncodeOptions.for_preset(
        "fast", between={"views": 0}, prune={"iterations": 6}, refit={"ground_truth": tmp_path}
    )
    target = Target(min_psnr=44)
    assert target.inside(encode_to_target(plush_excerpt, cameras, target, options, device=device).value)
    with pytest.raises(UnreachableError, match="quality 1 gives 4"):
        encode_to_target(plush_excerpt, cameras, Target(min_psnr=55), options, device=device)


@pytest.mark.slow
def test_a_cpu_takes_over(plush_excerpt, cameras, caplog):
    """From a device whose memory does not hold the scene's views."""
    skip_without_cpu()
    options = FEW.changed(prune={"iterations": 3})
    target = Target(max_bytes=20_000)
    wanted = encode_to_target(plush_excerpt, cameras, target, options)
    small = Device()
    small.info = dataclasses.replace(small.info, memory=1 << 20, largest_buffer=1 << 20, kind="gpu")
    with caplog.at_level(logging.WARNING, "potr_cl"):
        found = encode_to_target(plush_excerpt, cameras, target, options, device=small)
    assert found.encoded.pieces == wanted.encoded.pieces
    assert found.encoded.device.info.kind == "cpu"
    assert small.allocated == 0
    # It is tried and given up once, not in every step of the search.
    assert sum("going on with" in record.getMessage() for record in caplog.records) == 1


@pytest.mark.parametrize("bad", [{}, {"max_bytes": 1, "min_psnr": 1.0}, {"max_bytes": 0}, {"min_psnr": math.nan}])
def test_bad_targets(bad):
    with pytest.raises(UsageError):
        Target(**bad)


def test_every_try_is_called_by_its_name(to_46_db):
    found, lines = to_46_db
    assert len(lines) == len(found.tries)
    for line, step in zip(lines, found.tries, strict=True):
        assert line == f"{KINDS[step.kind].format(f'{step.q:g}')} {step.value:.2f} dB"
