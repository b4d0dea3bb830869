"""The stage that adds views between the training views: what it does to files, and what the added views show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec.decoder import decode
from potr_cl.errors import UsageError
from potr_cl.formats.images import to_8_bits, write_png
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.views_between import views_between
from potr_cl.model.virtual_cameras import place_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.targets import GroundTruthTargets, PartlyPhotographed, RenderedTargets
from potr_cl.stages.views_between import Between


@pytest.fixture(scope="module")
def device():
    return Device()


def options(views: float | str, **changes):
    return EncodeOptions.for_preset("best", between={"views": views}, prune={"iterations": 12}, **changes)


def file_of(device, scene, cameras, chosen) -> bytes:
    return b"".join(encode(scene, cameras, chosen, device=device).pieces)


def test_added_views_are_looked_at_as_if_they_had_been_given(device, plush_excerpt, plush_excerpt_cameras):
    given = train_views(plush_excerpt_cameras)
    more = [*given, *views_between(plush_excerpt, given, 2)]
    assert len(more) > 2 * len(given)
    asked = file_of(device, plush_excerpt, given, options(2))
    assert asked == file_of(device, plush_excerpt, more, options(0))
    assert asked != file_of(device, plush_excerpt, given, options(0))


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


def test_virtual_cameras_and_single_ones_get_none(device, plush_excerpt, plush_excerpt_cameras):
    for cameras in (place_cameras(plush_excerpt, 6, 64), train_views(plush_excerpt_cameras)[:1]):
        alone, asked = (file_of(device, plush_excerpt, cameras, options(views)) for views in (0, 2))
        assert alone == asked


def test_it_is_left_out_where_nothing_else_looks_at_views(plush_excerpt, plush_excerpt_cameras):
    chosen = options(3, refit=False, compact=False).changed(prune=False)
    assert not chosen.look_at_views(plush_excerpt)
    assert encode(plush_excerpt, plush_excerpt_cameras, chosen).device is None


@pytest.mark.parametrize("numbers", [range(0, 3), range(2, 6), range(5, 7)])
def test_photographs_are_targets_of_the_views_that_have_them(
    device, plush_excerpt, plush_excerpt_cameras, tmp_path, numbers
):
    given = train_views(plush_excerpt_cameras)[:4]
    views = [*given, *views_between(plush_excerpt, given, 2)]
    with Rasterizer(device, plush_excerpt) as shown:
        for camera in given:
            with (tmp_path / f"{camera.name}.png").open("wb") as file:
                write_png(file, to_8_bits(np.full((camera.height, camera.width, 3), 0.25, np.float32)))
        photographs = GroundTruthTargets(device, GroundTruth(tmp_path, given), views)
        targets = PartlyPhotographed(photographs, len(given), RenderedTargets(shown, views))
        shape = (len(numbers), views[0].height, views[0].width, 3)
        buffer = device.allocate(4 * int(np.prod(shape)), "pictures")
        try:
            targets.into(numbers, buffer)
            pictures = device.download(buffer, shape, np.float32)
        finally:
            device.free(buffer)
        for number, picture in zip(numbers, pictures, strict=True):
            if number < len(given):
                assert np.allclose(picture, 64 / 255, atol=1e-6)
            else:
                assert np.array_equal(picture, shown.render(views[number])[0])


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
