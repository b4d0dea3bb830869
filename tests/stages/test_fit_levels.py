"""Levels of opacities and scales by what an error costs and what they take: of what a fit leaves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.camera import resized, train_views
from potr_cl.outputs.output import Request
from potr_cl.outputs.potr import Potr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.reference.scenes import ring_of_cameras, visible_scene
from potr_cl.stages.fitting.cheap_levels import with_cheap_levels
from potr_cl.stages.fitting.curvature import curvatures
from potr_cl.stages.fitting.parameters import in_form_of_files
from tests.devices import FAMILIES, open_device

PARAMETERS = HyperParameters.from_quality(0.3, "best")


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "memory was not given back"


@pytest.fixture(scope="module")
def views(plush_excerpt_cameras):
    return [resized(camera, 120, 90) for camera in train_views(plush_excerpt_cameras)]


def pictures(device, scene, views):
    with Rasterizer(device, scene) as rasterizer:
        return [rasterizer.render(view)[0].astype(np.float64) for view in views]


def error(some, others):
    return np.mean([np.mean((one - other) ** 2) for one, other in zip(some, others, strict=True)])


@pytest.mark.parametrize("column", [1, 4, 10])
def test_curvatures_are_what_an_error_costs(device, column):
    """Of centres, scales and opacities, by the pictures themselves; views of two sizes."""
    source = visible_scene(12, 1, seed=3)
    cameras = [*ring_of_cameras(6, size=48), *ring_of_cameras(6, size=96)]
    found = curvatures(device, source, cameras)[column]
    assert found.shape == (12,)
    name, axis = {1: ("means", 1), 4: ("log_scales", 1), 10: ("opacity_logits", None)}[column]
    before, step = pictures(device, source, cameras), 2e-3
    expected = np.empty(12)
    for k in range(12):
        array = getattr(source, name).copy()
        array[(k,) if axis is None else (k, axis)] += step
        expected[k] = error(pictures(device, dataclasses.replace(source, **{name: array}), cameras), before) / step**2
    assert found.sum() == pytest.approx(expected.sum(), rel=0.4), "each is an average of some draws"
    assert np.corrcoef(np.log(found), np.log(expected))[0, 1] > 0.9


def test_levels_that_nobody_sees_are_usual_ones(device, plush_excerpt, views):
    """Fewer bytes for opacities and scales, for hardly more error than the nearest levels make."""
    scene = in_form_of_files(plush_excerpt)
    output, request = Potr(), Request(PARAMETERS, views)
    nearest = output.geometry(scene, request)
    cheap = with_cheap_levels(nearest, scene, curvatures(device, scene, views), PARAMETERS.drop / 10)
    assert np.array_equal(cheap.order, nearest.order)
    before = pictures(device, scene, views)
    errors, sizes = [], []
    for geometry in (nearest, cheap):
        errors.append(error(pictures(device, geometry.decoded(scene.sh), views), before))
        data = b"".join(output.file(scene, geometry, request).pieces)
        decoded = output.read(data).log_scales
        assert np.array_equal(decoded, geometry.decoded(scene.sh).log_scales[geometry.order])
        parts = output.properties(data)
        sizes.append(parts["opacity"] + parts["scale"])
    assert sizes[1] < 0.98 * sizes[0]
    assert errors[1] < 1.1 * errors[0]


def test_bits_that_cost_nothing_leave_the_nearest_levels(device, plush_excerpt, views):
    scene = in_form_of_files(plush_excerpt)
    nearest = Potr().geometry(scene, Request(PARAMETERS, views))
    same = with_cheap_levels(nearest, scene, np.ones((11, len(scene))), 0.0)
    assert np.array_equal(same.opacities, nearest.opacities)
    wanted = np.exp(scene.log_scales)
    off = [np.abs(np.exp(each.decoded(scene.sh).log_scales) - wanted) for each in (same, nearest)]
    assert np.all(off[0] <= off[1] * (1 + 1e-5)), "as near, or nearer where a level of 0 stands for a quarter"
    assert np.mean(off[0] < off[1] * (1 - 1e-5)) < 0.05
