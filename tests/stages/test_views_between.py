"""The stage that adds views between the training views: what it does to files, and what the added views show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import PRESETS, HyperParameters
from potr_cl.errors import UsageError
from potr_cl.formats.images import to_8_bits, write_png
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.views_between import is_between, views_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
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
from potr_cl.stages.views_between import Between


@pytest.fixture(scope="module")
def device():
    return Device()


def options(views: float | str, **changes):
    return EncodeOptions.for_preset("best", between={"views": views}, prune={"iterations": 12}, **changes)


def file_of(device, scene, cameras, chosen) -> bytes:
    return b"".join(encode(scene, cameras, chosen, device=device).pieces)


@pytest.mark.slow
def test_added_views_are_looked_at_as_if_they_had_been_given(device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    more = [*given, *views_between(plush_excerpt, given, 2)]
    assert len(more) > 2 * len(given)
    asked = file_of(device, plush_excerpt, given, options(2))
    assert asked == file_of(device, plush_excerpt, more, options(0))
    assert asked != file_of(device, plush_excerpt, given, options(0))


@pytest.mark.slow
def test_what_lies_between_few_views_gets_better_at_no_more_bytes(device, plush_excerpt, plush_excerpt_cameras):
    judges = test_views(plush_excerpt_cameras)

    def judged(views: int) -> tuple[int, float]:
        file = file_of(device, plush_excerpt, plush_excerpt_cameras, options(views))
        with Rasterizer(device, plush_excerpt) as source, Rasterizer(device, decode(file)) as decoded:
            errors = [psnr(source.render(c)[0], decoded.render(c)[0]) for c in judges]
        return len(file), float(np.mean(errors))

    (few, before), (more, after) = judged(0), judged(2)
    assert more < 1.01 * few
    assert after > before + 0.3


def test_the_scene_decides_and_does_so_the_same_way_every_time(device, plush_excerpt, plush_excerpt_cameras):
    files = {file_of(device, plush_excerpt, plush_excerpt_cameras, options("auto")) for _ in range(2)}
    assert len(files) == 1


def added(device, scene, views, **changes) -> tuple[int, State]:
    """How many views the scene is found to need, and the state with them."""
    bench = Workbench(HyperParameters.from_quality(0.5), device=device, **changes)
    state = Between().run(State.of(scene, views), bench)
    return state.added, state


def test_a_scene_of_which_parts_are_seen_by_few_views_gets_more(device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    count, state = added(device, plush_excerpt, given)
    assert 0 < count <= 2 * len(given)
    assert state.views[: len(given)] == tuple(given)
    assert len(state.views) == len(given) + count
    assert all(is_between(camera) for camera in state.views[len(given) :])
    assert (state.results.between.given, state.results.between.added) == (len(given), count)


def test_dense_views_get_none(device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    dense = [*given, *views_between(plush_excerpt, given, 6)]
    assert len(dense) > 50
    count, state = added(device, plush_excerpt, dense)
    assert count == 0
    assert state.views == tuple(dense)


@pytest.mark.slow
def test_only_as_many_are_added_as_fit_the_memory_beside_the_given_ones(device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    wanted, _ = added(device, plush_excerpt, given)
    counts = [added(device, plush_excerpt, given, memory=step * 1_000_000)[0] for step in range(16)]
    assert counts[0] == 0
    assert counts[-1] == wanted
    assert counts == sorted(counts)
    some = counts.index(next(count for count in counts if 0 < count < wanted))
    # What pruning keeps of views with that budget is within it, and no view is made again for each measurement.
    _, state = added(device, plush_excerpt, given, memory=some * 1_000_000)
    with Rasterizer(device, plush_excerpt) as rasterizer:
        before = device.allocated
        with RemovalSweep(rasterizer, state.views, SweepOptions(memory=some * 1_000_000)) as sweep:
            assert sweep.resident_views == len(state.views)
            assert device.allocated - before < (some + 1) * 1_000_000
    assert device.allocated == 0


@pytest.mark.slow
def test_a_search_finds_them_once(device, plush_excerpt, plush_excerpt_cameras):
    began = []
    chosen = EncodeOptions.for_preset("best", prune={"iterations": 16})
    found = encode_to_target(
        plush_excerpt,
        plush_excerpt_cameras,
        Target(max_bytes=24_000),
        chosen,
        device=device,
        progress=lambda what, done: began.append(what) if done == 0 else None,
    )
    assert began.count("prune") > 1
    assert began.count("views between") == 1
    again = encode(plush_excerpt, plush_excerpt_cameras, found.options, device=device)
    assert again.data == found.encoded.data


@pytest.mark.parametrize("preset", PRESETS)
def test_all_presets_but_the_papers_add_them(preset):
    assert EncodeOptions.for_preset(preset).between.asked_for == (preset != "paper")


def test_the_summary_tells_of_them(device, plush_excerpt, plush_excerpt_cameras):
    encoded = encode(plush_excerpt, plush_excerpt_cameras, options(1), device=device)
    assert str(encoded.between) == "8 extra views between the 9 training views"


def test_single_cameras_get_none(device, plush_excerpt, plush_excerpt_cameras):
    single = train_views(plush_excerpt_cameras)[:1]
    alone, asked = (file_of(device, plush_excerpt, single, options(views)) for views in (0, 2))
    assert alone == asked


@pytest.mark.slow
def test_virtual_cameras_get_some_if_they_are_asked_for(device, plush_excerpt):
    """By themselves none: as many as are needed have been placed. With them, they go on to be virtual."""
    state = State.of(plush_excerpt, train_views(place_cameras(plush_excerpt, 8, 64)))
    bench = Workbench(HyperParameters.from_quality(0.5, "best"), device=device)
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


def test_photographs_are_only_asked_for_of_given_views(device, plush_excerpt, plush_excerpt_cameras, tmp_path):
    given = [dataclasses.replace(c, split="train") for c in train_views(plush_excerpt_cameras)]
    with Rasterizer(device, plush_excerpt) as shown:
        for camera in given:
            with (tmp_path / f"{camera.name}.png").open("wb") as file:
                write_png(file, to_8_bits(shown.render(camera)[0]))
    assert len(file_of(device, plush_excerpt, given, options(1, refit={"ground_truth": tmp_path}))) > 1000


@pytest.mark.parametrize("wrong", [{"views": -1}, {"views": 1000}, {"spread": -1.0}, {"spread": float("nan")}])
def test_wrong_values(wrong):
    with pytest.raises(UsageError, match="between"):
        Between(**wrong)
