"""The .splat format: what is special to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from potr_cl import DataError
from potr_cl.formats import load_scene

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def rows(count: int) -> np.ndarray:
    made = np.zeros(count, ROW)
    made["scale"], made["colour"], made["rotation"] = 0.5, 128, (255, 128, 128, 128)
    return made


@pytest.mark.parametrize("size", [0, 1, 31, 33, 100])
def test_files_that_are_no_whole_number_of_splats(size: int, tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(bytes(size))
    with pytest.raises(DataError, match=rf"no .splat file, or is truncated: it has {size} bytes"):
        load_scene(tmp_path / "a.splat")


def test_values(tmp_path: Path) -> None:
    """By the definition of the format, for more splats than are read at a time."""
    made = rows(70_000)
    made["mean"][:, 0] = np.arange(70_000)
    made["colour"][69_999] = (0, 255, 51, 51)
    made["rotation"][69_999] = (0, 255, 255, 0)
    (tmp_path / "a.splat").write_bytes(made.tobytes())
    scene = load_scene(tmp_path / "a.splat")
    assert scene.sh_degree == 0
    np.testing.assert_array_equal(scene.means[:, 0], np.arange(70_000))
    np.testing.assert_allclose(scene.scales, 0.5, rtol=1e-6)
    colours = scene.sh[69_999, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(colours, [0, 1, 0.2], atol=1e-6)
    assert scene.opacities[69_999] == pytest.approx(0.2)
    np.testing.assert_allclose(scene.quaternions[69_999], [-0.5, 0.5, 0.5, -0.5], atol=1e-6)


def test_scales_without_a_logarithm(tmp_path: Path) -> None:
    made = rows(4)
    made["scale"][0, 2], made["scale"][1, 0], made["scale"][2, 1] = 0, -1, np.nan
    (tmp_path / "a.splat").write_bytes(made.tobytes())
    scene = load_scene(tmp_path / "a.splat")
    assert len(scene) == 2
    assert scene.scales[0, 2] == pytest.approx(1e-9, rel=1e-5)
