"""Whole encodes with a fit: the same file where it is left out, and searches for a size or a quality with it."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import pytest

from potr_cl.host.threads import BACKGROUND
from potr_cl.model.camera import resized
from potr_cl.model.views_between import views_between
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import as_done
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import Target
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.stages.fitting.fitted import Fitted, LeftOut
from potr_cl.stages.stage import State

#: Half of the splats, so that there is something to make up for; with coarser steps files would not show it.
HALF = EncodeOptions(q=0.5).changed(prune={"keep": 0.5, "iterations": 8}, fit={"steps": 60, "rounds": 3})


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0, "an encode did not give all its memory back"


@pytest.mark.slow
def test_a_fit_that_is_left_out_says_why_and_changes_nothing(device, plush_excerpt):
    """As that of an excerpt is, whose splats are few and worth much; of virtual views, a search below of given ones."""
    views = [resized(camera, 60, 60) for camera in place_cameras(plush_excerpt, 12)]
    plain = EncodeOptions(q=0.3, cameras_anyway=True).changed(prune={"iterations": 8})
    without = encode(plush_excerpt, views, plain, device=device)
    with_it = encode(plush_excerpt, views, plain.changed(fit={"steps": 10, "rounds": 2}), device=device)
    assert isinstance(with_it.fitted, LeftOut)
    assert "did not make up" in str(with_it.fitted)
    assert with_it.data == without.data
    assert with_it.parameters == without.parameters


def psnr(device, scene, encoded, cameras):
    with Evaluator(device, scene, EvaluationViews.of(cameras), (0.0, 0.0, 0.0)) as judge:
        return judge.psnr(encoded.scene)


def test_a_fit_pays(device, plush_excerpt, plush_excerpt_cameras):
    """On test views, which neither of them has seen."""
    options = HALF.changed(prune={"keep": 0.3}, fit={"steps": 60})
    fitted, plain = (
        encode(plush_excerpt, plush_excerpt_cameras, each, device=device)
        for each in (options, options.changed(fit=False))
    )
    assert isinstance(fitted.fitted, Fitted)
    assert fitted.nbytes < 1.02 * plain.nbytes
    better, before = (psnr(device, plush_excerpt, each, plush_excerpt_cameras) for each in (fitted, plain))
    assert better > before + 0.5


def test_views_between_are_sought_beside_other_stages(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    threads = []

    def noted(*args, **how):
        threads.append(threading.current_thread().name)
        return views_between(*args, **how)

    monkeypatch.setattr("potr_cl.stages.fit.views_between", noted)
    options = HALF.changed(fit={"steps": 2, "rounds": 1, "between": 2.0, "compared": False})
    encode(plush_excerpt, plush_excerpt_cameras, options, device=device)
    assert len(threads) == 1
    assert threads[0].startswith(BACKGROUND)


@pytest.fixture(scope="module")
def half(device, plush_excerpt, plush_excerpt_cameras):
    """An encode that fits. Its clock stands still while others have the processors, as far as these do the work."""
    clock = time.process_time if device.info.kind == "cpu" else time.perf_counter
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("potr_cl.pipeline.run.time", SimpleNamespace(perf_counter=clock))
        return encode(plush_excerpt, plush_excerpt_cameras, HALF, device=device)


@pytest.mark.slow
def test_time_is_told_only_of_a_fit_that_was_asked_for(device, plush_excerpt, plush_excerpt_cameras, half):
    plain = encode(plush_excerpt, plush_excerpt_cameras, HALF.changed(fit=False, refit=False), device=device)
    assert "fit" not in plain.seconds
    assert half.fitted.files is not None
    assert half.seconds["fit"] > 0.3 * half.seconds["refit"], "that of the files that were made to see is the fit's"


@pytest.mark.slow
def test_what_makes_up_for_splats_rounds_finer(device, plush_excerpt, plush_excerpt_cameras, half):
    options = EncodeOptions(q=0.3).changed(
        prune={"delta_mse_max": 1e-7}, between={"views": 0.5}, fit={"steps": 200, "further": 0.2, "cycles": 1}
    )
    encoded = encode(plush_excerpt, plush_excerpt_cameras, options, device=device)
    assert encoded.fitted.spared > 0
    plain = options.changed(fit=False).parameters
    assert plain.sf_sh < encoded.parameters.sf_sh < 1.5 * plain.sf_sh
    assert plain.drop > encoded.parameters.drop
    assert encoded.parameters.delta_mse_max == plain.delta_mse_max
    for q in (0, 1):
        assert options.changed(q=q).parameters == options.changed(q=q, fit=False).parameters
    # What only fits rounds as q says.
    assert half.fitted.spared == 0
    assert half.parameters == HALF.changed(fit=False).parameters


@pytest.mark.slow
def test_a_search_fits(device, plush_excerpt, plush_excerpt_cameras):
    options, target = HALF.changed(prune={"keep": 0.3}, fit={"steps": 60}), Target(min_psnr=44)
    found = encode_to_target(plush_excerpt, plush_excerpt_cameras, target, options, device=device)
    assert isinstance(found.encoded.fitted, Fitted)
    low, high = target.window
    assert low <= found.value <= high
    again = encode(plush_excerpt, plush_excerpt_cameras, found.options, device=device)
    assert again.data == found.encoded.data
    assert psnr(device, plush_excerpt, again, plush_excerpt_cameras) >= target.min_psnr


@pytest.mark.slow
def test_what_files_said_of_one_quality_is_not_asked_of_another(device, plush_excerpt, plush_excerpt_cameras, half):
    """A search goes on with other qualities from what has been fitted: its last options have to make the same file."""
    coarse = HALF.changed(q=0.3)
    asked = encode(plush_excerpt, plush_excerpt_cameras, coarse, device=device)
    assert isinstance(asked.fitted, LeftOut)
    assert isinstance(half.fitted, Fitted)
    assert half.fitted.files is not None
    known = as_done(coarse, State.of(plush_excerpt).with_results(fitted=half.fitted))
    assert isinstance(encode(plush_excerpt, plush_excerpt_cameras, known, device=device).fitted, Fitted)


@pytest.mark.slow
def test_a_search_whose_fit_is_left_out_finds_what_it_finds_without(device, plush_excerpt, plush_excerpt_cameras):
    plain = EncodeOptions().changed(prune={"iterations": 8})
    options = plain.changed(fit={"steps": 10, "rounds": 2})
    target = Target(max_bytes=20_000)
    found, wanted = (
        encode_to_target(plush_excerpt, plush_excerpt_cameras, target, each, device=device) for each in (options, plain)
    )
    assert isinstance(found.encoded.fitted, LeftOut)
    assert found.encoded.data == wanted.encoded.data
    assert encode(plush_excerpt, plush_excerpt_cameras, found.options, device=device).data == found.encoded.data


@pytest.mark.slow
def test_a_search_fits_no_more_after_an_interrupt(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """Its first fit is the scout's."""
    monkeypatch.setattr("potr_cl.stages.fit.first_interrupt_asks", _Interrupted)
    found = encode_to_target(plush_excerpt, plush_excerpt_cameras, Target(max_bytes=13_000), HALF, device=device)
    assert found.encoded.fitted is None
    assert 0.98 * 13_000 <= found.encoded.nbytes <= 13_000


class _Interrupted:
    """Stands for an interrupt at the beginning."""

    def __enter__(self):
        return True

    def __exit__(self, *_):
        return None
