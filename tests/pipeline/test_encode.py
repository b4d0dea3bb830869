"""The encoder's stages together: pruning and compaction on a real excerpt."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.errors import UsageError
from potr_cl.model.camera import train_views
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch
from potr_cl.stages.code import Code
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.stage import State
from tests.cases import judging
from tests.cases.options import as_it_is
from tests.devices import FAMILIES, open_device
from tests.reference.scenes import random_scene, ring_of_cameras

FEW = EncodeOptions.for_preset("paper", prune={"iterations": 6})


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "the encoder did not give all its memory back"


@pytest.fixture(scope="module")
def views(plush_excerpt_cameras):
    return [c for c in plush_excerpt_cameras if c.split == "train"][:4]


def reduced(scene, cameras, options, device):
    """The scene after pruning and compaction, and what pruning did."""
    run = Run(options, Stopwatch(), device)
    state = run.stages(State.of(scene, train_views(cameras)), [Prune, Compact])
    return state.scene, state.results.pruned


def same(a, b):
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))


def test_pruning_and_compaction(device, plush_excerpt, views):
    left, pruned = reduced(plush_excerpt, views, FEW, device)
    assert len(left) == pruned.kept < 0.97 * len(plush_excerpt)
    assert ac_sparsity(left.sh, 51) > ac_sparsity(plush_excerpt.sh[pruned.survivors], 51) + 0.1
    assert judging.psnr(device, plush_excerpt, left, views) > 40
    # All but the colours comes through untouched.
    assert np.array_equal(left.means, plush_excerpt.means[pruned.survivors])


@pytest.mark.one_family
def test_each_on_its_own(device, plush_excerpt, views):
    only_pruned, pruned = reduced(plush_excerpt, views, FEW.changed(compact=False), device)
    assert same(only_pruned, plush_excerpt.subset(pruned.survivors))
    compacted, none = reduced(plush_excerpt, views, FEW.changed(prune=False), device)
    assert none is None
    assert len(compacted) == len(plush_excerpt)
    assert not np.array_equal(compacted.sh, plush_excerpt.sh)


@pytest.mark.one_family
@pytest.mark.parametrize("compact_at", [0.0, Compact.at, 1.0])
def test_a_small_memory_budget_gives_the_same_scene(device, plush_excerpt, views, compact_at):
    results = []
    for memory in (None, 48 * 1600, 0):
        # Views that are made anew each time are swept in full: so must those be that are kept.
        options = FEW.changed(prune={"iterations": 4, "tolerance": 0}, compact={"at": compact_at}, memory=memory)
        results.append(reduced(plush_excerpt, views, options, device)[0])
    assert same(results[0], results[1])
    assert same(results[0], results[2])


@pytest.mark.one_family
def test_degree_0_has_nothing_to_compact(device, monkeypatch):
    monkeypatch.setattr("potr_cl.stages.compact.Compactor", None)  # would fail if it were asked
    scene = random_scene(100, 0)
    left, _ = reduced(scene, ring_of_cameras(4), FEW.changed(prune={"count": 50}), device)
    assert len(left) == 50


def test_refits_on_the_way_need_none_at_the_end(device, plush_excerpt, views):
    options = FEW.changed(compact=False, refit={"steps": 0, "at": (0.5,)})
    left, pruned = reduced(plush_excerpt, views, options, device)
    assert not np.array_equal(left.sh, plush_excerpt.sh[pruned.survivors])
    left, pruned = reduced(plush_excerpt, views, options.changed(refit=False), device)
    assert np.array_equal(left.sh, plush_excerpt.sh[pruned.survivors])


def test_nothing_to_do_needs_no_device(monkeypatch):
    for module in ("encode", "run"):
        monkeypatch.setattr(f"potr_cl.pipeline.{module}.Device", None)
    encode(random_scene(20, 0), ring_of_cameras(4), EncodeOptions.for_preset("paper", prune=False))
    encode(random_scene(20, 3), None, EncodeOptions.for_preset("paper", prune=False, compact=False))


def test_same_bytes_every_time(device, plush_excerpt, views):
    files = {b"".join(encode(plush_excerpt, views, FEW, device=device).pieces) for _ in range(2)}
    assert len(files) == 1


def test_geometry_of_other_steps_is_not_coded():
    """As a search codes a reduced scene again in other steps than the re-fit saw."""
    scene, options = random_scene(300), EncodeOptions()
    known = (None, *(quantise_geometry(scene, EncodeOptions(q=q).parameters, []) for q in (0.5, 0.2)))
    run = Run(options, Stopwatch())
    files = {
        b"".join(run.finished(run.stages(dataclasses.replace(State.of(scene), geometry=geometry), [Code])).pieces)
        for geometry in known
    }
    assert len(files) == 1


@pytest.mark.one_family
def test_order_names_the_splats_of_the_source_and_progress_comes_to_an_end(device, plush_excerpt, views):
    seen = []
    options = FEW.changed(prune={"count": 300})
    encoded = encode(plush_excerpt, views, options, lambda stage, done: seen.append((stage, done)), device)
    assert len(encoded.order) == 300
    assert sorted(encoded.order) == encoded.pruned.survivors.tolist()
    assert [s for s, d in seen if d == 1] == ["prepare views", "compact", "prune", "octree", "entropy coding"]


def progress_of(scene, views, options, device) -> dict[str, list[float]]:
    told: dict[str, list[float]] = {}
    encode(scene, views, options, lambda stage, done: told.setdefault(stage, []).append(done), device)
    for parts in told.values():
        assert parts == sorted(parts)
        assert (parts[0], parts[-1]) == (0, 1)
    return told


@pytest.mark.one_family
def test_progress_of_pruning_is_of_its_time(device, plush_excerpt, views):
    """The first measurement takes much of it, the last ones little; where views are made again all take as long."""
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 10}, refit=False)
    early, late = np.array(progress_of(plush_excerpt, views, options, device)["prune"])[[1, 9]]
    assert early > 0.15
    assert late > 0.95
    made_again = progress_of(plush_excerpt, views, options.changed(memory=0), device)["prune"]
    assert made_again[1:10] == pytest.approx(np.arange(1, 10) / 10)


def test_progress_of_the_refit_is_of_its_time(device, plush_excerpt, views):
    """Before its first step all views are prepared and looked at, after its last one colours are rounded."""
    options = EncodeOptions.for_preset("best", between=False, prune={"iterations": 2})
    told = progress_of(plush_excerpt, views, options, device)["refit"]
    steps = np.diff(told)
    assert steps[0] > 3 * np.median(steps), "to the first step"
    assert steps[-1] == pytest.approx(2 * np.median(steps)), "from the last round on"
    assert told[-2] > 0.8, "told between the rounds too"


def test_a_stage_within_another_counts_for_itself(monkeypatch):
    now = iter([0.0, 1.0, 2.0, 5.0, 9.0, 10.0, 20.0, 21.0])
    # Not the clock of the whole process: other threads look at that.
    monkeypatch.setattr("potr_cl.pipeline.run.time", SimpleNamespace(perf_counter=lambda: next(now)))
    watch = Stopwatch()
    for stage, done in (("a", 0.0), ("a", 0.5), ("b", 0.0), ("b", 1.0), ("a", 0.7), ("a", 1.0), ("c", 1.0)):
        watch(stage, done)
    assert watch.seconds == {"a": 1 + 1 + 3 + 1 + 10, "b": 4, "c": 1}


def test_views_that_see_nothing(device):
    scene = random_scene(60, 1)
    away = [dataclasses.replace(c, translation=np.array([0, 0, -50.0])) for c in ring_of_cameras(2)]
    away = [dataclasses.replace(c, split="train") for c in away]
    left, _ = reduced(scene, away, FEW.changed(prune={"unseen": "drop"}), device)
    assert len(left) == 1  # an empty scene is no scene
    left, _ = reduced(scene, away, FEW, device)
    assert len(left) == len(scene)


@pytest.mark.one_family
@pytest.mark.parametrize(
    "bad",
    [{"compact": {"at": -0.1}}, {"refit": {"at": (1.1,)}}, {"prune": {"iterations": 0}}, {"compact": {"lam": -1}}],
)
def test_options_out_of_range(device, plush_excerpt, views, bad):
    with pytest.raises(UsageError):
        reduced(plush_excerpt, views, FEW.changed(**bad), device)


def test_a_file_is_not_saved_under_the_name_of_another_kind(tmp_path, plush_excerpt):
    encoded = encode(plush_excerpt, None, as_it_is("fast"))
    for name in ("a.ply", "a.spz", "a.compressed.ply"):
        with pytest.raises(UsageError, match=r"is no name for a \.potr file: encode with to='\."):
            encoded.save(tmp_path / name)
    for name in ("a.potr", "no_suffix", "a.part"):
        encoded.save(tmp_path / name)
        assert (tmp_path / name).read_bytes() == encoded.data


def test_the_papers_steps_go_into_no_bundles():
    with pytest.raises(UsageError, match="--entropy bundles is not for preset paper"):
        EncodeOptions.for_preset("paper", code={"entropy": "bundles"})
