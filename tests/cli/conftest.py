"""Files that the tests of the command line work on."""

from __future__ import annotations

import pytest

import potr_cl
from potr_cl.formats.scenes import ply
from potr_cl.model import agreement
from tests.cli.calls import cameras_json
from tests.reference.scenes import random_scene


@pytest.fixture(scope="session", autouse=True)
def judged_once(computed_once):
    """Whether cameras belong to a scene is asked in one more place by what only looks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("potr_cl.api.views.judge_cameras", agreement.judge_cameras)
        yield


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "scene.ply"
    ply.save(path, random_scene(200, 2))
    return path


@pytest.fixture(scope="session")
def encoded():
    return potr_cl.encode(random_scene(200, 2), prune=False, refit=False, compact=False, zstd_level=1).data


@pytest.fixture
def potr_path(tmp_path, scene_path, encoded):
    path = tmp_path / "scene.potr"
    path.write_bytes(encoded)
    return path


@pytest.fixture
def cameras_path(tmp_path):
    return cameras_json(tmp_path / "cameras.json")
