"""A re-fit to photographs is kept where photographs that it has not seen are matched better for it."""

from __future__ import annotations

import pytest

from potr_cl.errors import UsageError
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.held_out import PhotographChoice, hold_out
from tests.cases.photographs import photographed_scene, photographs
from tests.reference.scenes import ring_of_cameras


@pytest.fixture(scope="module")
def device():
    return Device()


@pytest.fixture(scope="module")
def scene():
    return photographed_scene()


@pytest.fixture(scope="module")
def cameras():
    return ring_of_cameras(12, size=48)


def dimmed(picture, generator):
    """What a camera of less exposure sees."""
    return 0.7 * picture


def noisy(picture, generator):
    return picture + generator.normal(0, 0.3, picture.shape)


def encoded(scene, cameras, device, folder, **changes):
    changes = {"prune": {"iterations": 2}, **changes}
    options = EncodeOptions().changed(refit={"ground_truth": folder}, **changes)
    return encode(scene, cameras, options, device=device)


def test_photographs_that_agree_with_each_other_are_fitted_to(tmp_path, scene, cameras, device):
    folder = photographs(tmp_path, device, scene, cameras, dimmed)
    choice = encoded(scene, cameras, device, folder).photographs
    assert choice.kept
    assert choice.held_out == 1
    assert choice.fitted > choice.rendered + 3
    assert "those fitted to photographs are kept" in str(choice)


def test_added_views_do_not_hold_the_colours_back_from_photographs(tmp_path, scene, cameras, device):
    """Their renders, as targets beside photographs, would: held-out photographs were matched many decibels worse."""
    folder = photographs(tmp_path, device, scene, cameras, dimmed)
    with_them, without = (encoded(scene, cameras, device, folder, between={"views": views}) for views in (2, 0))
    assert with_them.between.added > 0
    assert with_them.photographs.kept
    assert with_them.photographs.fitted > without.photographs.fitted - 1


def test_photographs_of_noise_are_not_fitted_to(tmp_path, scene, cameras, device):
    """The file is then that of an encode that never heard of photographs."""
    folder = photographs(tmp_path, device, scene, cameras, noisy)
    made = encoded(scene, cameras, device, folder)
    assert not made.photographs.kept
    assert made.photographs.fitted < made.photographs.rendered
    plain = encode(scene, cameras, EncodeOptions().changed(prune={"iterations": 2}), device=device)
    assert plain.photographs is None
    assert b"".join(made.pieces) == b"".join(plain.pieces)


def test_a_view_without_a_photograph_is_left_out(tmp_path, scene, cameras, device):
    folder = photographs(tmp_path, device, scene, cameras, dimmed)
    (folder / f"{train_views(cameras)[3].name}.png").unlink()
    assert encoded(scene, cameras, device, folder).photographs.kept


def test_one_photograph_is_not_enough(tmp_path, scene, cameras, device):
    folder = photographs(tmp_path, device, scene, train_views(cameras)[:1])
    with pytest.raises(UsageError, match="--photos has 1 of the training views: two are needed"):
        encoded(scene, cameras, device, folder)


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
