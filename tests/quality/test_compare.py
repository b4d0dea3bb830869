"""Comparing two scenes: the figures are those of the pictures, means and tables agree, photographs are found."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl.errors import UsageError
from potr_cl.formats.images import to_8_bits
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.quality.compare import (
    Comparison,
    Figures,
    SceneFile,
    ViewFigures,
    comparison_of,
    comparison_report,
    format_comparison,
    format_sizes,
    mean_view,
    side_by_side,
    size_report,
)
from potr_cl.quality.judging import Judging, Looks
from potr_cl.quality.metrics import psnr, ssim
from potr_cl.quality.photographs import find_ground_truth
from potr_cl.raster.rasterizer import Rasterizer

BACKGROUND = (0.25, 0.5, 1.0)


@pytest.fixture(scope="module")
def device():
    return Device()


@pytest.fixture(scope="module")
def scenes(plush_excerpt):
    """The excerpt, and the excerpt with other colours."""
    s = plush_excerpt
    return s, Scene(s.means, s.log_scales, s.quaternions, s.opacity_logits, s.sh * np.float32(0.9))


@pytest.fixture(scope="module")
def rasterizers(device, scenes):
    return [Rasterizer(device, scene, background=BACKGROUND) for scene in scenes]


@pytest.fixture(scope="module")
def views(plush_excerpt_cameras):
    return [c for c in plush_excerpt_cameras if c.split == "test"]


def compare(device, a, b, views, ground_truth=None, lpips=None):
    with Judging(device, a, views, Looks(BACKGROUND, ground_truth=ground_truth, lpips=lpips)) as judging:
        return comparison_of(judging.figures(b))


def comparison(*psnrs):
    views = [ViewFigures(f"v{i}", {"b_against_a": Figures(p, 0.9, None)}) for i, p in enumerate(psnrs)]
    worst = int(np.argmin(psnrs))
    return Comparison(views, worst)


def test_figures_are_those_of_the_pictures(device, scenes, rasterizers, views):
    a, b = rasterizers
    result = compare(device, *scenes, views)
    assert [view.name for view in result.views] == [view.name for view in views]
    for camera, view in zip(views, result.views, strict=True):
        picture_a, picture_b = a.render(camera)[0], b.render(camera)[0]
        figures = view.figures.pop("b_against_a")
        assert figures.psnr == pytest.approx(psnr(picture_b, picture_a), abs=2e-6)
        assert figures.ssim == pytest.approx(ssim(picture_b, picture_a), abs=1e-6)
        assert figures.lpips is None
        assert view.figures == {}
    assert result.worst == np.argmin([psnr(b.render(camera)[0], a.render(camera)[0]) for camera in views])
    assert compare(device, *scenes, views) == compare(device, *scenes, views)


def test_progress(device, scenes, views):
    stages = []
    potr_cl.compare(*scenes, views, device=device, progress=lambda stage, done: stages.append((stage, done)))
    assert stages[0] == ("comparing 3 views", 0)
    assert [done for _, done in stages[1:]] == pytest.approx([1 / 3, 2 / 3, 1])


def test_ground_truth(device, scenes, rasterizers, views, tmp_path):
    """Photographs with alpha, made of A's own pictures: composited over the background they are A's pictures again."""
    a, _ = rasterizers
    for camera in views:
        image, transmittance = a.render(camera)
        alpha = 1 - transmittance[..., None]
        own = image - np.float32(BACKGROUND) * transmittance[..., None]
        straight = own / np.where(alpha > 0, alpha, 1)
        Image.fromarray(to_8_bits(np.concatenate([straight, alpha], axis=-1))).save(tmp_path / f"{camera.name}.png")
    result = compare(device, *scenes, views, find_ground_truth(tmp_path, views))
    for view in result.views:
        f = view.figures
        assert f["a_against_truth"].psnr > 45  # what 8 bits allow
        assert f["b_against_truth"].psnr == pytest.approx(f["b_against_a"].psnr, abs=0.5)
        assert f["loss"].psnr == f["a_against_truth"].psnr - f["b_against_truth"].psnr > 0
        assert f["loss"].ssim == f["a_against_truth"].ssim - f["b_against_truth"].ssim > 0
    report = comparison_report(result)
    assert report["mean"]["loss"]["psnr"] == pytest.approx(
        np.mean([view["loss"]["psnr"] for view in report["views"]]), rel=1e-12
    )
    header = format_comparison(result).splitlines()[0]
    assert header.split("  ")[-1].strip() == "loss by photo"


def test_a_scene_against_itself(device, scenes, views):
    result = compare(device, scenes[0], scenes[0], views)
    report = json.loads(json.dumps(comparison_report(result), allow_nan=False))
    assert report["identical_views"] == 3
    assert report["mean"]["b_against_a"] == {"psnr": None, "ssim": 1}
    assert [view["b_against_a"]["psnr"] for view in report["views"]] == [None] * 3
    text = format_comparison(result)
    assert text.count("identical") == 4
    assert "inf" not in text
    assert "nan" not in text


def test_lpips_column(device, scenes, views):
    """The metric itself needs weights; any function shows that its figures arrive."""
    distances = iter([0.5, None, 0.3])
    result = compare(device, *scenes, views, lpips=lambda _image, _reference: next(distances))
    assert mean_view(result.views).figures["b_against_a"].lpips == pytest.approx(0.4)
    report = comparison_report(result)
    assert report["views"][0]["b_against_a"]["lpips"] == 0.5
    assert "lpips" not in report["views"][1]["b_against_a"]
    lines = format_comparison(result).splitlines()
    assert lines[1].split()[-1] == "LPIPS"
    assert [line.split()[-1] for line in lines[2:6]] == ["0.5000", "-", "0.3000", "0.4000"]


def test_no_view():
    with pytest.raises(UsageError, match="no view"):
        comparison_of([])


def test_identical_views_are_left_out_of_the_mean_and_said():
    result = comparison(math.inf, 40.0, 50.0)
    assert mean_view(result.views).figures["b_against_a"] == Figures(45, pytest.approx(0.9), None)
    report = comparison_report(result)
    assert (report["identical_views"], report["mean"]["b_against_a"]["psnr"]) == (1, 45)
    assert "1 of 3 views are identical" in format_comparison(result)
    assert "worst view: v1, 40.00 dB" in format_comparison(result)


def test_sizes():
    a, b = SceneFile(Path("a.ply"), 5000, 20, 3), SceneFile(Path("b.potr"), 500, 10, 3)
    assert size_report(a, b)["size_ratio"] == 10
    of_b = {"file": "b.potr", "bytes": 500, "splats": 10, "sh_degree": 3, "antialiased": False}
    assert size_report(a, b)["b"] == of_b
    assert "B is 10.0 times smaller" in format_sizes(a, b)
    assert "B is 10.0 times larger" in format_sizes(b, a)


def test_side_by_side():
    rng = np.random.default_rng(0)
    a = rng.random((30, 40, 3)).astype(np.float32)
    b = a.copy()
    b[3, 4, 1] += 0.5 - a[3, 4, 1] + 0.03  # one pixel of 1200: more than a thousandth may not be white
    a[3, 4, 1] = 0.5
    b[10:20] = np.clip(a[10:20] + 0.012, 0, 1)
    picture, factor = side_by_side(a, b)
    assert picture.shape == (30, 120, 3)
    assert np.array_equal(picture[:, :40], to_8_bits(a))
    assert np.array_equal(picture[:, 40:80], to_8_bits(b))
    assert factor == 50  # 0.012 times 50 stays below 1, times 100 would not
    heat = picture[:, 80:].astype(int)
    assert (heat[:3] == 0).all()
    assert heat[3, 4].tolist() == [255, 255, 255]
    assert heat[15, 5].tolist() == [255, pytest.approx(0.8 * 255, abs=1), 0]
    black, white = np.zeros((5, 5, 3), np.float32), np.ones((5, 5, 3), np.float32)
    assert (side_by_side(black, black)[0] == 0).all()
    picture, factor = side_by_side(black, white)
    assert factor == 1
    assert (picture[:, 5:] == 255).all()
