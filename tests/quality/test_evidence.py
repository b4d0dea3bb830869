"""What photographs and points of a reconstruction say of cameras: wrong frames are found, right ones never refused."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from potr_cl import Camera, Scene, UsageError, load_cameras, load_scene
from potr_cl.formats.images import to_8_bits
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.camera import resized, train_views
from potr_cl.model.lens import Lens
from potr_cl.opencl.device import Device
from potr_cl.pipeline.frame import check_frame
from potr_cl.quality.evidence import by_photographs, by_points, evidence_of
from potr_cl.raster.rasterizer import Rasterizer
from tests.cases.photographs import bent
from tests.reference.captures import CAPTURES
from tests.reference.frames import ORDINARY, PHOTOGRAPHS, changed, moved, parts

PHOTOGRAPHED = (0, 11, 23, 35)
#: Of each kind of motion the smallest ones, which are the hardest to find.
LEAST = ("scaled by 0.7", "scaled by 1.5", "shifted by 1 along x", "turned by 10 degrees about z")


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, list[Camera]]:
    """A scene by rule, and cameras with photographs of it."""
    scene, cameras = CAPTURES["building"]()
    folder = tmp_path_factory.mktemp("photographs")
    views = []
    with Rasterizer(Device(), scene, background=(0.4, 0.5, 0.6)) as rasterizer:
        for number in PHOTOGRAPHED:
            view = resized(train_views(cameras)[number], 160, 120)
            path = folder / f"{number}.jpg"
            Image.fromarray(to_8_bits(rasterizer.render(view)[0])).save(path, quality=90)
            views.append(dataclasses.replace(view, image_path=path))
    return scene, views


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion", ["scaled by 0.7", "scaled by 2", "shifted by 3 along x", "turned by 20 degrees about y"]
)
def test_a_scene_that_was_moved_is_refused_by_its_photographs(building, motion):
    scene, views = building
    with pytest.raises(UsageError, match=r"frame: seen from the cameras, the scene does not look like the photos"):
        check_frame(moved(scene, *ORDINARY[motion]), views, anyway=False)
    check_frame(moved(scene, *ORDINARY[motion]), views, anyway=True)


def test_a_scene_in_place_is_taken_whatever_became_of_its_photographs(building, tmp_path, caplog):
    scene, views = building
    for which in (None, *PHOTOGRAPHS):
        cameras = views if which is None else changed(views, which, tmp_path)
        assert evidence_of(scene, cameras).agrees is True, which
        check_frame(scene, cameras, anyway=False)
    assert not caplog.records


def test_photographs_that_cannot_be_read_or_have_another_shape_say_nothing(building, tmp_path):
    scene, views = building
    Image.new("RGB", (120, 160)).save(tmp_path / "upright.png")
    (tmp_path / "damaged.png").write_bytes(b"\x89PNG")
    for name in ("upright.png", "damaged.png", "missing.png"):
        assert by_photographs(scene, [dataclasses.replace(views[0], image_path=tmp_path / name)]) is None


def test_photographs_are_straightened_before_they_are_compared(building, tmp_path):
    scene, views = building
    lens = Lens(160, 120, views[0].fx, views[0].fy, 80, 60, radial=(-0.25,))
    cameras = []
    with Rasterizer(Device(), scene) as rasterizer:
        for view in views:
            wide = dataclasses.replace(view, **lens.covering()[0]._asdict(), image_path=None)
            path = tmp_path / f"{view.name}.png"
            Image.fromarray(bent(rasterizer.render(wide)[0], wide, lens)).save(path)
            cameras.append(dataclasses.replace(wide, lens=lens, image_path=path))
    assert evidence_of(scene, cameras).agrees is True


def test_points_find_what_was_moved_and_take_parts(building):
    scene, _ = building
    points = scene.means[np.random.default_rng(0).integers(len(scene), size=5000)].astype(np.float64)
    points += np.random.default_rng(1).normal(scale=1e-3, size=points.shape)
    for part in (scene, *parts(scene, len(scene) // 4, 3)):
        assert by_points(part, points).agrees is None
    for what, motion in ORDINARY.items():
        if "scaled" in what:
            assert by_points(moved(scene, *motion), points).agrees is False, what
    assert by_points(scene, points[:100]) is None


def test_cameras_that_nothing_confirms_are_taken_as_they_are(building, caplog):
    scene, views = building
    bare = [dataclasses.replace(view, image_path=None) for view in views]
    with caplog.at_level(logging.INFO, "potr_cl"):
        check_frame(scene, bare, anyway=False)
    assert "were taken as they are" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lego", "plush"])
def test_every_ordinary_motion_of_a_whole_scene_is_found(name, request, caplog):
    folder: Path = request.getfixturevalue(name)
    scene, views = load_scene(folder / "point_cloud.ply"), train_views(load_cameras(folder))
    pointed = train_views(load_cameras(folder / "sparse" / "0")) if name == "plush" else []
    pointed = [dataclasses.replace(view, image_path=None) for view in pointed]
    known = list(filter(None, (views, pointed)))
    for cameras in known:
        check_frame(scene, cameras, anyway=False)
    for what in LEAST:
        other = moved(scene, *ORDINARY[what])
        for cameras in known:
            found = judge_cameras(other, cameras, evidence_of(other, cameras))
            assert found.suspicious or found.doubt, what
    assert not caplog.records
