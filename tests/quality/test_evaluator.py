"""Judging: which views, and figures that are those of the pictures."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.opencl.device import Device
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import render
from tests.reference.scenes import random_scene, ring_of_cameras

CAMERAS = ring_of_cameras(8)
SCENE = random_scene(80, 1)
WORSE = dataclasses.replace(SCENE, sh=SCENE.sh * np.float32(0.9))


def only_training(count):
    return [dataclasses.replace(camera, split="train") for camera in ring_of_cameras(count)]


@pytest.fixture
def evaluator():
    device = Device()
    with Evaluator(device, SCENE, EvaluationViews.of(CAMERAS), (0.2, 0.0, 0.0)) as evaluator:
        yield evaluator
    assert device.allocated == 0


def test_test_views_judge_where_there_are_any():
    """And a few training views stand beside them."""
    views = EvaluationViews.of(CAMERAS)
    assert (views.kind, [view.name for view in views.views]) == ("test", ["view_0", "view_4"])
    assert str(views) == "2 held-out test views"
    assert [view.name for view in views.beside] == ["view_1", "view_3", "view_5", "view_7"]
    assert len(EvaluationViews.of(ring_of_cameras(400)).beside) == 12
    assert len(EvaluationViews.of(ring_of_cameras(1000)).beside) == 16
    held_out = [dataclasses.replace(camera, split="test") for camera in CAMERAS]
    assert (EvaluationViews.of(held_out).views, EvaluationViews.of(held_out).beside) == (held_out, ())


def test_training_views_stand_in_and_that_is_said():
    views = EvaluationViews.of(only_training(5))
    assert (views.kind, len(views.views), views.beside) == ("train", 5, ())
    assert str(views) == "all 5 training views, for the cameras name no test views"
    views = EvaluationViews.of(only_training(100))
    assert (views.kind, len(views.views), views.available) == ("train", 32, 100)
    names = [view.name for view in views.views]
    assert (names[0], names[-1], len(set(names))) == ("view_0", "view_99", 32)
    assert str(views).startswith("32 of 100 training views")


def test_no_view_at_all():
    with pytest.raises(UsageError):
        EvaluationViews.of([])


def test_figures_are_those_of_the_pictures(evaluator):
    """Of test views, and of views beside, which are judged by themselves."""

    def expected(cameras):
        shown = ([render(scene, c, background=(0.2, 0, 0))[0] for scene in (WORSE, SCENE)] for c in cameras)
        return [psnr(*pair) for pair in shown]

    tests = expected([CAMERAS[0], CAMERAS[4]])
    assert evaluator.psnr(WORSE) == pytest.approx(np.mean(tests), abs=2e-6)
    assert evaluator.psnr(WORSE, most=1) == pytest.approx(tests[0], abs=2e-6)
    assert evaluator.psnr(SCENE) == math.inf
    done = []
    comparison, beside = evaluator.judge(WORSE, lambda _stage, part: done.append(part))
    assert [view.figures["b_against_a"].psnr for view in comparison.views] == pytest.approx(tests, abs=2e-6)
    assert beside == pytest.approx(np.mean(expected(evaluator.views.beside)), abs=1e-3)
    assert done[-1] == 1
    assert evaluator.judge(SCENE, lambda _stage, part: None)[1] == math.inf


def test_pictures_that_are_not_kept_are_the_same(evaluator, monkeypatch):
    kept = evaluator.psnr(WORSE), evaluator.psnr(WORSE)
    monkeypatch.setattr("potr_cl.quality.judging.CACHED_PICTURES", 0)
    with Evaluator(Device(), SCENE, evaluator.views, (0.2, 0.0, 0.0)) as other:
        assert (other.psnr(WORSE), other.psnr(WORSE)) == kept


def test_pictures(evaluator):
    ((reference, candidate),) = evaluator.pictures(WORSE, [evaluator.views.named("view_4")])
    assert np.array_equal(reference, render(SCENE, CAMERAS[4], background=(0.2, 0, 0))[0])
    assert np.array_equal(candidate, render(WORSE, CAMERAS[4], background=(0.2, 0, 0))[0])
    with pytest.raises(UsageError, match=r"no view 'view_1' among the 2 held-out test views"):
        evaluator.views.named("view_1")
