"""The re-fit of the colours where an output rounds them on the way."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.outputs.output import ColourGrid
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.reference.refit import to_ycocg
from tests.reference.refit_cases import Case, as_rows
from tests.reference.scenes import ring_of_cameras, visible_scene


def coarse(sh, refit) -> np.ndarray:
    """AC coefficients in steps of 0.1."""
    return np.concatenate([sh[:, :1], np.round(sh[:, 1:] * 10) / 10], axis=1)


@pytest.mark.parametrize("degree", [1, 3])
def test_the_constant_coefficients_make_up_for_the_rounding_of_the_others(device, degree):
    """They come to the least-squares solution with the others held."""
    options = RefitOptions(steps=200, gain=0, prior=10)
    with Case(device, visible_scene(40, degree), visible_scene(60, 2, 7), ring_of_cameras(3, size=40)) as case:
        with ColourRefit(device, case.scene, case.cameras) as refit:
            rounded = coarse(refit.solve(case.scene.sh, case.targets, options).sh, refit)
            solved = refit.solve_constant(case.targets, options, rounded)
            sh = refit.colours()
        active = np.zeros(rounded.shape, bool)
        active[:, 0] = True
        start = dataclasses.replace(case.scene, sh=rounded)
        with Case(device, start, visible_scene(60, 2, 7), case.cameras) as again:
            reference = again.reference(prior=10, active=active, hold=True)
        x, solution = to_ycocg(sh), reference.solution()
        assert np.allclose(sh[:, 1:], rounded[:, 1:], atol=1e-6)
        assert np.linalg.norm(x - solution) < 1e-3 * np.linalg.norm(solution - reference.start)
        assert solved.errors[0] == pytest.approx(reference.error(reference.start), rel=1e-4)
        assert solved.errors[1] == pytest.approx(reference.error(x), rel=1e-4)


def test_the_grid_is_asked_for_with_what_constants_are_worth(case):
    """In a thread of its own, while the re-fit solves."""
    told = []

    def worth(sh, refit):
        told.append(refit.worth()[:, 0])
        return sh

    def colour_grid(effects):
        told.append(effects)
        ones = np.ones(len(effects), np.float32)
        return ColourGrid(ones, ones, np.arange(len(effects)))

    options = RefitOptions(steps=6, gain=0, drop=1e-7)
    refit_colours(case.device, case.scene, case.cameras, case.targets, options, fix_ac=worth)
    refit_colours(case.device, case.scene, case.cameras, case.targets, options, colour_grid=colour_grid)
    assert np.array_equal(told[0], told[1])


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_colours_come_to_the_device_and_back(device, degree):
    """In rows as trainers write them, and coefficient by coefficient as a re-fit leaves them."""
    scene = visible_scene(300, degree)
    with ColourRefit(device, scene, ring_of_cameras(1, size=20)) as refit:
        vectors = refit.coefficients
        x = vectors.vector()
        for sh in (scene.sh, np.ascontiguousarray(scene.sh.transpose(1, 2, 0)).transpose(2, 0, 1)):
            vectors.write_sh(x, sh)
            assert np.abs(as_rows(vectors, x) - to_ycocg(scene.sh)).max() < 1e-6 * np.abs(scene.sh).max()
            assert np.abs(vectors.read_sh(x) - scene.sh).max() < 1e-6 * np.abs(scene.sh).max()


class Counted:
    """Targets that count how often they are asked for."""

    def __init__(self, targets) -> None:
        self.targets, self.asked = targets, 0

    def into(self, numbers, buffer, start=0) -> None:
        self.asked += len(numbers)
        self.targets.into(numbers, buffer, start)


@pytest.mark.one_runtime
@pytest.mark.parametrize("rounds", [True, False])
def test_no_picture_is_looked_at_only_to_measure_what_the_next_solution_measures(case, rounds):
    """At the start, after the choice of coefficients, after rounding, and at the end; where nothing is rounded, the
    last two are one."""
    targets = Counted(case.targets)
    refitted = refit_colours(
        case.device, case.scene, case.cameras, targets, RefitOptions(steps=4, gain=0, drop=1e-7, memory=0),
        fix_ac=coarse if rounds else lambda sh, refit: sh,
    )  # fmt: skip
    assert targets.asked == (4 if rounds else 3) * len(case.cameras)
    reference = case.reference()
    assert refitted.errors[0] == pytest.approx(reference.error(reference.start), rel=1e-4)
    assert refitted.errors[1] == pytest.approx(reference.error(to_ycocg(refitted.sh)), rel=1e-4)
    assert refitted.errors[1] < refitted.errors[0]


@pytest.mark.one_runtime
@pytest.mark.parametrize(("seed", "steps", "dc"), [(0, 30, -3), (3, 8, -5), (7, 30, -3)])
def test_a_solution_that_overshoots_is_taken_back_before_it_is_rounded(device, seed, steps, dc):
    """Dark scenes without a prior: so many colours are cut at 0 on the way that the steps lead astray."""
    scene = visible_scene(40, seed=seed)
    scene.sh[:, 0] += dc
    options = RefitOptions(steps=steps, selection_steps=steps, gain=0, drop=1e-15, prior=0)
    with Case(device, scene, visible_scene(60, 2, seed + 7), ring_of_cameras(3, size=40)) as case:
        careful = case.solve(options).errors
        assert careful[1] <= careful[0] * (1 + 1e-6)
        for finely in (lambda sh, refit: sh, lambda sh, refit: sh + np.float32(1e-6)):
            found = refit_colours(device, scene, case.cameras, case.targets, options, fix_ac=finely).errors
            assert found[1] <= found[0] * (1 + 1e-4)
            assert found[1] <= careful[1] * (1 + 1e-3)
