"""The stage "merge": what becomes of splats that take over removed ones (potr_cl/stages/merge.py)."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from potr_cl.errors import UsageError
from potr_cl.levels.encoding import coarser
from potr_cl.model.camera import train_views
from potr_cl.model.scene import Scene
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.compare import mean_view
from potr_cl.quality.judging import Judging, Looks
from potr_cl.raster.scene_buffers import uploaded
from potr_cl.stages.merge import Merge
from potr_cl.stages.merging.merged import groups_of, merged
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import State, Workbench
from tests.reference.scenes import covariances, random_scene

LEFT = np.array([0, 3])
#: Two groups far from each other: splats 0 to 2, and 3 to 5.
AT = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.02, 0], [9, 0, 0], [9, 0.01, 0], [9, 0, 0.03]], np.float32)


def two_groups() -> Scene:
    scene = random_scene(6, 1, seed=4)
    return dataclasses.replace(scene, means=AT.copy(), log_scales=scene.log_scales + 1, sh=np.float32(0.1) * scene.sh)


@pytest.fixture
def merge(device):
    def merge(scene, left, importance, run=map, become=None, drawable=None):
        return merged(device, scene, left, np.asarray(importance, np.float32), run, become, drawable)

    return merge


def test_a_splat_becomes_what_its_group_was_together(merge):
    scene = two_groups()
    importance = np.array([0.5, 2.0, 1.5, 8.0, 1.0, 1.0])  # of the first group removed ones have most
    found = merge(scene, LEFT, importance)
    areas = np.exp(np.sort(scene.log_scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1))
    covered = areas / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))
    weights = importance + 0.1 * importance.sum() / covered.sum() * covered
    weights = weights[:3] / weights[:3].sum()
    middle = weights @ AT[:3].astype(np.float64)
    off = AT[:3] - middle
    covariance = np.einsum("i,ijk->jk", weights, covariances(scene)[:3] + off[:, :, None] * off[:, None])
    assert np.allclose(found.means[0], middle, atol=1e-6)
    assert np.allclose(covariances(found)[0], covariance, rtol=1e-5, atol=1e-9)
    assert np.allclose(found.sh[0], np.einsum("i,ijk->jk", weights, scene.sh[:3]), atol=1e-6)
    own = np.exp(np.sort(found.log_scales[0].astype(np.float64))[1:].sum())
    assert np.isclose(1 / (1 + np.exp(-found.opacity_logits[0])), min(covered[:3].sum() / own, 0.995), rtol=1e-5)
    for array, before in zip(found.arrays, scene.arrays, strict=True):
        assert np.array_equal(array[1], before[3])  # its neighbours show less than a third of the group


def test_all_groups_are_what_float64_makes_of_them(device, merge, monkeypatch):
    scene = random_scene(2000, 3, seed=8)
    left = np.arange(0, len(scene), 5)
    importance = np.random.default_rng(2).random(len(scene)).astype(np.float32) ** 3
    with uploaded(device, scene) as whole:
        group = groups_of(device, scene, left, map, whole)
        found = merge(scene, left, importance, drawable=whole)
    scales = np.sort(np.exp(scene.log_scales.astype(np.float64)), axis=1)
    opacities = 1 / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))
    covered = np.where(opacities < 1 / 255, 0, opacities * scales[:, 1] * scales[:, 2])
    usual = importance.sum() / covered.sum()
    expected = covariances(found)
    changed = 0
    for place, own in enumerate(left):
        of = np.flatnonzero(group == place)
        shown, cover = importance[of].sum(), covered[of].sum()
        merges = shown - importance[own] > 0.7 * shown or shown < 0.05 * usual * cover
        if len(of) == 1 or not merges:
            assert np.array_equal(found.means[place], scene.means[own])
            continue
        changed += 1
        weights = importance[of] + 0.1 * usual * covered[of]
        weights /= weights.sum()
        middle = weights @ scene.means[of].astype(np.float64)
        off = scene.means[of] - middle
        covariance = np.einsum("i,ijk->jk", weights, covariances(scene)[of] + off[:, :, None] * off[:, None])
        assert np.allclose(found.means[place], middle, atol=1e-5 * np.abs(off).max())
        assert np.allclose(expected[place], covariance, atol=2e-6 * np.trace(covariance))
        assert np.allclose(found.sh[place], np.einsum("i,ijk->jk", weights, scene.sh[of]), atol=1e-5)
        area = np.prod(np.sort(np.sqrt(np.linalg.eigvalsh(covariance)))[1:])
        opacity = 1 / (1 + np.exp(-found.opacity_logits[place].astype(np.float64)))
        assert np.isclose(opacity, np.clip(cover / area, 1 / 255, 0.995), rtol=1e-4)
    assert changed > 100
    for one, two in zip(found.arrays, merge(scene, left, importance).arrays, strict=True):
        assert np.array_equal(one, two), "as of a scene that is not on the device"
    monkeypatch.setattr("potr_cl.stages.merging.merged._TOGETHER", 100)
    for one, two in zip(found.arrays, merge(scene, left, importance).arrays, strict=True):
        assert np.allclose(one, two, atol=1e-6), "as a few at a time"


def test_where_views_show_little_all_are_merged(merge):
    scene = two_groups()
    importance = np.array([1e-6, 1e-9, 1e-9, 8.0, 1.0, 1.0])
    found = merge(scene, LEFT, importance)
    assert not np.array_equal(found.means[0], AT[0])
    assert np.array_equal(found.means[1], AT[3])


def test_neither_threads_nor_the_length_of_quaternions_matter(merge):
    scene = random_scene(3000, 1, seed=2)
    left = np.arange(0, len(scene), 3)
    importance = np.random.default_rng(1).random(len(scene)) ** 4
    found = merge(scene, left, importance)
    with ThreadPoolExecutor(3) as pool:
        again = merge(scene, left, importance, pool.map)
    longer = merge(dataclasses.replace(scene, quaternions=4 * scene.quaternions), left, importance)
    changed = (found.means != scene.means[left]).any(axis=1)
    assert 0.2 < changed.mean() < 1
    for one, two, three in zip(found.arrays, again.arrays, longer.arrays, strict=True):
        assert np.array_equal(one, two)
        assert np.array_equal(one[changed], three[changed])


@pytest.mark.parametrize("log_scale", [-80.0, 80.0])
def test_scales_of_any_size_leave_numbers(merge, log_scale):
    scene = two_groups()
    scene.log_scales[1] = log_scale
    scene.opacity_logits[2] = -120.0
    found = merge(scene, LEFT, np.array([0.0, 1.0, 0.0, 0.0, 1.0, 1.0]))
    assert all(np.isfinite(array).all() for array in found.arrays)


def test_where_nothing_is_left_nothing_is_merged(merge):
    assert len(merge(two_groups(), np.array([], np.int64), np.ones(6))) == 0


def test_of_a_scene_that_nobody_sees_numbers_are_left(merge):
    found = merge(two_groups(), LEFT, np.zeros(6))
    assert all(np.isfinite(array).all() for array in found.arrays)


def test_removed_ones_are_taken_over_by_near_ones_that_are_left(device):
    scene = random_scene(3000, 1, seed=2)
    left = np.arange(0, len(scene), 3)
    with uploaded(device, scene) as whole:
        group = groups_of(device, scene, left, map, whole)
        with ThreadPoolExecutor(3) as pool:
            assert np.array_equal(groups_of(device, scene, left, pool.map, whole), group)
    assert np.array_equal(group[left], np.arange(len(left)))
    taken = np.flatnonzero(group < len(left))
    assert len(taken) > 0.9 * len(scene)
    others = np.random.default_rng(3).permutation(group[taken])
    near, far = (
        np.linalg.norm(scene.means[taken] - scene.means[left[places]], axis=1) for places in (group[taken], others)
    )
    assert np.median(near) < 0.3 * np.median(far)


def test_groups_of_many_are_merged(merge):
    scene = random_scene(40_000, 0, seed=5)
    scene = dataclasses.replace(scene, means=0.01 * scene.means)
    found = merge(scene, np.array([7]), np.ones(len(scene)))
    assert np.allclose(found.means[0], scene.means.mean(axis=0), atol=0.1 * scene.means.std())


def pruned(scene, cameras, device):
    bench = Workbench(EncodeOptions().parameters, device=device)
    views = train_views(cameras)
    return Prune(count=len(scene) // 8, iterations=8).run(State.of(scene, views), bench), bench


def test_the_stage_brings_a_thinned_scene_nearer_to_its_pictures(usual_device, plush_excerpt, plush_excerpt_cameras):
    before, bench = pruned(plush_excerpt, plush_excerpt_cameras, usual_device)
    assert Merge(on=True).run(before.with_results(importance=None), bench).scene is before.scene
    then = Merge(on=True).run(before, bench)
    assert then is not before
    assert len(then.scene) == len(before.scene)
    with Judging(usual_device, plush_excerpt, before.views, Looks()) as judging:
        was, now = (mean_view(judging.figures(each)).figures["b_against_a"].psnr for each in (before.scene, then.scene))
    assert now > was + 0.5


def test_where_pictures_become_much_worse_all_stay_as_they_were(
    usual_device, plush_excerpt, plush_excerpt_cameras, monkeypatch
):
    before, bench = pruned(plush_excerpt, plush_excerpt_cameras, usual_device)
    black = dataclasses.replace(before.scene, opacity_logits=before.scene.opacity_logits - 20)
    monkeypatch.setattr("potr_cl.stages.merge.merged", lambda *_: black)
    assert Merge(on=True).run(before, bench).scene is before.scene


def test_nothing_is_merged_where_nothing_was_removed(plush_excerpt, plush_excerpt_cameras):
    state = State.of(plush_excerpt, train_views(plush_excerpt_cameras))
    assert Merge(on=True).run(state, Workbench(EncodeOptions().parameters)) is state


def test_only_coarser_levels_are_merged_and_none_of_preset_paper():
    options = EncodeOptions()
    assert not options.stage(Merge).on
    assert coarser(options, 1, 100, "gpu").stage(Merge).on
    assert not coarser(EncodeOptions(preset="paper"), 1, 100, "gpu").stage(Merge).on


def test_what_is_far_or_never_drawn_is_taken_over_by_nobody(merge):
    scene = two_groups()
    scene.means[1] = 1e30
    scene.log_scales[2], scene.opacity_logits[2] = 9, -20
    found = merge(scene, LEFT, np.array([0.5, 2.0, 1e-9, 8.0, 1.0, 1.0]))
    assert np.allclose(found.means[0], AT[0], atol=1e-6)
    assert np.allclose(found.log_scales[0].max(), scene.log_scales[0].max(), atol=1e-3)


def test_colours_stay_as_stages_before_have_left_them(merge):
    scene = two_groups()
    by_now = dataclasses.replace(scene.subset(LEFT), sh=np.full((2, 4, 3), 0.25, np.float32))
    found = merge(scene, LEFT, np.array([0.5, 2.0, 1.5, 8.0, 1.0, 1.0]), become=by_now)
    assert (found.sh[1] == 0.25).all()
    assert (found.sh[0] != 0.25).any()
    assert (by_now.sh == 0.25).all()


@pytest.mark.parametrize("changes", [{"refit": {"prior": -1.0}}, {"refit": {"prior": np.nan}}, {"fit": {"batch": 0}}])
def test_what_levels_choose_is_refused_where_it_is_out_of_range(changes):
    with pytest.raises(UsageError):
        EncodeOptions().changed(**changes)
