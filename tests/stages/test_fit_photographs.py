"""The fit to photographs: files come nearer to photographs that nobody has seen than the scene, or it is left out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model.camera import test_views as views_to_judge
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.held_out import hold_out
from tests.cases.photographs import photographed_scene, photographs
from tests.reference.scenes import ring_of_cameras


@pytest.fixture(scope="module")
def device():
    return Device()


@pytest.fixture(scope="module")
def scene():
    return photographed_scene()


@pytest.fixture(scope="module")
def moved(scene):
    """What a trained scene is to the truth: near, but not the same."""
    rng = np.random.default_rng(3)
    return dataclasses.replace(
        scene, means=scene.means + rng.normal(scale=0.02, size=scene.means.shape).astype(np.float32)
    )


@pytest.fixture(scope="module")
def cameras():
    return ring_of_cameras(32, size=48)


def noisy(picture, generator):
    """Where nothing is cut at black and white, noise has no mean that could be learnt."""
    room = np.minimum(picture, 1 - picture).clip(0, 1)
    return picture + room * generator.uniform(-1, 1, picture.shape)


def encoded(scene, cameras, device, folder, steps=60, fit=20, **changes):
    options = EncodeOptions(q=0.8).changed(**{"prune": {"iterations": 2}, **changes})
    options = options.changed(fit={"steps": fit, "between": 0, "photograph_steps": steps})
    return encode(scene, cameras, options.changed(refit={"ground_truth": folder}), device=device)


def against_photographs(device, folder, scene, cameras):
    views = views_to_judge(cameras)
    with Rasterizer(device, scene) as rasterizer:
        return GroundTruth(folder, views).psnr(rasterizer, views)


@pytest.fixture(scope="module")
def of_the_truth(tmp_path_factory, device, scene, cameras):
    return photographs(tmp_path_factory.mktemp("photographs"), device, scene, cameras)


@pytest.fixture(scope="module")
def made(of_the_truth, device, moved, cameras):
    return encoded(moved, cameras, device, of_the_truth)


@pytest.mark.slow
@pytest.mark.parametrize("usual", [True, False])
def test_the_file_is_nearer_to_unseen_photographs_than_the_scene(of_the_truth, device, moved, cameras, made, usual):
    """Whether the fit to the scene's own pictures before it is taken, or left out of a scene that is not pruned."""
    if not usual:
        made = encoded(moved, cameras, device, of_the_truth, fit=2, prune={"on": False})
    told = made.fitted.photographs
    assert told.scene is not None
    assert told.photographs == len(train_views(cameras))
    assert told.errors[-1] < 0.7 * told.errors[0]
    before, after = (against_photographs(device, of_the_truth, each, cameras) for each in (moved, made.scene))
    assert after > before + 1
    assert f"to {told.photographs} photographs in {told.steps} steps" in str(made.fitted)
    if usual:
        assert encoded(moved, cameras, device, of_the_truth).data == made.data


def test_the_refit_comes_back_to_what_was_fitted(device, moved, cameras, made):
    """It looks at its pictures, also from between the photographs, and not at the scene's, or at photographs again."""
    assert made.photographs is None
    views = views_to_judge(cameras)
    with Rasterizer(device, made.scene) as file:
        shown = [file.render(camera)[0] for camera in views]
    errors = []
    for each in (made.fitted.photographs.scene, moved):
        with Rasterizer(device, each) as rasterizer:
            differences = [rasterizer.render(c)[0] - s for c, s in zip(views, shown, strict=True)]
        errors.append(float(np.mean(np.square(differences))))
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.slow
def test_photographs_of_noise_are_not_fitted_to(tmp_path, device, scene, cameras):
    """The file is then that of an encode that never heard of photographs, but for what the re-fit finds."""
    folder = photographs(tmp_path, device, scene, cameras, noisy)
    made = encoded(scene, cameras, device, folder)
    told = made.fitted.photographs
    assert told.scene is None
    assert told.steps == 0
    assert "was not fitted to photographs" in str(made.fitted)
    assert not made.photographs.kept
    plain = EncodeOptions(q=0.8).changed(prune={"iterations": 2}, fit={"steps": 20, "between": 0})
    assert made.data == encode(scene, cameras, plain, device=device).data


def test_photographs_that_lead_elsewhere_are_not_fitted_to(tmp_path, device, scene, cameras):
    """Those that judge show the scene, all others its negative."""
    fit_to, judging = hold_out(train_views(cameras))
    photographs(tmp_path, device, dataclasses.replace(scene, sh=-scene.sh), fit_to)
    photographs(tmp_path, device, scene, judging)
    told = encoded(scene, cameras, device, tmp_path).fitted.photographs
    assert told.scene is None
    assert min(told.trial[1:]) > told.trial[0]
