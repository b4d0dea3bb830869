"""What is left is fitted once more after the choice of coefficients and after each rounding."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest

from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantize import HyperParameters
from potr_cl.outputs.ply import Ply
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.adam import Factors, in_form_of_files
from potr_cl.stages.fitting.fit import FitOptions, Sight, fit_scene
from potr_cl.stages.fitting.settling import Settling, settle
from potr_cl.stages.held_out import share_out
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.targets import RenderedTargets
from tests.cases.judging import mean_error

PARAMETERS = HyperParameters.from_quality(0.2, "best")
OPTIONS = FitOptions(steps=60)


def settled(device, scene, views, settling, **changes):
    """A state before and after, and the errors that are told."""
    bench = dataclasses.replace(Workbench(PARAMETERS, device=device), **changes)
    before = State.of(scene, views)
    with Rasterizer(device, scene) as rasterizer:
        sight = Sight(views, RenderedTargets(rasterizer, views))

        def pictures(some):
            return nullcontext(RenderedTargets(rasterizer, some))

        then, errors = settle(before, bench, sight, pictures, settling, OPTIONS)
    return before, then, errors, bench


@pytest.mark.one_family
def test_what_moves_makes_up_for_what_is_rounded(family_device, plush_excerpt, small_views):
    before, then, errors, bench = settled(family_device, plush_excerpt, small_views, Settling(0, 0.5, 1.0))
    assert isinstance(then.geometry, Geometry)
    assert then.geometry.asked == PARAMETERS
    assert len(errors) == 2
    at_once = bench.output.geometry(plush_excerpt, bench.request(before)).decoded(plush_excerpt.sh)
    in_turns = then.geometry.decoded(then.scene.sh)
    found = [mean_error(family_device, plush_excerpt, scene, small_views) for scene in (at_once, in_turns)]
    assert found[1] < 0.8 * found[0]
    levels = np.exp(in_turns.log_scales.astype(np.float64)) * then.geometry.parameters.sf_scale
    assert np.all(np.abs(levels - np.rint(levels))[levels > 0.5] < 1e-3), "what the file holds is rounded"
    assert 0 < np.mean(in_turns.log_scales != at_once.log_scales) < 0.5, "some take the next level"
    assert not np.array_equal(in_turns.means, at_once.means)
    assert np.array_equal(then.scene.means, plush_excerpt.means), "other steps start from what is not rounded"
    assert np.array_equal(then.scene.sh[:, 1:], plush_excerpt.sh[:, 1:])


def test_a_fit_can_look_at_what_a_file_will_hold(family_device, plush_excerpt, small_views):
    """Its kernel rounds shapes and opacities as the codec does."""
    bench = Workbench(PARAMETERS, device=family_device)
    geometry = bench.output.geometry(plush_excerpt, bench.request(State.of(plush_excerpt, small_views)))
    decoded = dataclasses.replace(geometry.decoded(plush_excerpt.sh), means=plush_excerpt.means)
    world = geometry.parameters
    factors = Factors(world.sf_scale, world.sf_rotation, world.sf_opacity)
    scene = in_form_of_files(plush_excerpt)
    with Rasterizer(family_device, plush_excerpt) as rasterizer:
        sight = Sight(small_views, RenderedTargets(rasterizer, small_views))
        found = fit_scene(family_device, scene, sight, FitOptions(steps=0), factors=factors)
        unrounded = fit_scene(family_device, scene, sight, FitOptions(steps=0))
    _, held_out = share_out(len(small_views), 0)
    expected = mean_error(family_device, plush_excerpt, decoded, [small_views[k] for k in held_out])
    assert found.errors[0] == pytest.approx(expected, rel=1e-3)
    assert found.scene is not None
    assert np.array_equal(found.scene.log_scales, scene.log_scales), "what lies behind is not rounded"
    assert unrounded.errors[0] < 1e-3 * expected, "the form of files shows the same"


@pytest.mark.slow
@pytest.mark.one_family
def test_coefficients_are_chosen_and_the_rest_moves(family_device, plush_excerpt, small_views):
    _, then, errors, _ = settled(family_device, plush_excerpt, small_views, Settling(0.5, 0, 0.1))
    assert then.geometry is None
    assert len(errors) == 1
    zeros = [np.mean(scene.sh[:, 1:] == 0) for scene in (plush_excerpt, then.scene)]
    assert zeros[1] > zeros[0] + 0.3
    assert not np.array_equal(then.scene.means, plush_excerpt.means)


@pytest.mark.slow
@pytest.mark.one_family
def test_the_refit_takes_no_coefficient_back(family_device, plush_excerpt, small_views):
    """Unless it is asked for other steps, which other coefficients may suit."""
    _, then, _, bench = settled(family_device, plush_excerpt, small_views, Settling(0.5, 0.5, 0.1))
    given_up = (then.scene.sh[:, 1:] == 0).all(axis=2)
    assert np.mean(given_up) > 0.3
    other = dataclasses.replace(bench, parameters=HyperParameters.from_quality(0.6, "best"))
    back = []
    for each in (bench, other):
        sh = Refit().run(then, each).scene.sh
        back.append(np.mean((np.abs(sh[:, 1:]) > 1e-6).any(axis=2)[given_up]))
    assert back[0] == 0
    assert back[1] > 0.01


@pytest.mark.one_family
def test_nothing_of_it_where_nothing_is_asked_for_and_other_kinds_of_files_round_at_once(
    family_device, plush_excerpt, small_views
):
    before, then, errors, _ = settled(family_device, plush_excerpt, small_views, Settling(0, 0, 0.1))
    assert then.scene is before.scene
    assert errors == ()
    _, then, errors, _ = settled(family_device, plush_excerpt, small_views, Settling(0, 0.5, 0.1), output=Ply())
    assert then.geometry is None
    assert errors == ()


@pytest.mark.one_family
def test_the_stage_hands_its_geometry_on(family_device, plush_excerpt, small_views):
    bench = Workbench(HyperParameters.from_quality(0.5, "best"), device=family_device)
    start = State.of(plush_excerpt, small_views).with_results(price=3e-8)  # about half of the splats are worth it
    usual = Fit(steps=50, further=0.26, choosing=0, between=0)
    with_it, without = (dataclasses.replace(usual, rounding=part).run(start, bench) for part in (0.3, 0))
    assert isinstance(with_it.geometry, Geometry)
    assert without.geometry is None
    told = with_it.results.fitted
    assert told.spared > 100
    assert len(told.settled) == 2
    assert told.facts["settled"] == list(told.settled)
    assert "as in the file" in str(told)


@pytest.mark.one_family
def test_of_a_given_number_of_splats_none_are_spared_and_nothing_is_rounded_yet(
    family_device, plush_excerpt, small_views
):
    """The file then has coarser steps than the fit was told."""
    smaller = plush_excerpt.subset(np.arange(0, len(plush_excerpt), 2))
    start = dataclasses.replace(State.of(plush_excerpt, small_views), scene=smaller, survivors=np.arange(0, 1500, 2))
    after = Fit(steps=60, between=0).run(start, Workbench(PARAMETERS, device=family_device))
    assert len(after.scene) == len(smaller)
    assert after.results.fitted.spared == 0
    assert after.results.fitted.settled == ()
    assert after.geometry is None
