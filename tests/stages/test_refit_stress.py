"""The re-fit of the colours at its worst: little memory, absurd colours and targets, views that see nothing."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.model.camera import resized
from potr_cl.stages.refitting import own_views
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.devices import shared_device
from tests.reference.refit import to_ycocg
from tests.reference.refit_cases import Case, Linearised
from tests.reference.scenes import plain_splats, ring_of_cameras, straight_camera, visible_scene


@pytest.mark.one_family
@pytest.mark.one_runtime
@pytest.mark.parametrize("share", [0.2, 0.6])
def test_the_memory_budget_is_used_and_not_exceeded(device, share):
    """What the device holds when views and targets are kept, above what it holds at most when none is."""
    cameras = ring_of_cameras(60, size=32)
    with Case(device, visible_scene(2000), visible_scene(60, 1, seed=7), cameras) as case:

        def taken(memory):
            with Linearised(case, memory=memory) as linear:
                return device.allocated, linear.room

        plenty = 10**9
        wanted = plenty - taken(plenty)[1]
        budget = int(share * wanted)
        assert 0.88 * budget <= taken(budget)[0] - taken(0)[0] <= 1.1 * budget


def test_more_views_than_are_swept_at_a_time(device):
    """Some views kept, some made again, and more of both than a GPU's queues."""
    with Case(device, visible_scene(30, 1), visible_scene(50, 1, 5), ring_of_cameras(37, size=20)) as case:
        one, other = (case.solve(RefitOptions(steps=3, gain=0, memory=memory)) for memory in (None, 250_000))
    assert np.array_equal(one.sh, other.sh)


def test_views_that_are_gathered_together_though_some_of_them_come_and_go(monkeypatch):
    """What is cut stays known of some groups, and is found anew of others."""
    device, groups, real = shared_device("cpu"), [], own_views._Gathered

    def noted(own, free):
        groups.append((len(own), sum(each.launch.resident is not None for each in own), free is not None))
        return real(own, free)

    monkeypatch.setattr(own_views, "_AT_ONCE", 1.0)
    monkeypatch.setattr(own_views, "_Gathered", noted)
    with Case(device, visible_scene(300, 1), visible_scene(50, 1, 5), ring_of_cameras(37, size=20)) as case:
        wanted, *found = (
            case.solve(RefitOptions(steps=3, gain=0, memory=memory)).sh
            for memory in (None, 60_000, 100_000, 200_000, 400_000)
        )
    assert all(np.array_equal(sh, wanted) for sh in found)
    assert any(1 < number == there and stays for number, there, stays in groups)
    assert any(0 < there < number and not stays for number, there, stays in groups)


def solve_and_check(case: Case, options: RefitOptions, active=None) -> np.ndarray:
    """Finite, and by the float64 objective no worse than the start; the coefficients in Y, Co, Cg."""
    refitted = case.solve(options, active)
    assert np.isfinite(refitted.sh).all()
    assert np.isfinite(refitted.errors).all()
    x = to_ycocg(refitted.sh)
    reference = case.reference(lam=options.lam, prior=options.prior, active=active)
    before = reference.objective(reference.start)
    assert reference.objective(x) <= before * (1 + 1e-6) + 1e-9
    return x


@pytest.mark.parametrize("seen", [0, 10])
def test_splats_that_no_view_sees_stay_as_they_are(device, seen):
    scene = visible_scene(30)
    scene.means[seen:] += np.float32(1000)
    before = to_ycocg(scene.sh)
    with Case(device, scene, visible_scene(30, 2, 7), ring_of_cameras(3, size=40)) as case:
        for prior in (0.0, 0.1):
            x = solve_and_check(case, RefitOptions(prior=prior))
            assert np.allclose(x[seen:], before[seen:], atol=1e-6)
            assert seen == 0 or not np.allclose(x[:seen], before[:seen], atol=1e-3)
        solve_and_check(case, RefitOptions(lam=1, prior=0))


def test_one_view(device):
    with Case(device, visible_scene(40), visible_scene(60, 2, 7), ring_of_cameras(5, size=40)[1:2]) as case:
        for prior in (0.1, 0):
            solve_and_check(case, RefitOptions(steps=30, gain=0, prior=prior))


def test_a_black_target(device):
    black = visible_scene(20, 0)
    black.sh[:] = -10
    with Case(device, visible_scene(40), black, ring_of_cameras(3, size=40)) as case:
        assert not any(p.any() for p in case.pictures)
        solve_and_check(case, RefitOptions(steps=30, gain=0))


def test_all_colours_cut_at_0(device):
    scene = visible_scene(40)
    scene.sh[:, 0] = -20
    with Case(device, scene, visible_scene(60, 2, 7), ring_of_cameras(3, size=40)) as case:
        x = solve_and_check(case, RefitOptions(steps=10))
        assert np.allclose(x, to_ycocg(scene.sh), atol=1e-5)


def test_no_regulariser_on_a_rank_deficient_system(device):
    """16 coefficients, 2 views, and every splat twice in the same place."""
    scene = visible_scene(20).subset(np.tile(np.arange(20), 2))
    with Case(device, scene, visible_scene(60, 2, 7), ring_of_cameras(2, size=40)) as case:
        for steps in (1, 8, 100):
            assert np.abs(solve_and_check(case, RefitOptions(steps=steps, gain=0, prior=0))).max() < 1e3


def test_a_strong_pull_to_zero_is_no_better_than_what_it_costs(case):
    for changes in ({"lam": 1e3}, {"lam": 1e12}, {"prior": 1e12}):
        solve_and_check(case, RefitOptions(steps=20, gain=0, **changes))


@pytest.mark.slow
def test_absurd_coefficients(device):
    for where in ["dc", "ac"]:
        for value in [1e4, 1e30, 3e38]:
            scene = visible_scene(40)
            rng = np.random.default_rng(0)
            for k in range(0, 40, 7):
                if where == "dc":
                    scene.sh[k, 0] = value * rng.choice([-1, 1], size=3)
                else:
                    scene.sh[k, 1:] = value * rng.choice([-1, 1], size=(15, 3))
            with Case(device, scene, visible_scene(60, 2, 7), ring_of_cameras(3, size=40)) as case:
                for options in (RefitOptions(), RefitOptions(lam=1), RefitOptions(prior=0), RefitOptions(drop=1e-7)):
                    refitted = case.solve(options)
                    assert np.isfinite(refitted.sh).all()
                    assert np.isfinite(refitted.errors).all()
                    if not options.drop:
                        assert refitted.errors[1] <= refitted.errors[0] or options.lam


def test_absurd_targets(device):
    bright = visible_scene(30, 0)
    bright.sh[:] = 1e30
    with Case(device, visible_scene(40), bright, ring_of_cameras(3, size=40)) as case:
        refitted = case.solve(RefitOptions(steps=10))
    assert np.isfinite(refitted.sh).all()


def test_views_of_different_sizes(device):
    cameras = ring_of_cameras(4, size=40)
    cameras = [cameras[0], resized(cameras[1], 61, 33), resized(cameras[2], 16, 16), resized(cameras[3], 7, 90)]
    with Case(device, visible_scene(30, 1), visible_scene(60, 2, 7), cameras) as case:
        options = RefitOptions(steps=200, gain=0, prior=10)
        x = solve_and_check(case, options)
        reference = case.reference(prior=10)
        solution = reference.solution()
    assert np.linalg.norm(x - solution) < 1e-3 * np.linalg.norm(solution - reference.start)


@pytest.mark.one_runtime
@pytest.mark.parametrize(
    "count", [8000, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.one_family])]
)  # fmt: skip
def test_overlapping_splats_on_one_pixel_column(device, count):
    rng = np.random.default_rng(0)
    centres = np.zeros((count, 3))
    centres[:, 1] = rng.uniform(-0.3, 0.3, count)
    centres[:, 2] = rng.uniform(1, 3, count)
    # Alphas of 0.01 at most: hundreds of splats share a pixel.
    scene = plain_splats(centres, sigma=2e-3, logit=-4.6, colour=rng.uniform(0, 1, (count, 3)))
    target = plain_splats(centres[::2], sigma=2e-3, logit=-4.0, colour=(0.2, 0.9, 0.4))
    with Case(device, scene, target, [straight_camera(1, 48), straight_camera(16, 16)]) as case:
        for prior in (0.0, 0.1):
            refitted = case.solve(RefitOptions(steps=4, gain=0, prior=prior))
            assert np.isfinite(refitted.sh).all()
            assert refitted.errors[1] < 0.5 * refitted.errors[0]


def test_one_splat(device):
    scene = plain_splats((0, 0, 2), sigma=0.3, logit=3, colour=(0.2, 0.2, 0.2))
    target = plain_splats((0, 0, 2), sigma=0.3, logit=3, colour=(0.8, 0.5, 0.3))
    with Case(device, scene, target, [straight_camera(33, 21)]) as case:
        sh = case.solve(RefitOptions(prior=0)).sh
    assert np.allclose(sh, target.sh, atol=1e-5)
