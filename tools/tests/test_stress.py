"""The numerical stress of all kernels, and that its measures notice what they are there to notice."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.opencl.device import Device
from potr_cl.raster.rules import GSPLAT, INRIA
from tests.devices import FAMILIES, open_device
from tests.reference import raster as reference
from tests.reference.scenes import random_splats, tilted_camera
from tools.results import Results
from tools.stress import cases as stress_cases
from tools.stress import fits, measures, precise, run, solvers, views


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0


CASE = stress_cases.Case("some splats", random_splats(40, 1, seed=1), tilted_camera(1, 37, 26))


@pytest.mark.slow
def test_every_kernel_stays_within_what_rounding_explains(device, monkeypatch):
    """In the cases made by hand; a search is tried below."""
    monkeypatch.setattr(stress_cases, "MANY", 1000)
    result = run.run_device(device, examples=0)
    assert result["failures"] == {}
    assert set(result["worst"]) == set(measures.WHAT)
    for worst in result["worst"].values():
        assert worst["checked"] > 15
        assert np.isfinite(worst["error"])


@pytest.mark.parametrize("rules", [INRIA, GSPLAT])
def test_the_composite_is_the_definition(rules):
    case = dataclasses.replace(CASE, rules=rules)
    true = precise.projected(case)
    pixels, shape = precise.Pixels.of(case.view), (case.view.height, case.view.width)
    inside = [
        reference.footprint(c, s, rules, shape).ravel() for c, s in zip(true.centre, true.covariance, strict=True)
    ]
    ours = precise.composite(precise.alphas_of_covariances(true, pixels) * inside, true.colour, rules)
    wanted = reference.render(case.scene, case.view, rules)
    assert np.allclose(ours.image, wanted.image.reshape(-1, 3), atol=1e-12)
    assert np.allclose(ours.transmittance, wanted.transmittance.ravel(), atol=1e-12)


def test_removal_effects_are_those_of_the_definition():
    """One splat after the other left out, where no pixel ends."""
    thin = dataclasses.replace(CASE.scene, opacity_logits=np.full(40, -4, np.float32))
    case = dataclasses.replace(CASE, scene=thin)
    true, pixels = precise.projected(case), precise.Pixels.of(case.view)
    alpha = precise.composite(precise.alphas_of_covariances(true, pixels), true.colour, GSPLAT).alpha
    wanted = np.full((len(pixels.x), 3), 0.1)
    splats = np.arange(0, len(true.index), 3)
    effects, magnitudes, importances = precise.removal_effects(alpha, true.colour, wanted, splats)

    def error(scene) -> float:
        return float(np.mean((reference.render(scene, case.view, GSPLAT).image.reshape(-1, 3) - wanted) ** 2))

    left_out = [np.delete(np.arange(40), true.index[k]) for k in splats]
    assert np.allclose(effects, [error(thin.subset(left)) - error(thin) for left in left_out], atol=1e-12)
    assert (magnitudes >= np.abs(effects)).all()
    assert (importances[effects != 0] > 0).all()


def test_rounding_moves_a_result_and_not_far():
    rng = np.random.default_rng(0)
    values = rng.normal(size=10000)
    moved = precise.rounded(values, rng)
    assert 0 < np.abs(moved / values - 1).max() <= precise.ULP * 1.0001
    true, other = precise.projected(CASE), precise.projected(CASE, rng)
    assert 0 < np.abs(other.depth / true.depth - 1).max() < 1e-6


@pytest.mark.one_family
def test_a_sound_device_is_not_accused(device):
    for measure, (error, expected) in views.check(device, CASE).items():
        assert error <= 20 * expected, measure


def test_the_cap_that_a_device_gets_is_no_fault(device):
    """1 - 0.999 is another number in float32, and what lies behind a capped splat is seen through just that."""
    veil = dataclasses.replace(
        CASE.scene.subset(np.arange(2)),
        means=np.array([CASE.view.centre / 2, [0, 0, 0]], np.float32),
        log_scales=np.array([[6] * 3, [0] * 3], np.float32),
        opacity_logits=np.array([50, 0], np.float32),
    )
    found = views.check(device, dataclasses.replace(CASE, scene=veil, rules=GSPLAT))
    for measure in ("removal: effect", "removal: importance"):
        error, expected = found[measure]
        assert error <= 20 * expected, measure


@pytest.mark.parametrize(
    ("measure", "part", "change"),
    [
        ("composite", "image", lambda image: image + 1e-3),
        ("composite", "image", lambda image: image * np.nan),
        ("render", "transmittance", lambda transmittance: transmittance * 0.99),
        ("project: alpha", "shapes", lambda shapes: shapes * (1 + 1e-2)),
        ("project: colour", "colours", lambda colours: colours + 1e-3),
        ("project: depth", "shapes", lambda shapes: shapes * (1 + 1e-4)),
        ("sort", "intersections", lambda numbers: numbers[::-1]),
        ("tile lists", "intersections", lambda numbers: np.full_like(numbers, numbers[0])),
    ],
)
def test_faults_are_noticed(monkeypatch, measure, part, change):
    """Once something has been at what the device leaves."""
    untouched = views.rasterized

    def spoiled(*given):
        lists = untouched(*given)
        return dataclasses.replace(lists, **{part: change(getattr(lists, part))})

    monkeypatch.setattr(views, "rasterized", spoiled)
    error, expected = views.check(Device(), CASE)[measure]
    assert not error <= measures.LIMIT * expected if measure != "sort" else error > 0


def test_a_wrong_removal_effect_is_noticed(monkeypatch):
    measured = views.RemovalSweep.measure

    def off(self):
        effect, importance = measured(self)
        return effect * 1.001, importance * 1.001

    monkeypatch.setattr(views.RemovalSweep, "measure", off)
    found = views.check(Device(), CASE)
    for measure in ("removal: effect", "removal: importance"):
        error, expected = found[measure]
        assert error > 0.9e-3 > measures.LIMIT * expected


def test_a_wrong_least_squares_solution_is_noticed(monkeypatch):
    ridge, refit = next(stress_cases.known_ridges()), next(stress_cases.known_refits())
    compact, solve = solvers.Compactor.compact, solvers.refit_colours

    def off(scene):
        return dataclasses.replace(scene, sh=(scene.sh * np.float32(1.01)))

    monkeypatch.setattr(solvers.Compactor, "compact", lambda *args: off(compact(*args)))
    monkeypatch.setattr(solvers, "refit_colours", lambda *args: off(solve(*args)))
    error, promised = solvers.check_ridge(Device(), ridge)["ridge"]
    assert error > promised
    error, promised = solvers.check_refit(Device(), refit)["re-fit: optimum"]
    assert error > promised


def test_a_fit_that_leaves_what_is_not_finite_is_noticed(monkeypatch):
    fit = fits.fit_scene

    def broken(*given, **more):
        fitted = fit(*given, **more)
        means = fitted.scene.means.copy()
        means[0] = np.nan
        return dataclasses.replace(fitted, scene=dataclasses.replace(fitted.scene, means=means))

    monkeypatch.setattr(fits, "fit_scene", broken)
    assert fits.check_fits(Device(), CASE)["fit: steps"][0] == np.inf


def test_hypothesis_finds_the_worst_and_the_smallest():
    """A measure that is at its worst where a splat is large."""

    def run(case: stress_cases.Case) -> measures.Measures:
        return {"size": (float(np.exp(case.scene.log_scales.max())), 1.0)}

    worst: dict[str, measures.Worst] = {}
    measures.search("size", stress_cases.small_scenes(), run, worst, 60)
    assert worst["size"].error > 1000
    smallest = measures.smallest_failure("size", stress_cases.small_scenes(), run, 200)
    assert smallest is not None
    assert smallest.count("μ") == 1


def test_the_report_names_what_failed(capsys):
    fine = measures.Worst()
    fine.add(1e-7, 1e-7, "a case")
    worst = {"composite": dataclasses.asdict(fine)}
    results = [
        {"device": "A", "family": "cpu", "worst": worst, "failures": {"composite": "one splat"}},
        {"device": "B", "family": "gpu", "failed": "crashed"},
    ]
    run.report(Results(None), results)
    printed = capsys.readouterr().out
    assert "| composite | A | cpu | one splat |" in printed
    assert "| B | gpu | crashed |" in printed
