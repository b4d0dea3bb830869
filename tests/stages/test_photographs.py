"""Re-fits and fits to photographs are kept where photographs that they have not seen are matched better for it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.model.camera import test_views as views_to_judge
from potr_cl.model.camera import train_views
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.held_out import PhotographChoice, hold_out
from tests.cases.judging import mean_error
from tests.cases.photographs import photographed_scene, photographs
from tests.reference.scenes import ring_of_cameras

SCENE, CAMERAS, MORE = photographed_scene(), ring_of_cameras(12, size=48), ring_of_cameras(32, size=48)
#: What a trained scene is to the truth: near, but not the same.
MOVED = dataclasses.replace(
    SCENE, means=SCENE.means + np.random.default_rng(3).normal(scale=0.02, size=SCENE.means.shape).astype(np.float32)
)
FEW = {"iterations": 2}


def dimmed(picture, generator):
    """What a camera of less exposure sees."""
    return 0.7 * picture


def noisy(picture, generator):
    return picture + generator.normal(0, 0.3, picture.shape)


def noisy_within_its_range(picture, generator):
    """Where nothing is cut at black and white, noise has no mean that could be learnt."""
    room = np.minimum(picture, 1 - picture).clip(0, 1)
    return picture + room * generator.uniform(-1, 1, picture.shape)


# ------------------------------------------------------------------------------------------ the re-fit


def refitted(device, folder, **changes):
    options = EncodeOptions().changed(prune=FEW, refit={"ground_truth": folder}, **changes)
    return encode(SCENE, CAMERAS, options, device=device)


def test_photographs_that_agree_with_each_other_are_refitted_to(tmp_path, usual_device):
    """Renders of added views, as targets beside photographs, would hold the colours back by many decibels."""
    folder = photographs(tmp_path, usual_device, SCENE, CAMERAS, dimmed)
    more, plain = (refitted(usual_device, folder, between={"views": views}) for views in (2, 0))
    assert more.between.added > 0
    for choice in (more.photographs, plain.photographs):
        assert choice.kept
        assert choice.held_out == 1
        assert choice.fitted > choice.rendered + 3
        assert "those fitted to photographs are kept" in str(choice)
    assert more.photographs.fitted > plain.photographs.fitted - 1
    (folder / f"{train_views(CAMERAS)[3].name}.png").unlink()
    assert refitted(usual_device, folder).photographs.kept, "a view without a photograph is left out"


def test_photographs_of_noise_are_not_refitted_to(tmp_path, usual_device):
    """The file is then that of an encode that never heard of photographs."""
    made = refitted(usual_device, photographs(tmp_path, usual_device, SCENE, CAMERAS, noisy))
    assert not made.photographs.kept
    assert made.photographs.fitted < made.photographs.rendered
    plain = encode(SCENE, CAMERAS, EncodeOptions().changed(prune=FEW), device=usual_device)
    assert plain.photographs is None
    assert made.data == plain.data


def test_one_photograph_is_not_enough(tmp_path, usual_device):
    folder = photographs(tmp_path, usual_device, SCENE, train_views(CAMERAS)[:1])
    with pytest.raises(UsageError, match="--photos has 1 of the training views: two are needed"):
        refitted(usual_device, folder)


@pytest.mark.parametrize("number", [2, 3, 7, 8, 9, 100])
def test_held_out_photographs_are_spread(number):
    views = ring_of_cameras(number, size=8)
    fit_to, judging = hold_out(views)
    assert fit_to
    assert max(number // 9, 1) <= len(judging) <= number / 8 + 1
    assert sorted(camera.name for camera in [*fit_to, *judging]) == sorted(camera.name for camera in views)


def test_the_choice_says_what_it_is():
    assert "1 photograph held out" in str(PhotographChoice(1, 20.0, 21.0))
    assert not PhotographChoice(1, 20.0, 20.0).kept


# ------------------------------------------------------------------------------------------ the fit of all parameters


def fitted(device, scene, folder, fit=20, **changes):
    options = EncodeOptions(q=0.8).changed(**{"prune": FEW, **changes}, refit={"ground_truth": folder})
    options = options.changed(fit={"steps": fit, "between": 0, "photograph_steps": 60})
    return encode(scene, MORE, options, device=device)


@pytest.fixture(scope="module")
def of_the_truth(tmp_path_factory, usual_device):
    return photographs(tmp_path_factory.mktemp("photographs"), usual_device, SCENE, MORE)


@pytest.fixture(scope="module")
def made(of_the_truth, usual_device):
    return fitted(usual_device, MOVED, of_the_truth)


@pytest.mark.slow
@pytest.mark.parametrize("usual", [True, False])
def test_the_file_is_nearer_to_unseen_photographs_than_the_scene(of_the_truth, usual_device, made, usual):
    """Whether the fit to the scene's own pictures before it is taken, or left out of a scene that is not pruned."""
    if not usual:
        made = fitted(usual_device, MOVED, of_the_truth, fit=2, prune={"on": False})
    told, views, found = made.fitted.photographs, views_to_judge(MORE), []
    assert told.scene is not None
    assert told.photographs == len(train_views(MORE))
    assert told.errors[-1] < 0.7 * told.errors[0]
    assert f"to {told.photographs} photographs in {told.steps} steps" in str(made.fitted)
    for scene in (MOVED, made.scene):
        with Rasterizer(usual_device, scene) as rasterizer:
            found.append(GroundTruth(of_the_truth, views).psnr(rasterizer, views))
    assert found[1] > found[0] + 1
    if usual:
        assert fitted(usual_device, MOVED, of_the_truth).data == made.data


def test_the_refit_comes_back_to_what_was_fitted(usual_device, made):
    """It looks at its pictures, also from between the photographs, and not at the scene's, or at photographs again."""
    assert made.photographs is None
    views = views_to_judge(MORE)
    ours, start = (mean_error(usual_device, made.scene, each, views) for each in (made.fitted.photographs.scene, MOVED))
    assert ours < 0.2 * start


@pytest.mark.slow
def test_photographs_of_noise_are_not_fitted_to(tmp_path, usual_device):
    """The file is then that of an encode that never heard of photographs, but for what the re-fit finds."""
    folder = photographs(tmp_path, usual_device, SCENE, MORE, noisy_within_its_range)
    made = fitted(usual_device, SCENE, folder)
    told = made.fitted.photographs
    assert told.scene is None
    assert told.steps == 0
    assert "was not fitted to photographs" in str(made.fitted)
    assert not made.photographs.kept
    plain = EncodeOptions(q=0.8).changed(prune=FEW, fit={"steps": 20, "between": 0})
    assert made.data == encode(SCENE, MORE, plain, device=usual_device).data


def test_photographs_that_lead_elsewhere_are_not_fitted_to(tmp_path, usual_device):
    """Those that judge show the scene, all others its negative."""
    fit_to, judging = hold_out(train_views(MORE))
    photographs(tmp_path, usual_device, dataclasses.replace(SCENE, sh=-SCENE.sh), fit_to)
    photographs(tmp_path, usual_device, SCENE, judging)
    told = fitted(usual_device, SCENE, tmp_path).fitted.photographs
    assert told.scene is None
    assert min(told.trial[1:]) > told.trial[0]
