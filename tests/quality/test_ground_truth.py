"""Photographs as a judge and as targets of the re-fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.images import to_8_bits, write_png
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics import psnr
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views.targets import PhotographTargets, RenderedTargets
from tests.reference.scenes import random_scene, ring_of_cameras


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0


@pytest.fixture
def scene():
    scene = random_scene(60, 1)
    return dataclasses.replace(scene, log_scales=np.full((60, 3), -2, np.float32))


@pytest.fixture
def cameras():
    cameras = ring_of_cameras(6, size=32)
    return [*cameras[:5], dataclasses.replace(cameras[5], width=20, height=16, cx=10.0, cy=8.0)]


@pytest.fixture
def folder(tmp_path, device, scene, cameras):
    """The scene's own pictures."""
    with Rasterizer(device, scene) as rasterizer:
        for camera in cameras:
            with (tmp_path / f"{camera.name}.png").open("wb") as file:
                write_png(file, to_8_bits(rasterizer.render(camera)[0]))
    return tmp_path


def test_psnr_is_the_mean_over_the_views(device, scene, cameras, folder):
    ground_truth = GroundTruth(folder, cameras)
    with Rasterizer(device, dataclasses.replace(scene, sh=scene.sh + np.float32(0.1))) as rasterizer:
        wanted = np.mean([psnr(rasterizer.render(c)[0], ground_truth.picture(c)) for c in cameras[:2]])
        assert ground_truth.psnr(rasterizer, cameras[:2]) == pytest.approx(wanted)


def test_a_refit_to_ground_truth_is_one_to_what_they_show(device, scene, cameras, folder):
    """8 bits are all that tells the photographs from the pictures."""
    dimmed = dataclasses.replace(scene, sh=scene.sh * np.float32(0.5))
    options = RefitOptions(steps=20, gain=0, prior=1)
    targets = PhotographTargets(device, GroundTruth(folder, cameras), cameras)
    refitted = refit_colours(device, dimmed, cameras, targets, options)
    with Rasterizer(device, scene) as rasterizer:
        wanted = refit_colours(device, dimmed, cameras, RenderedTargets(rasterizer, cameras), options)
    assert refitted.errors[1] < 0.1 * refitted.errors[0]
    assert refitted.errors == pytest.approx(wanted.errors, abs=1e-4)
    assert np.abs(refitted.sh - wanted.sh).mean() < 0.1 * np.abs(refitted.sh - dimmed.sh).mean()


def test_ground_truth_that_are_not_there_or_of_another_size(cameras, folder):
    larger = dataclasses.replace(cameras[0], width=64)
    with pytest.raises(UsageError, match=r"is 32 x 32 pixels, view 'view_0' of the cameras is 64 x 32"):
        GroundTruth(folder, [larger])
    for photograph in folder.iterdir():
        photograph.unlink()
    with pytest.raises(UsageError, match=r"no photograph of any of the 6 views: .* as 'view_0'"):
        GroundTruth(folder, cameras)


def test_views_without_a_photograph_are_left_out(cameras, folder):
    assert GroundTruth(folder, cameras).missing is None
    (folder / "view_3.png").unlink()
    ground_truth = GroundTruth(folder, cameras)
    assert [camera.name for camera in ground_truth.of(cameras)] == ["view_0", "view_1", "view_2", "view_4", "view_5"]
    assert ground_truth.missing == "view 'view_3' has no photograph and is left out"
    (folder / "view_1.png").unlink()
    assert GroundTruth(folder, cameras).missing == ("2 views, such as 'view_1', have no photograph and are left out")
    elsewhere = [*cameras[:1], dataclasses.replace(cameras[1], name="other/view_1")]
    assert GroundTruth(folder, elsewhere).of(elsewhere) == elsewhere[:1]


def test_a_damaged_photograph(device, scene, cameras, folder):
    whole = (folder / "view_2.png").read_bytes()
    (folder / "view_2.png").write_bytes(whole[: len(whole) // 2])
    targets = PhotographTargets(device, GroundTruth(folder, cameras), cameras)
    with pytest.raises(DataError, match=r"view_2\.png"):
        refit_colours(device, scene, cameras, targets)
