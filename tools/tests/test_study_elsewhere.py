"""Views that nobody has taken: where they stand, and that the study counts them all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from potr_cl.model.camera import focus, train_views
from potr_cl.reference.scenes import ring_of_cameras
from tools.study import elsewhere
from tools.workloads import excerpt


def test_where_the_views_stand():
    cameras = ring_of_cameras(24, 4.0, 64)
    at = focus(train_views(cameras))
    up = -np.mean([camera.rotation[1] for camera in train_views(cameras)], axis=0)
    up /= np.linalg.norm(up)

    def far(kind: str) -> float:
        return float(np.mean([np.linalg.norm(camera.centre - at) for camera in kinds[kind]]))

    def high(kind: str) -> float:
        return float(np.mean([up @ (camera.centre - at) for camera in kinds[kind]]))

    kinds = elsewhere.kinds_of_views(cameras)
    usual = float(np.mean([np.linalg.norm(camera.centre - at) for camera in train_views(cameras)]))
    assert far("half as far") == pytest.approx(usual / 2, rel=0.01)
    assert far("3 times as far") == pytest.approx(3 * usual, rel=0.01)
    assert high("25° lower") < high("test views") < high("25° higher")
    for kind in ("half as far", "25° higher", "25° lower"):
        for camera in kinds[kind]:  # they still look at the same point
            x, y, depth = camera.rotation @ at + camera.translation
            assert depth > 0
            assert max(abs(x), abs(y)) < 0.3 * depth


@pytest.mark.slow
def test_the_study_of_the_excerpt(tmp_path: Path):
    folder = excerpt(tmp_path / "excerpt")
    elsewhere.main([str(folder), "--presets", "fast", "--width", "60", "--json", str(tmp_path / "found.json")])
    table = json.loads((tmp_path / "found.json").read_text())["elsewhere"]
    assert [row[2] for row in table["rows"]] == ["true", "virtual"]
    for row in table["rows"]:
        assert all(20 < worst <= mean <= 99 for mean, worst in row[4:])
