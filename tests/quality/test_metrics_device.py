"""PSNR and SSIM on the device against :mod:`potr_cl.quality.metrics`, which is tested against the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from potr_cl.opencl.memory import Memory
from potr_cl.quality.metrics import psnr, ssim
from potr_cl.quality.metrics_device import Similarity, in_batches, place_pictures, rendered
from potr_cl.raster.rasterizer import Rasterizer
from tests.devices import KERNELS, open_device
from tests.reference.scenes import random_splats
from tests.reference.scenes import straight_camera as camera


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    return open_device(request.param)


def sized(pictures):
    return [camera(picture.shape[1], picture.shape[0]) for picture in pictures]


def on_device(device, images, references):
    """The figures of pictures that lie one behind the other."""
    with Memory(device) as memory:
        buffers = [
            memory.upload(np.concatenate([picture.astype(np.float32).reshape(-1) for picture in some]), "pictures")
            for some in (images, references)
        ]
        pairs = zip(*(place_pictures(buffer, sized(images)) for buffer in buffers), strict=True)
        return Similarity(device)(list(pairs))


def agree(device, image, reference):
    (found,) = on_device(device, [image], [reference])
    image, reference = image.astype(np.float32), reference.astype(np.float32)
    assert found[0] == pytest.approx(psnr(image, reference), abs=2e-6)
    assert found[1] == pytest.approx(ssim(image, reference), abs=1e-6)


def noise(height, width, amplitude, seed=0):
    return amplitude * np.random.default_rng(seed).standard_normal((height, width, 3))


def test_pictures_of_any_size(device):
    """Smaller than the window, of whole tiles, and a little more or less."""
    sizes = [(1, 1), (1, 40), (40, 1), (5, 7), (16, 16), (17, 33), (32, 32), (33, 31), (31, 43), (64, 96), (75, 131)]
    for height, width in sizes:
        reference = np.random.default_rng(1).random((height, width, 3))
        agree(device, reference + noise(height, width, 0.1), reference)


def test_flat_pictures(device):
    """Where a picture has hardly any variance, and a mean that is large against it."""
    for amplitude in [1e-4, 1e-3, 1e-2, 0.3]:
        for level in [0.02, 0.5, 0.98]:
            flat = np.full((70, 90, 3), level) * np.array([1, 0.97, 0.5])
            agree(device, flat + noise(70, 90, amplitude), flat)
            agree(device, flat + noise(70, 90, amplitude), flat + noise(70, 90, amplitude, 1))
            agree(device, flat + amplitude, flat)


def test_edges_between_flat_areas(device):
    """Half of a tile is far from the value that is taken from all of it."""
    rows, columns = np.mgrid[:100, :120]
    stripes = np.stack([(rows // 9 + columns // 7) % 2, columns // 60, rows > columns], axis=-1).astype(float)
    agree(device, stripes + noise(100, 120, 1e-3), stripes)
    agree(device, stripes[::-1], stripes)
    agree(device, 1 - stripes, stripes)


def test_identical_and_opposite_pictures(device):
    black, white = np.zeros((50, 60, 3)), np.ones((50, 60, 3))
    agree(device, black, white)
    for picture in (black, white, np.random.default_rng(2).random((33, 50, 3))):
        assert on_device(device, [picture], [picture]) == [(math.inf, 1)]


def test_colours_are_clamped(device):
    reference = np.random.default_rng(3).random((40, 41, 3))
    image = reference + noise(40, 41, 0.5)
    assert image.min() < -0.5
    assert image.max() > 1.5
    agree(device, image, reference)
    figures = on_device(device, [image], [reference])
    assert figures == on_device(device, [np.clip(image, 0, 1)], [reference])


def test_several_pictures_of_several_sizes(device):
    sizes = [(20, 30), (1, 1), (45, 17), (33, 97)]
    references = [np.random.default_rng(4).random((*size, 3)) for size in sizes]
    images = [reference + noise(*reference.shape[:2], 0.05) for reference in references]
    together = on_device(device, images, references)
    apart = [on_device(device, [image], [reference])[0] for image, reference in zip(images, references, strict=True)]
    assert together == apart
    allocated = device.allocated
    assert Similarity(device)([]) == []
    assert device.allocated == allocated


def test_rendered_pictures_are_those_of_the_rasterizer(device):
    views = [camera(50, 40), camera(33, 17), camera(50, 40, 80)]
    before = device.allocated
    with Rasterizer(device, random_splats(200)) as rasterizer, rendered(rasterizer, views) as pictures:
        for view, picture in zip(views, pictures, strict=True):
            assert np.array_equal(picture.download(device), rasterizer.render(view)[0])
    assert device.allocated == before


@pytest.mark.one_runtime
def test_batches_hold_every_view_once_and_bounded_bytes(device):
    views = [camera(64, 64, focal) for focal in range(60, 160)]
    batches = list(in_batches(device, views))
    assert [view for batch in batches for view in batch] == views
    assert len(batches) == (100 if device.family == "cpu" else 4)
    three_views = 12 * 64 * 64 * 3 + 1
    found = {len(batch) for batch in in_batches(device, views, three_views)}
    assert found == ({1} if device.family == "cpu" else {3, 1})
    assert {len(batch) for batch in in_batches(device, views, most_bytes=1)} == {1}  # less than a view
