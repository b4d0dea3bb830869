"""Antialiased scenes: what the rasterizer makes of them, against the float64 definition and against plain physics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import DataError
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer, render
from potr_cl.raster.rules import GSPLAT, INRIA, LEAST_COMPENSATION, RasterRules
from tests.cases.scenes import antialiased
from tests.raster.test_rasterizer import check, definition
from tests.reference.scenes import plain_splats, random_splats, tilted_camera
from tests.reference.scenes import straight_camera as camera


@pytest.mark.parametrize(("rules", "low_pass"), [(INRIA, MIP_SPLATTING_LOW_PASS), (GSPLAT, LOW_PASS)])
def test_against_definition(device: Device, rules: RasterRules, low_pass: float) -> None:
    scene, view = antialiased(random_splats(400, 2, seed=2), low_pass), tilted_camera(2, 83, 61)
    wanted = check(device, scene, view, rules)
    classic = definition(scene.rendered(False), view, rules)
    assert np.abs(wanted.image - classic.image).max() > 0.2  # to render it as a classic one is no small mistake


def test_needles_and_sheets_seen_edge_on(device: Device) -> None:
    """Two axes of nothing, one axis of nothing across the view and along it: the determinant is 0, or nearly."""
    scene = plain_splats([[-0.3, 0, 2], [0, 0, 2.1], [0.3, 0.1, 2.2], [0.1, -0.3, 2]], logit=8)
    scene.log_scales[:] = np.log([[0.3, 1e-7, 1e-7], [0.1, 0.1, 1e-7], [1e-7, 0.2, 0.2], [1e-9, 1e-9, 1e-9]])
    for rules in (INRIA, GSPLAT):
        check(device, antialiased(scene, smaller=0), camera(), rules)


def test_a_point_keeps_the_least_alpha(device: Device) -> None:
    """So the original and gsplat have it: an opaque splat of no extent is drawn with alpha 0.005."""
    scene = antialiased(plain_splats([0, 0, 2], sigma=1e-9, logit=15), smaller=0)
    view = dataclasses.replace(camera(33, 33), cx=16.5, cy=16.5)
    _, transmittance = render(scene, view, device, GSPLAT)
    assert 1 - transmittance[16, 16] == pytest.approx(LEAST_COMPENSATION, rel=1e-3)


@pytest.mark.parametrize("low_pass", [LOW_PASS, MIP_SPLATTING_LOW_PASS])
def test_a_splat_takes_as_much_light_as_without_a_filter(device: Device, low_pass: float) -> None:
    """Its alphas add up to opacity times 2 π times its own area on screen, in pixels, wherever in a pixel it lies; but
    for those below 1/255. A classic one takes far more."""
    for sigma in [0.15, 0.4, 1.0]:
        focal, depth, opacity = 100.0, 2.0, 0.9
        logit = np.log(opacity / (1 - opacity))
        taken = {}
        for kind in (True, False):
            scene = plain_splats([0, 0, depth], sigma=sigma * depth / focal, logit=logit)
            scene = antialiased(scene, low_pass, smaller=0).rendered(kind)
            with Rasterizer(device, scene, GSPLAT) as rasterizer:
                sums = []
                for k in range(10):
                    view = camera(48, 48, focal, fy=focal, cx=20 + k / 10, cy=22 + 3 * k % 10 / 10)
                    sums.append(1 - rasterizer.render(view)[1])
            taken[kind] = float(np.mean([s.sum(dtype=np.float64) for s in sums]))
        area = opacity * 2 * np.pi * sigma**2
        variance = sigma**2 + low_pass
        # What alphas below 1/255 would add: the integral of o exp(-r² / 2 v) beyond where it is 1/255 is 2 π v / 255.
        missing = 2 * np.pi * variance / 255
        assert taken[True] == pytest.approx(area - missing, abs=0.02 * area + 2e-3)
        assert taken[False] > 1.25 * taken[True]


def test_lists_are_made_of_what_is_left_of_an_opacity(device: Device) -> None:
    """Fewer tile intersections than of the classic scene: what no longer reaches 1/255 is on no list."""
    scene, view = antialiased(random_splats(400, 0, seed=3), smaller=2), tilted_camera(3, 83, 61)
    counts = []
    for each in (scene, scene.rendered(False)):
        with Rasterizer(device, each, GSPLAT) as rasterizer, rasterizer.prepare_set([view]) as prepared:
            counts.append(prepared.capacity)
    assert counts[0] < 0.9 * counts[1]


def test_both_kinds_on_one_device(device: Device) -> None:
    """The kernels of one do not stand in for those of the other, in whatever order they are made."""
    scene, view = antialiased(random_splats(100, 1, seed=4)), tilted_camera(4, 40, 40)
    kinds = [scene, scene.rendered(False), dataclasses.replace(scene, low_pass=MIP_SPLATTING_LOW_PASS)]
    first = [render(kind, view, device)[0] for kind in kinds]
    again = [render(kind, view, device)[0] for kind in reversed(kinds)][::-1]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not any(np.allclose(first[a], first[b], atol=1e-3) for a, b in ((0, 1), (0, 2), (1, 2)))


def test_a_keyword_renders_a_scene_otherwise(device: Device) -> None:
    scene, view = random_splats(100, 1, seed=4), tilted_camera(4, 40, 40)
    marked = dataclasses.replace(scene, antialiased=True)
    assert np.array_equal(render(scene, view, device, antialiased=True)[0], render(marked, view, device)[0])
    assert np.array_equal(render(marked, view, device, antialiased=False)[0], render(scene, view, device)[0])


@pytest.mark.parametrize(("kind", "low_pass"), [(False, MIP_SPLATTING_LOW_PASS), (True, 0.2), (True, float("nan"))])
def test_filters_that_no_scene_has(kind: bool, low_pass: float) -> None:
    with pytest.raises(DataError, match="low-pass filter"):
        dataclasses.replace(random_splats(3), antialiased=kind, low_pass=low_pass)
