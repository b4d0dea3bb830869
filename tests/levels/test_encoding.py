"""Encodes with levels of detail."""

from __future__ import annotations

from contextlib import closing, nullcontext

import numpy as np
import pytest

import potr_cl
from potr_cl import UsageError, cli
from potr_cl.codec.decoder import open_file
from potr_cl.codec.levels import splats_of_levels
from potr_cl.levels import encoding
from potr_cl.levels.plan import views_of_level
from potr_cl.model import splat_groups
from potr_cl.model.camera import test_views as held_out
from potr_cl.opencl.discovery import choose_device
from potr_cl.pipeline.encode import Kept, encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.fit import STEPS
from potr_cl.views import visibility
from potr_cl.workers.host import HostPool
from tests.cases.elsewhere import ElsewherePool
from tests.cases.judging import mean_error
from tests.cases.streets import street
from tests.devices import shared_device

QUICK = {"iterations": 6, "views_between": 0, "refit": 2}


@pytest.fixture(scope="module")
def device():
    device = shared_device(choose_device().family)
    yield device
    assert device.allocated == 0, "an encode did not give all its memory back"


@pytest.fixture(scope="module")
def encoded(plush_excerpt, plush_excerpt_cameras, device):
    return potr_cl.encode(
        plush_excerpt, plush_excerpt_cameras, levels=3, keep=0.8, judge=True, device=device, **QUICK
    )  # fmt: skip


def test_each_level_has_half_the_splats(encoded):
    assert splats_of_levels(open_file(encoded.data)) == [1200, 600, 300]
    assert [level.splats for level in encoded.levels] == [1200, 600, 300]
    assert encoded.nbytes == len(encoded.data)
    assert len(encoded.scene) == len(encoded.order) == 1200


def test_the_finest_level_is_the_scene_without_levels(encoded, plush_excerpt, plush_excerpt_cameras, device):
    alone = potr_cl.encode(plush_excerpt, plush_excerpt_cameras, keep=0.8, device=device, **QUICK)
    for field in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        assert np.array_equal(getattr(encoded.scene, field), getattr(alone.scene, field)), field


def test_a_level_is_made_for_the_views_in_which_it_is_shown(encoded, plush_excerpt, plush_excerpt_cameras, device):
    """There it is nearer to the full scene than as many splats that were chosen for the views as they are."""
    at_full_size = potr_cl.encode(plush_excerpt, plush_excerpt_cameras, count=300, device=device, **QUICK)
    views = views_of_level(held_out(plush_excerpt_cameras), 2)
    level = potr_cl.decode(encoded.data, level=2)
    assert len(level) == len(at_full_size.scene)
    own, other = (mean_error(device, plush_excerpt, each, views) for each in (level, at_full_size.scene))
    assert own < other


def test_the_report_tells_each_level(encoded):
    levels = encoded.report["levels"]
    assert [level["splats"] for level in levels] == [1200, 600, 300]
    assert levels[0]["psnr"] == pytest.approx(encoded.report["quality"]["psnr"])
    assert levels[1]["psnr"] > levels[2]["psnr"] > 30
    assert "2: 300 splats, PSNR" in str(encoded.report)


def test_errors_are_those_of_pixels_in_the_scene(encoded):
    errors = [block.error for block in open_file(encoded.data).blocks]
    assert errors[2] == 0
    scales = [level.scale for level in encoded.levels]
    assert errors[0] / errors[1] == pytest.approx(scales[1] / scales[2])


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"levels": 0}, "--levels is 0: give a number from 1 to 12, or auto"),
        ({"levels": "many"}, "--levels is 'many'"),
        ({"levels": 2, "to": ".spz"}, "--levels does not apply to .spz files"),
        ({"levels": 2, "max_size": 10_000}, "--max-size and --min-psnr are for files of one level"),
        ({"levels": 2, "prune": False}, "leave out --no-prune, or give --levels 1"),
    ],
)
def test_what_cannot_be_is_refused(plush_excerpt, plush_excerpt_cameras, choices, said):
    with pytest.raises(UsageError, match=said):
        potr_cl.encode(plush_excerpt, plush_excerpt_cameras, **QUICK, **choices)


def test_the_command_line_takes_a_number_or_auto(capsys):
    with pytest.raises(SystemExit):
        cli.main(["encode", "no.ply", "-o", "a.potr", "--levels", "some"])
    assert "--levels" in capsys.readouterr().err


def test_a_level_keeps_some_of_the_splats_of_the_next_finer_one_the_same_each_time(
    plush_excerpt, plush_excerpt_cameras, device, monkeypatch
):
    made = []

    def watched(*args, **named):
        made.append(encode(*args, **named))
        return made[-1]

    monkeypatch.setattr(encoding, "encode", watched)
    files = [
        potr_cl.encode(plush_excerpt, plush_excerpt_cameras, levels=2, count=200, device=device, fit=5, **QUICK).data
        for _ in range(2)
    ]
    assert files[0] == files[1]
    assert [level.options.fit.steps for level in made] == [5] * 4
    assert [len(level.order) for level in made] == [200, 100] * 2
    finer, coarser = made[:2]
    assert np.isin(coarser.order, finer.order).all()
    assert len(finer.importance) == len(plush_excerpt)
    assert coarser.importance is finer.importance


@pytest.mark.parametrize(("preset", "steps"), [("fast", STEPS["cpu"] // 2), ("paper", 0)])
def test_coarser_levels_are_fitted_where_nobody_asks_for_it(preset, steps):
    given = EncodeOptions(preset=preset)
    assert given.fit.steps == 0
    assert encoding.coarser(given, 1, 100, "cpu").fit.steps == steps
    assert encoding.coarser(given.changed(fit={"steps": 7}), 1, 100, "cpu").fit.steps == 7


def test_what_is_left_of_some_splats_shows_the_whole_scene(plush_excerpt, plush_excerpt_cameras, device):
    """Its colours make up for those that could not be kept."""
    among = np.arange(0, len(plush_excerpt), 3)
    options = EncodeOptions().changed(prune={"count": len(among)}, between={"views": 0.0})
    finer = Kept(among, None)
    found = encode(plush_excerpt, plush_excerpt_cameras, options, device=device, finer=finer)
    assert np.array_equal(np.sort(found.order), among)
    views = held_out(plush_excerpt_cameras)
    error, plain = (
        mean_error(device, plush_excerpt, scene, views)
        for scene in (potr_cl.decode(found.data), plush_excerpt.subset(among))
    )
    assert error < 0.7 * plain


@pytest.mark.slow
@pytest.mark.one_family
def test_levels_are_the_same_on_workers_that_have_what_their_views_see(monkeypatch):
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 10)
    monkeypatch.setattr(splat_groups, "LARGEST", 16)
    scene, cameras = street(houses=6, splats=300)
    options = EncodeOptions.for_preset(
        "best", prune={"iterations": 4, "keep": 0.6}, between={"views": 0}, refit={"steps": 2}, levels=3
    )
    found = []
    for workers in (None, HostPool, ElsewherePool):
        devices = [shared_device("cpu", number) for number in range(3)]
        with nullcontext() if workers is None else closing(workers(devices)) as pool:
            found.append(
                encoding.encode_levels(scene, cameras, options, None, devices[0], pool=pool, in_frame=True).data
            )
    assert found[0] == found[1] == found[2]
