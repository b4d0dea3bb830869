"""The stage that adds views between the training views: what it does to files, and what the added views show."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import PRESETS, HyperParameters
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.views_between import is_between, views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import Target
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.stages.views_between import Between, most_needed, needed, views_where_few


def options(views: float | str, **changes):
    return EncodeOptions.for_preset("best", between={"views": views}, prune={"iterations": 6}, **changes)


def file_of(device, scene, cameras, chosen) -> bytes:
    return encode(scene, cameras, chosen, device=device).data


@pytest.mark.slow
def test_added_views_are_looked_at_as_if_they_had_been_given(usual_device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    more = [*given, *views_between(plush_excerpt, given, 2)]
    assert len(more) > 2 * len(given)
    asked = file_of(usual_device, plush_excerpt, given, options(2))
    assert asked == file_of(usual_device, plush_excerpt, more, options(0))
    assert asked != file_of(usual_device, plush_excerpt, given, options(0))


@pytest.mark.slow
def test_what_lies_between_few_views_gets_better_at_no_more_bytes(usual_device, plush_excerpt, plush_excerpt_cameras):
    judges = test_views(plush_excerpt_cameras)

    def judged(views: int) -> tuple[int, float]:
        file = file_of(usual_device, plush_excerpt, plush_excerpt_cameras, options(views))
        with Rasterizer(usual_device, plush_excerpt) as source, Rasterizer(usual_device, decode(file)) as decoded:
            errors = [psnr(source.render(c)[0], decoded.render(c)[0]) for c in judges]
        return len(file), float(np.mean(errors))

    (few, before), (more, after) = judged(0), judged(2)
    assert more < 1.01 * few
    assert after > before + 0.3


def added(device, scene, views, between: Between | None = None, **changes) -> tuple[int, State]:
    """How many views the scene is found to need, and the state with them."""
    bench = Workbench(HyperParameters.from_quality(0.5), device=device, **changes)
    state = (between or Between()).run(State.of(scene, views), bench)
    return state.added, state


def test_a_scene_of_which_parts_are_seen_by_few_views_gets_more(usual_device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    count, state = added(usual_device, plush_excerpt, given)
    assert 0 < count <= 5 * len(given)
    assert state.views[: len(given)] == tuple(given)
    assert len(state.views) == len(given) + count
    assert all(is_between(camera) for camera in state.views[len(given) :])
    assert (state.results.between.given, state.results.between.added) == (len(given), count)
    assert str(state.results.between) == f"{count} extra views between the 9 training views"
    _, again = added(usual_device, plush_excerpt, given)
    assert [(view.name, *view.centre) for view in again.views] == [(view.name, *view.centre) for view in state.views]


def test_single_cameras_get_none(usual_device, plush_excerpt, plush_excerpt_cameras):
    single = train_views(plush_excerpt_cameras)[:1]
    count, state = added(usual_device, plush_excerpt, single, Between(views=2))
    assert count == 0
    assert state.views == tuple(single)


def test_dense_views_get_none(usual_device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    dense = [*given, *views_between(plush_excerpt, given, 6)]
    assert len(dense) > 50
    count, state = added(usual_device, plush_excerpt, dense)
    assert count == 0
    assert state.views == tuple(dense)


@pytest.mark.slow
def test_only_as_many_are_added_as_fit_the_memory(usual_device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    wanted, _ = added(usual_device, plush_excerpt, given)
    memories = range(0, 32_000_000, 2_000_000)
    counts = [added(usual_device, plush_excerpt, given, memory=memory)[0] for memory in memories]
    assert counts[0] == 0
    assert counts[-1] == wanted
    assert counts == sorted(counts)
    some = memories[counts.index(next(count for count in counts if 0 < count < wanted))]
    # What pruning keeps of views with that budget is within it, and no view is made again for each measurement.
    _, state = added(usual_device, plush_excerpt, given, memory=some)
    with Rasterizer(usual_device, plush_excerpt) as rasterizer:
        before = usual_device.allocated
        with RemovalSweep(rasterizer, state.views, SweepOptions(memory=some)) as sweep:
            assert sweep.ready_views == len(state.views)
            assert usual_device.allocated - before < some + 1_000_000
    assert usual_device.allocated == 0


@pytest.mark.slow
def test_a_search_finds_them_once(usual_device, plush_excerpt, plush_excerpt_cameras):
    began = []
    chosen = EncodeOptions.for_preset("best", prune={"iterations": 16})
    found = encode_to_target(
        plush_excerpt,
        plush_excerpt_cameras,
        Target(max_bytes=24_000),
        chosen,
        device=usual_device,
        progress=lambda what, done: began.append(what) if done == 0 else None,
    )
    assert began.count("prune") > 1
    assert began.count("views between") == 1
    again = encode(plush_excerpt, plush_excerpt_cameras, found.options, device=usual_device)
    assert again.data == found.encoded.data


@pytest.mark.parametrize("preset", PRESETS)
def test_all_presets_but_the_papers_add_them(preset):
    assert EncodeOptions.for_preset(preset).between.asked_for == (preset != "paper")


@pytest.mark.slow
def test_virtual_cameras_get_some_if_they_are_asked_for(usual_device, plush_excerpt):
    """By themselves none: as many as are needed have been placed. With them, they go on to be virtual."""
    state = State.of(plush_excerpt, train_views(place_cameras(plush_excerpt, 8, 64)))
    bench = Workbench(HyperParameters.from_quality(0.5, "best"), device=usual_device)
    alone = Between().run(state, bench)
    assert not alone.added
    assert 0 < alone.results.shown <= 1
    asked = Between(views=1.0).run(state, bench)
    assert 2 < asked.added <= 8
    assert is_virtual(asked.views)
    assert not is_virtual(asked.views[8:])


def test_it_is_left_out_where_nothing_else_looks_at_views(plush_excerpt, plush_excerpt_cameras):
    chosen = options(3, refit=False, compact=False).changed(prune=False)
    assert not chosen.look_at_views(plush_excerpt)
    assert encode(plush_excerpt, plush_excerpt_cameras, chosen).device is None


# ------------------------------------------------------------------------------------------ how many


@pytest.mark.parametrize("slow", [False, True])
def test_the_fewer_views_show_it_the_more_are_added(slow):
    amounts = [needed(shown, 100, slow) for shown in (100, 50, 25, 12, 6, 3, 1)]
    assert amounts == sorted(amounts)
    assert amounts[0] == 0
    assert amounts[-1] == most_needed(100, slow, few=True) > 0


def test_what_few_views_show_counts_however_many_show_the_rest():
    assert views_where_few(np.repeat([5, 80], [40, 60])) == 5
    # But not a few splats behind the cameras.
    assert views_where_few(np.repeat([1, 80], [10, 90])) == 80


@pytest.mark.parametrize("views", [2, 8, 20, 84, 300, 2000])
def test_they_take_no_more_than_their_share_of_the_time(views):
    """As measured: on a GPU an encode takes as long as some 130 views besides its views, on a CPU as some 6."""
    for slow, besides in ((False, 130), (True, 6)):
        for shown_by, most in ((10, 1.6), (1, 2.2)):
            added = views * needed(shown_by, views, slow)
            assert added > 0
            assert (besides + views + added) / (besides + views) < most


@pytest.mark.parametrize("slow", [False, True])
def test_where_few_views_show_a_part_an_encode_takes_more_time(slow):
    assert needed(9, 300, slow) > 1.5 * needed(10, 300, slow)
