"""Removal effects against brute force in float64: render with and without each splat."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from contextlib import contextmanager

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError, UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, Scene
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS, ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import PruningOptions, prune
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.views.budget import default_memory
from tests.cases.judging import mean_error
from tests.cases.scenes import antialiased
from tests.reference import raster as reference
from tests.reference.removal import BruteForce
from tests.reference.scenes import plain_splats, ring_of_cameras, visible_scene


def without(scene: Scene, gone) -> Scene:
    return scene.subset(np.setdiff1d(np.arange(len(scene)), gone))


def renders(scene: Scene, cameras: list[Camera], background=(0.0, 0.0, 0.0)):
    return [reference.render(scene, c, INRIA, background).image for c in cameras]


def mean_squared(images, targets) -> float:
    return float(np.mean([np.mean((a - b) ** 2) for a, b in zip(images, targets, strict=True)]))


def brute_force(scene, cameras, targets, splats, gone=(), background=(0.0, 0.0, 0.0)):
    """ΔMSE of removing each of ``splats`` from what is left after ``gone``."""
    now = mean_squared(renders(without(scene, gone), cameras, background), targets)
    return np.array(
        [mean_squared(renders(without(scene, [*gone, k]), cameras, background), targets) - now for k in splats]
    )


def close(predicted, true):
    """Relative to the effect, above a floor: thresholds at 1/255 flip, float32 ends."""
    floor = 1e-4 * np.abs(true).max() * 1e-3
    error = np.abs(predicted - true) / (np.abs(true) + floor)
    assert np.median(error) <= 1e-4
    assert np.quantile(error, 0.95) <= 1e-2


@contextmanager
def sweep(device, scene, cameras, tolerance=0.0, background=(0.0, 0.0, 0.0)):
    with (
        Rasterizer(device, scene, background=background) as rasterizer,
        RemovalSweep(rasterizer, cameras, SweepOptions(tolerance, turns=1)) as removal,
    ):
        yield removal


COLOURFUL = (1.0, 0.3, 0.0)
CLASSIC = visible_scene(60, 1)
VIEWS = ring_of_cameras(3, size=48)


@functools.cache
def true_effects(low_pass):
    """Of every third splat, and how much of each picture the splats cover."""
    scene = CLASSIC if low_pass is None else antialiased(CLASSIC, low_pass)
    targets = renders(scene, VIEWS, COLOURFUL)
    covered = [1 - reference.render(scene, camera, INRIA).transmittance.mean() for camera in VIEWS]
    return scene, brute_force(scene, VIEWS, targets, range(0, 60, 3), background=COLOURFUL), covered


@pytest.mark.parametrize("low_pass", [None, LOW_PASS, MIP_SPLATTING_LOW_PASS])
def test_single_removals(device, low_pass):
    """Of a classic scene, and of an antialiased one, whose splats are about a pixel large."""
    scene, true, covered = true_effects(low_pass)
    with sweep(device, scene, VIEWS, background=COLOURFUL) as removal:
        effect, importance = removal.measure()
        weights = ViewWeights.from_importances(len(scene), removal.view_importances())
    close(effect[::3], true)
    assert (effect >= 0).all()  # nothing is better than the target itself
    # The compaction's weights: the mean of T alpha over each view's pixels, which add up to what is not background.
    assert importance.sum() == pytest.approx(np.mean(covered), rel=1e-5)
    for number, share in enumerate(covered):
        total = weights.weights[weights.views == number].sum(dtype=np.float64) / REFERENCE_PIXELS
        assert total == pytest.approx(share, rel=1e-5)


def test_single_removals_when_others_are_gone(device):
    # Black twins in front of white splats; once they are gone, the picture is too bright.
    scene = visible_scene(25, 0, seed=3).subset(np.tile(np.arange(25), 2))
    scene.sh[:, 0] = np.where(np.arange(50) < 25, -2, 2)[:, None]
    scene.opacity_logits[:25] = 3
    cameras = ring_of_cameras(2, size=48)
    gone = np.arange(0, 25, 2)
    left = np.setdiff1d(np.arange(50), gone)
    with sweep(device, scene, cameras) as removal:
        removal.measure()
        removal.remove(gone)
        effect, _ = removal.measure()
    targets = renders(scene, cameras)
    true = brute_force(scene, cameras, targets, left, list(gone))
    assert (true < 0).any()  # some removals improve the match
    close(effect[left], true)


def test_alpha_at_the_cap_behind_hundreds_of_layers(device):
    """No digits are lost where the paper's formula divides by 1 - alpha and subtracts what the layers in front add."""
    layers, opaque = 320, 300
    logits = np.full(layers, -4.6)  # alpha 0.01; a twentieth of the light is left at the opaque one
    logits[opaque] = 12  # alpha 0.99
    means = np.linspace([-2, 0, 0], [2, 0, 0], layers)
    colours = 0.5 + 0.28 * np.random.default_rng(0).normal(size=(layers, 3))
    scene = plain_splats(means, sigma=np.exp(0.5), logit=logits, colour=colours)
    camera_centre = np.array([-8.0, 0, 0])
    rotation = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    cameras = [Camera("along", 16, 16, 60, 60, 8, 8, rotation, -rotation @ camera_centre)]
    with sweep(device, scene, cameras) as removal:
        effect, _ = removal.measure()
    splats = [0, 150, 299, opaque, 301, 310, 319]
    true = brute_force(scene, cameras, renders(scene, cameras), splats)
    assert np.abs(effect[splats] / true - 1).max() < 1e-3


def test_sums_kept_over_removals_are_those_of_a_new_sweep(device, plush_excerpt, plush_excerpt_cameras):
    """Exact totals: tiles that were skipped because nothing changed add up to what sweeping all of them gives."""
    cameras = plush_excerpt_cameras[:2]
    few = np.arange(0, 20)
    with sweep(device, plush_excerpt, cameras) as removal:
        removal.measure()
        removal.remove(few)
        skipping = removal.measure()
        removal.sweep_everything()
        everything = removal.measure()
    left = np.setdiff1d(np.arange(1500), few)
    for a, b in zip(skipping, everything, strict=True):
        assert np.array_equal(a[left], b[left])


@pytest.mark.one_runtime
def test_buffers_too_small_for_all_views_change_nothing(device, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """A device that allows no large buffer has fewer views at a time, and keeps them all."""
    cameras, results = plush_excerpt_cameras[:7], []
    for largest in (device.info.largest_buffer, 3 * 12 * cameras[0].width * cameras[0].height):
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, largest_buffer=largest))
        with (
            Rasterizer(device, plush_excerpt) as rasterizer,
            RemovalSweep(rasterizer, cameras, SweepOptions(0)) as removal,
        ):
            removal.measure()
            removal.remove(np.arange(0, 1500, 10))
            results.append(np.stack(removal.measure())[:, np.arange(1, 1500, 10)])
            assert removal.ready_views == 7
    assert np.array_equal(*results)


@pytest.mark.one_runtime
def test_tolerance_and_turns_save_sweeps(device, plush_excerpt, plush_excerpt_cameras):
    sweeps = []
    with Rasterizer(device, plush_excerpt) as rasterizer:
        for tolerance, turns in ((-1, 1), (-1, 2), (0, 1), (0.05, 1)):
            with RemovalSweep(rasterizer, plush_excerpt_cameras[:2], SweepOptions(tolerance, turns=turns)) as removal:
                for start in range(4):
                    removal.measure()
                    removal.remove(np.arange(start, 1500, 100))
                sweeps.append(removal.sweeps)
    every, in_turns, changed, tolerant = sweeps
    assert every == pytest.approx(4)
    assert in_turns == pytest.approx(1 + 3 * 0.5)
    assert every > changed > tolerant >= 1


@pytest.mark.parametrize("large", [False, True])
def test_what_goes_of_large_splats_counts_less(device, large):
    """Down to a quarter of what it covered, by the root of the mean importance of the tile's intersections."""
    scene = visible_scene(200, 0, seed=3)
    if not large:
        scene.log_scales[:] -= np.float32(2)
        scene.opacity_logits[:] = -4
    gone = np.arange(0, 200, 7)
    with sweep(device, scene, ring_of_cameras(1, size=64), tolerance=1e3) as removal:
        removal.measure()
        (ready,) = removal._resident._sets
        _, splats, sums = ready.work.read_sums(0)
        starts = device.download(ready.views.offsets, (ready.views.tiles + 1,), np.uint32).astype(int)
        removal.remove(gone)
        stale = removal._resident._staleness()
    counts = []
    for tile, (start, stop) in enumerate(itertools.pairwise(starts)):
        importances = sums[start:stop, 1].astype(np.float64)
        counts.append(np.sqrt(np.clip(0.2 * (stop - start) / max(importances.sum(), 1e-30), 1 / 16, 1)))
        lost = importances[np.isin(splats[start:stop], gone)].sum() / 256
        assert stale[tile] == pytest.approx(lost * counts[-1], rel=1e-4, abs=1e-9)
    assert (np.array(counts) < 1).any() == large


def test_a_removal_lets_pixels_go_on(device):
    """Where pixels end early, effects are those of the same limit on transmittance; small limits leave no jump."""
    scene = visible_scene(300, 0, seed=2).subset(np.repeat(np.arange(300), 3))
    scene.opacity_logits[:] = 2
    cameras = ring_of_cameras(1, size=40)
    some = np.arange(0, 900, 10)
    shares = {}
    for threshold in (None, SweepOptions.transmittance_threshold):
        with (
            Rasterizer(device, scene) as rasterizer,
            RemovalSweep(rasterizer, cameras, SweepOptions(transmittance_threshold=threshold)) as removal,
        ):
            effect, _ = removal.measure()
        exact = BruteForce(reference.project(scene, cameras[0], INRIA), cameras[0], INRIA)
        true = exact.effects(some, [INRIA.transmittance_threshold if threshold is None else threshold])[1, 0] / (
            3 * 40 * 40
        )
        strong = true > 1e-4 * true.max()
        shares[threshold] = np.mean(np.abs(effect[some[strong]] / true[strong] - 1) < 1e-2)
    assert shares[None] < shares[SweepOptions.transmittance_threshold]
    assert shares[SweepOptions.transmittance_threshold] > 0.98


def test_views_count_the_same_whatever_their_size_and_what_they_see(device):
    scene = visible_scene(30, 0)
    views = [ring_of_cameras(2, size=96)[0], ring_of_cameras(2, size=48)[1]]
    views.append(dataclasses.replace(views[0], name="away", translation=np.array([0, 0, -50.0])))
    found = []
    for some in ([views[0]], [views[1]], views):
        with sweep(device, scene, some) as removal:
            found.append(removal.measure())
    for large, small, together in zip(*found, strict=True):
        assert np.allclose(together, (large + small) / 3, rtol=1e-5, atol=1e-13)


@pytest.mark.slow
@pytest.mark.one_family
@pytest.mark.one_runtime
def test_the_memory_budget_is_used_and_not_exceeded(device):
    """Lists first, then geometry of as many views as there is room for; the effects are the same whatever is kept."""
    scene = visible_scene(1500, 0)
    cameras = ring_of_cameras(40, size=40)
    with Rasterizer(device, scene) as rasterizer:

        def measured(memory):
            before = device.allocated
            with RemovalSweep(rasterizer, cameras, SweepOptions(memory=memory)) as removal:
                taken = device.allocated - before
                removal.measure()
                removal.remove(np.arange(0, 1500, 3))
                return taken, np.stack(removal.measure())

        nothing, _ = measured(0)
        everything, expected = measured(None)
        left = np.arange(1500) % 3 > 0
        for share in (0.2, 0.5, 0.95):
            budget = int(share * (everything - nothing))
            taken, effects = measured(budget)
            assert 0.9 * budget <= taken - nothing <= 1.001 * budget, share
            assert (effects[:, left] == expected[:, left]).all(), share


@pytest.mark.one_runtime
@pytest.mark.parametrize("share", [0.1, 0.9])
def test_a_failure_gives_all_memory_back(device, monkeypatch, share):
    """Wherever the device's memory ends while a sweep is made."""
    cameras, keep_all = ring_of_cameras(5, size=48), SweepOptions(memory=1 << 40)
    with Rasterizer(device, visible_scene(3000)) as rasterizer:  # its scratch memory may grow meanwhile
        before = device.allocated
        with RemovalSweep(rasterizer, cameras, keep_all) as removal:
            needed = device.allocated - before
            assert removal.ready_views == 5
        scratch = device.allocated - before
        limit = int(before + scratch + share * (needed - scratch))
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, memory=limit))
        with pytest.raises(DeviceMemoryError):
            RemovalSweep(rasterizer, cameras, keep_all)
    assert device.allocated == 0


def test_identical_splats_share_their_effect(device):
    scene = visible_scene(1, 0).subset(np.zeros(40, np.int64))
    with sweep(device, scene, ring_of_cameras(2, size=48)) as removal:
        effect, importance = removal.measure()
    assert np.isfinite(effect).all()
    # Nearer by number: the first is in front of all others.
    assert (np.diff(importance) <= 1e-12).all()


@pytest.mark.one_runtime
def test_pruning_keeps_the_picture_better_than_importance(device, plush_excerpt, plush_excerpt_cameras):
    cameras = [c for c in plush_excerpt_cameras if c.split == "train"][:4]
    with sweep(device, plush_excerpt, cameras) as removal:
        _, importance = removal.measure()
        pruned = prune(removal, 1500, PruningOptions(0, 12, count=750))
    by_importance = np.sort(np.argsort(importance)[-750:])

    ours, theirs = (
        mean_error(device, plush_excerpt, plush_excerpt.subset(kept), cameras)
        for kept in (pruned.survivors, by_importance)
    )
    assert ours < 0.5 * theirs


@pytest.mark.one_runtime
def test_no_view_is_an_error(device):
    with Rasterizer(device, visible_scene(3, 0)) as rasterizer, pytest.raises(UsageError, match="at least one view"):
        RemovalSweep(rasterizer, [])


@pytest.mark.one_runtime
@pytest.mark.parametrize(
    ("kind", "integrated", "share"), [("gpu", False, 0.5), ("gpu", True, 0.3), ("cpu", True, 0.3), ("cpu", False, 0.3)]
)
def test_views_take_less_of_memory_that_is_the_hosts(device, monkeypatch, kind, integrated, share):
    info = dataclasses.replace(device.info, memory=10**10, kind=kind, integrated=integrated)
    monkeypatch.setattr(device, "info", info)
    assert default_memory(device) == share * 10**10
