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
from tests.devices import KERNELS, open_device
from tests.reference.refit import LENGTHS, to_rgb, to_ycocg
from tests.reference.refit_cases import Case, as_rows, unpacked
from tests.reference.rounding import rounded_in_turn
from tests.reference.scenes import ring_of_cameras, tilted_camera, visible_scene


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "rounding did not give all its memory back"


def grid_of(count: int, step: float = 0.1, seed: int = 0) -> ColourGrid:
    """Steps that differ by splat, in an order that is not the scene's."""
    rng = np.random.default_rng(seed)
    steps = (step * 2.0 ** rng.uniform(-1, 1, (2, count))).astype(np.float32)
    return ColourGrid(steps[0], steps[1], rng.permutation(count))


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


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_levels_are_those_of_the_definition(device, degree):
    for worth in [0.0, 5.0]:
        scene = visible_scene(50, degree, seed=degree)
        cameras = [tilted_camera(seed, 48, 48) for seed in range(24)]
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


@pytest.fixture
def case(device):
    cameras = [tilted_camera(seed, 48, 48) for seed in range(12)]
    with Case(device, visible_scene(60, 3), visible_scene(60, 2, seed=7), cameras) as case:
        yield case


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
    grid = grid_of(60, 0.2)
    x = fitted(case, grid)
    off = np.abs(x - nearest(x, grid))
    assert off[:, 1:].max() < 1e-5
    due = in_turn(grid, TURNS - 2)
    assert off[due, 0].max() < 1e-5
    assert off[~due, 0].max() > 1e-3


def test_same_bits_every_time(case):
    grid = grid_of(60)
    assert np.array_equal(*(fitted(case, grid) for _ in range(2)))


@pytest.mark.one_runtime
def test_absurd_coefficients_stay_finite(case):
    grid = grid_of(60)
    case.scene.sh[::3] *= np.float32(1e12)
    assert np.isfinite(fitted(case, grid)).all()


@pytest.mark.one_runtime
@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_splats(device, count):
    scene = visible_scene(count, 3)
    with Case(device, scene, visible_scene(5, 2, seed=7), ring_of_cameras(3, size=40)) as case:
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
