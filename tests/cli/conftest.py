"""Files that the tests of the command line work on."""

from __future__ import annotations

import pytest

from potr_cl import cli
from potr_cl.formats.scenes import ply
from tests.cli.calls import KEEP, cameras_json
from tests.reference.scenes import random_scene


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "scene.ply"
    ply.save(path, random_scene(200, 2))
    return path


@pytest.fixture
def potr_path(tmp_path, scene_path, capsys):
    path = tmp_path / "scene.potr"
    assert cli.main(["encode", str(scene_path), "-o", str(path), "--zstd-level", "1", *KEEP]) == 0
    capsys.readouterr()
    return path


@pytest.fixture
def excerpt(data):
    """Arguments that encode a real excerpt fast."""
    return ["encode", data / "plush_excerpt.ply", "--cameras", data / "plush_excerpt_cameras.json", "--iterations", "4"]


@pytest.fixture
def cameras_path(tmp_path):
    return cameras_json(tmp_path / "cameras.json")
