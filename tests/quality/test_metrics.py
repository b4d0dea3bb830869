"""PSNR, SSIM and LPIPS against their definitions, and against figures that another implementation recorded."""

from __future__ import annotations

import json
import math
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate

from potr_cl.errors import UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics import Lpips, psnr, ssim
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT


def ssim_by_definition(a, b):
    """The formula of Wang et al. 2004 with every window's weighted sums written out, zeros beyond the borders."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = 0.01**2, 0.03**2

    def mean(values):
        return np.stack([correlate(values[..., c], window, mode="constant", cval=0) for c in range(3)], axis=-1)

    x, y = a.astype(np.float64), b.astype(np.float64)
    mean_x, mean_y = mean(x), mean(y)
    variance_x, variance_y, covariance = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2, mean(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return np.mean(above / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)))


def pictures(height, width, seed, noise=0.1):
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3))
    return a, np.clip(a + noise * rng.normal(size=a.shape), 0, 1)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 80), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_ssim_is_its_definition(height, width, seed, noise):
    a, b = pictures(height, width, seed, noise)
    assert ssim(a, b) == pytest.approx(ssim_by_definition(a, b), abs=1e-10)


def test_psnr_is_its_definition():
    a, b = pictures(13, 17, 0)
    assert psnr(a, b) == pytest.approx(10 * math.log10(1 / np.mean((a - b) ** 2)), abs=1e-9)
    half = np.full((4, 4, 3), 0.5)
    assert psnr(half, half + 0.1) == pytest.approx(20, abs=1e-9)


def test_identical_and_opposite_pictures():
    a, _ = pictures(12, 12, 1)
    black, white = np.zeros((20, 20, 3)), np.ones((20, 20, 3))
    assert psnr(a, a) == math.inf
    assert ssim(a, a) == ssim(black, black) == 1
    assert ssim(black, white) == pytest.approx(ssim_by_definition(black, white), abs=1e-10)


def test_colours_are_clamped_but_not_rounded():
    a, b = pictures(12, 12, 2)
    outside = a.copy()
    outside[0, 0], outside[1, 1] = (7, -3, 1), (-0.1, 1.1, 0)
    inside = np.clip(outside, 0, 1)
    assert psnr(outside, b) == psnr(inside, b)
    assert ssim(b, outside) == ssim(b, inside)
    flat = np.full((4, 4, 3), 0.31)
    assert psnr(flat, flat + 1e-4) == pytest.approx(80, abs=1e-6)  # a fortieth of a step of 8 bits


def test_lpips_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(UsageError, match=r"pip install .*lpips"):
        Lpips()


def test_lpips_is_not_built_without_its_weights(monkeypatch, tmp_path):
    """Building the network without the file would download it."""

    def must_not_be_called(**_options):
        raise AssertionError("would download")

    enum = types.SimpleNamespace(IMAGENET1K_V1=types.SimpleNamespace(url="https://example.org/models/vgg-1234.pth"))
    modules = {
        "lpips": types.SimpleNamespace(LPIPS=must_not_be_called),
        "torch": types.SimpleNamespace(hub=types.SimpleNamespace(get_dir=lambda: str(tmp_path))),
        "torchvision": types.SimpleNamespace(models=types.SimpleNamespace(VGG16_Weights=enum)),
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    with pytest.raises(UsageError, match=r"vgg-1234.pth"):
        Lpips()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "vgg-1234.pth").write_bytes(b"damaged")
    with pytest.raises(UsageError, match="cannot be loaded: would download"):
        Lpips()


def test_lpips_orders_pictures():
    try:
        lpips = Lpips()
    except UsageError as missing:
        pytest.skip(str(missing))
    a, near = pictures(64, 80, 4, 0.02)
    _, far = pictures(64, 80, 4, 0.3)
    assert lpips(a, a) == 0
    assert 0 < lpips(near, a) < lpips(far, a)
    assert lpips(a[:15], near[:15]) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lego", "plush"])
def test_recorded_figures_of_another_renderer_and_other_metrics(name, request):
    """Test views against their photographs: the scene's makers measured with gsplat and PyTorch."""
    folder = request.getfixturevalue(name)
    recorded = json.loads((folder / "reference" / "metrics.json").read_text())["per_view"]
    cameras = {camera.name: camera for camera in load_cameras(folder / "cameras.json")}
    rasterizer = Rasterizer(Device(), load_scene(folder / "point_cloud.ply"), GSPLAT)
    for view in recorded[:: max(len(recorded) // 6, 1)]:
        camera = cameras[view["img_name"]]
        image, _ = rasterizer.render(camera)
        photograph = read_ground_truth(camera.image_path)
        assert psnr(image, photograph) == pytest.approx(view["psnr"], abs=0.01), camera.name
        assert ssim(image, photograph) == pytest.approx(view["ssim"], abs=1e-4), camera.name
