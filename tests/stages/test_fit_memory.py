"""What a fit takes of the device's memory: what is forecast, and that a budget is kept."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.model.camera import resized
from potr_cl.opencl.device import Device
from potr_cl.pipeline.forecast import fit_bytes, memory_needed
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.fit import FitOptions, Sight, fit_scene
from potr_cl.views.targets import RenderedTargets
from tests.cases.memory import taken_of


@pytest.fixture(scope="module")
def many_splats(plush_excerpt):
    """30,000 splats, so that what they take is more than what anything else does."""
    numbers = np.arange(30_000) % len(plush_excerpt)
    scene = plush_excerpt.subset(numbers)
    moved = scene.means + np.random.default_rng(0).normal(0, 0.05, scene.means.shape).astype(np.float32)
    return dataclasses.replace(scene, means=moved)


def peak(device, source, scene, views, memory):
    """Bytes of the device that a fit of a few steps took at its peak."""
    options = FitOptions(steps=4, rounds=1, memory=memory)
    with Rasterizer(device, source) as rasterizer, taken_of(device) as taken:
        fit_scene(device, scene, Sight(views, RenderedTargets(rasterizer, views)), options)
    return max(in_all for _, in_all in taken)


@pytest.mark.one_family
def test_the_peak_is_what_is_said(family_device, many_splats, small_views):
    scene = many_splats.subset(np.arange(20_000))
    with Rasterizer(family_device, scene) as rasterizer:
        before = family_device.allocated
        with rasterizer.prepare_set(small_views[:1]):
            view = family_device.allocated - before
    together = 4 if family_device.family == "gpu" else 1
    said = fit_bytes(20_000, 30_000, 48, together, len(small_views), view, 120 * 90, 1e9)
    assert 0.85 * said < peak(family_device, many_splats, scene, small_views, 10**9) < 1.15 * said


@pytest.mark.slow
@pytest.mark.one_family
def test_a_budget_of_memory_is_kept(family_device, many_splats, small_views):
    """What is kept of views is no more than the budget."""
    larger, some = [resized(view, 240, 180) for view in small_views], many_splats.subset(np.arange(3000))
    picture = 12 * 240 * 180
    least = peak(family_device, some, some, larger, 0)
    assert peak(family_device, some, some, larger, 4 * picture + 100) <= least + 4 * picture + 100
    # What nothing limits takes more.
    assert peak(family_device, some, some, larger, 10**9) > least + 4 * picture + 100


@pytest.mark.one_family
@pytest.mark.parametrize("own", [False, True], ids=["the host's memory", "memory of its own"])
def test_the_forecast_knows_of_the_fit(family_device, own, many_splats, small_views):
    """Where no view is kept; what kept views take may be more than the fit, which begins when they are gone."""
    info = dataclasses.replace(family_device.info, kind="gpu" if own else "cpu", integrated=not own)
    opened = Device(info, family=family_device.family)

    def memory(**changes):
        return memory_needed(many_splats, small_views, EncodeOptions().changed(**changes), opened)

    without, with_it = memory(memory=0), memory(memory=0, fit={"steps": 1000})
    assert with_it - without > 30_000 * 59 * 4 * 3
    assert with_it < memory(fit={"steps": 1000})
