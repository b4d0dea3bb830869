"""Cities: where copies stand, what they look like, and that the file is what was asked for."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import test_views as judging
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tools.make.city import Building, City, main, write_city


@pytest.fixture(scope="module")
def building(plush_excerpt, plush_excerpt_cameras) -> Building:
    return Building.of(plush_excerpt, plush_excerpt_cameras)


def test_any_number_of_splats_and_views(building, tmp_path):
    city = City([building], 4000)
    views = [*city.views(10, 64, 48), *city.views(3, 64, 48, "test")]
    write_city(tmp_path / "city", city, views)
    scene, cameras = load_scene(tmp_path / "city" / "point_cloud.ply"), load_cameras(tmp_path / "city")
    assert len(scene) == 4000
    assert city.copies == -(-4000 // len(building.scene)) == 3
    assert (len(train_views(cameras)), len(judging(cameras))) == (10, 3)
    assert {(c.width, c.height) for c in cameras} == {(64, 48)}
    again = tmp_path / "again"
    write_city(again, city, views)
    assert (again / "point_cloud.ply").read_bytes() == (tmp_path / "city" / "point_cloud.ply").read_bytes()


def test_copies_do_not_overlap(building):
    parts = list(City([building], 4 * len(building.scene)).parts())
    boxes = [(part.means[:, :2].min(axis=0), part.means[:, :2].max(axis=0)) for part in parts]
    for number, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:number]:
            assert ((high < other_low) | (other_high < low)).any()


def test_a_copy_looks_like_its_scene(building):
    """Turned about the up axis, colours included: the picture of its own view is the same."""
    city = City([building], 2 * len(building.scene))
    turned = list(city.parts())[1]
    view = city.views(2, 96, 64, across=0)[1]
    index = int(len(train_views(building.cameras)) * 0.6180339887498949)
    original = train_views(building.cameras)[index]
    original = dataclasses.replace(
        original, width=96, height=64, fx=view.fx, fy=view.fy, cx=48.0, cy=32.0, image_path=None
    )
    device, pictures = Device(), []
    for scene, camera in ((building.scene, original), (turned, view)):
        with Rasterizer(device, scene) as rasterizer:
            pictures.append(rasterizer.render(camera)[0])
    assert np.abs(pictures[0]).max() > 0.1
    assert np.abs(pictures[0] - pictures[1]).max() < 2e-3


def test_the_command(data, tmp_path, monkeypatch, capsys):
    source = f"{data / 'plush_excerpt.ply'},{data / 'plush_excerpt_cameras.json'}"
    words = [source, "-o", str(tmp_path), "--splats", "2e3", "--views", "4", "--size", "40x30"]
    monkeypatch.setattr(sys, "argv", ["city", *words])
    main()
    assert capsys.readouterr().out.startswith("2000 splats, 2 copies, 24 views")
