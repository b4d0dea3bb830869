"""Colours rounded in rounds: against float64, and what the rounds bring."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.opencl.device import Device
from potr_cl.outputs.output import ColourGrid
from potr_cl.stages.refitting.blocks import TURNS, Round, Rounding, SplatBlocks, Steps
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.reference.refit import LENGTHS, to_rgb, to_ycocg
from tests.reference.refit_cases import Case, as_rows, unpacked
from tests.reference.rounding import grid_of, rounded_in_turn
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene


class Rounded:
    """What one round of the device makes of a scene's colours: before and after (N, M, 3), active, blocks."""

    def __init__(
        self, case: Case, grid: ColourGrid, this: Round, worth: float, active=None, noise: float = 0.0
    ) -> None:
        with ColourRefit(case.device, case.scene, case.cameras, background=case.background) as refit:
            vectors = refit.coefficients
            x, result = vectors.vector(), vectors.vector()
            vectors.write_sh(x, case.scene.sh)
            vectors.activate(active)
            vectors.keep_active(x)
            vectors.zero(result)
            steps = Steps.of(grid, vectors.layout.stride)
            blocks = SplatBlocks(vectors)
            with Rounding(vectors, steps) as rounding:
                refit.colour_map.gradient(x, case.targets, result, blocks)
                if noise:
                    found = np.random.default_rng(0).normal(0, noise, blocks.array.size // 4).astype(np.float32)
                    cl.enqueue_copy(case.device.queue, blocks.array, found, is_blocking=True)
                self.before = as_rows(vectors, x)
                rounding.round(x, blocks, this, worth)
                self.blocks = unpacked(blocks)
            self.after, self.active = as_rows(vectors, x), refit.active()


def in_turn(grid: ColourGrid, turn: int) -> np.ndarray:
    due = np.empty(len(grid.order), bool)
    due[grid.order] = np.arange(len(grid.order)) % TURNS <= turn
    return due


@pytest.mark.parametrize("degree", [1, 3])
def test_levels_are_those_of_the_definition(device, degree):
    for worth in [0.0, 5.0]:
        scene = visible_scene(50, degree, seed=degree)
        cameras = [tilted_camera(seed, 48, 48) for seed in range(12)]
        grid = grid_of(len(scene))
        active = np.random.default_rng(0).random(scene.sh.shape) < 0.8
        active[:, 0] = True
        with Case(device, scene, visible_scene(60, 2, 7), cameras) as case:
            got = Rounded(case, grid, Round(others=1, constant=-1, steps=0), worth, active)
        due = in_turn(grid, 1)
        assert due.sum() == 26
        assert np.array_equal(got.after[~due], got.before[~due])
        assert np.array_equal(got.active[~due], active[~due])
        assert np.array_equal(got.active[due, 0], active[due, 0])
        assert not got.active[due, 1:].any()
        assert not got.after[~active].any()
        clear, less = 0, 0
        for k in np.flatnonzero(due):
            step = float(grid.others[k])
            for c, length in enumerate(LENGTHS):
                wanted, margin = rounded_in_turn(
                    length * got.blocks[k], got.before[k, :, c], active[k, :, c], step, worth
                )
                if margin < 1e-3:
                    continue
                clear += 1
                assert np.allclose(got.after[k, :, c], wanted, atol=2e-3 * step)
                less += (np.abs(wanted[1:]) < np.abs(np.round(got.before[k, 1:, c] / step) * step) - step / 2).sum()
        assert clear > 0.7 * 3 * 26
        assert (less > 20) or not worth, "nothing was given up: the case says little"


def test_constant_coefficients_are_rounded_where_they_are_due(device):
    scene, grid = visible_scene(50, 1), grid_of(50)
    with Case(device, scene, scene, ring_of_cameras(3, size=40)) as case:
        got = Rounded(case, grid, Round(others=1, constant=1, steps=0), 0.0)
    due = in_turn(grid, 1)
    levels = got.after[due, 0] / grid.constant[due, None]
    assert np.abs(levels - np.round(levels)).max() < 1e-4
    assert np.array_equal(got.after[~due], got.before[~due])
    assert not got.active[due].any()
    assert got.active[~due].all()


def test_what_no_view_sees_goes_to_its_nearest_level(device):
    scene, grid = visible_scene(40, 2), grid_of(40, 0.02)
    scene.means[20:] += np.float32(1000)
    with Case(device, scene, visible_scene(30, 2, 7), ring_of_cameras(3, size=40)) as case:
        got = Rounded(case, grid, Round(others=TURNS - 1, constant=-1, steps=0), 1e9)
    assert np.abs(got.after[20:, 1:] - got.before[20:, 1:]).max() <= grid.others.max() * 0.501
    assert np.count_nonzero(got.after[20:, 1:]) > 300


def test_splats_that_hardly_show_stay_where_they_are(device):
    """Their blocks are little more than what fixed points are wrong by, and need not be positive."""
    scene, grid = visible_scene(200, 3), grid_of(200, 0.02)
    with Case(device, scene, scene, ring_of_cameras(1, size=20)) as case:
        got = Rounded(case, grid, Round(others=TURNS - 1, constant=-1, steps=0), 0.0, noise=3e-9)
    assert np.abs(got.after - got.before).max() < grid.others.max()


def fitted(case: Case, grid: ColourGrid | None, fix_ac=None) -> np.ndarray:
    """(N, M, 3) Y, Co, Cg, what a re-fit leaves."""
    colour_grid = None if grid is None else lambda effects: grid
    options = RefitOptions(drop=1e-8)
    device, scene, cameras, targets = case.device, case.scene, case.cameras, case.targets
    found = refit_colours(device, scene, cameras, targets, options, fix_ac=fix_ac, colour_grid=colour_grid)
    return to_ycocg(found.sh)


def nearest(x: np.ndarray, grid: ColourGrid) -> np.ndarray:
    x = x.copy()
    x[:, 0] = np.floor(x[:, 0] / grid.constant[:, None] + 0.5) * grid.constant[:, None]
    x[:, 1:] = np.floor(x[:, 1:] / grid.others[:, None, None] + 0.5) * grid.others[:, None, None]
    return x


def test_rounds_leave_less_error_than_the_nearest_levels(device):
    """Where nothing but the rounding spoils the pictures."""
    grid, scene = grid_of(60, 0.1), visible_scene(60, 3)
    case = Case(device, scene, scene, [tilted_camera(seed, 48, 48) for seed in range(12)])
    reference = case.reference()

    def error(x: np.ndarray) -> float:
        pictures = zip(reference.pictures(x), case.pictures, strict=True)
        return float(np.mean([np.mean((a - b.reshape(-1, 3)) ** 2) for a, b in pictures]))

    def round_ac(sh, refit):
        x = nearest(to_ycocg(sh), grid)
        x[:, 0] = to_ycocg(sh)[:, 0]
        return to_rgb(x).astype(np.float32)

    plain, rounds = nearest(fitted(case, None, round_ac), grid), nearest(fitted(case, grid), grid)
    case.rasterizer.close()
    assert error(rounds) < 0.8 * error(plain)


def test_all_but_the_last_constant_coefficients_are_on_the_grid(case):
    """And the bits are the same every time."""
    grid = grid_of(len(case.scene), 0.2)
    x = fitted(case, grid)
    assert np.array_equal(x, fitted(case, grid))
    off = np.abs(x - nearest(x, grid))
    assert off[:, 1:].max() < 1e-5
    due = in_turn(grid, TURNS - 2)
    assert off[due, 0].max() < 1e-5
    assert off[~due, 0].max() > 1e-3


@pytest.mark.one_runtime
def test_absurd_coefficients_stay_finite(case):
    case.scene.sh[::3] *= np.float32(1e12)
    assert np.isfinite(fitted(case, grid_of(len(case.scene)))).all()


@pytest.mark.one_runtime
@pytest.mark.parametrize("count", [1, 2])
def test_few_splats(device, count):
    with Case(device, visible_scene(count), visible_scene(5, 2, seed=7), ring_of_cameras(3, size=40)) as case:
        grid = dataclasses.replace(grid_of(count), order=np.arange(count))
        assert np.isfinite(fitted(case, grid)).all()


@pytest.mark.parametrize("degree", [1, 3])
def test_arrays_in_local_memory_hold_the_same(device, degree):
    """GPUs with few registers have the splats' blocks there (cl/include/registers.clh)."""
    if device.family != "gpu":
        pytest.skip("only GPU kernels have arrays in local memory")
    narrow = Device(device.info, family="gpu", build_options=["-DSUB_GROUP=8"])
    narrow.sub_group = 8
    scene, cameras = visible_scene(60, degree), ring_of_cameras(5, size=40)
    options, found = RefitOptions(steps=10, gain=0, drop=1e-3), []
    for each in (device, narrow):
        with Case(each, scene, visible_scene(60, 2, 7), cameras) as case:
            refitted = refit_colours(
                each, scene, cameras, case.targets, options, colour_grid=lambda _: grid_of(len(scene))
            )
        found.append(refitted.sh)
    assert (found[0] == 0).any()
    assert np.array_equal(*found)


# ---------------------------------------------------------------------------------------- within a re-fit


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
