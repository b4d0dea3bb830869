"""Compressed PLY: its bounds, and bad files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from potr_cl.errors import DataError
from potr_cl.formats import load_scene, scene_writer
from potr_cl.reference.scenes import random_scene

pytest.importorskip("gsply", reason="the extra convert is not installed")


def test_bounds_of_a_compressed_ply_hold_neighbours(tmp_path):
    rng = np.random.default_rng(0)
    means = rng.uniform(size=(256 * 64, 3)).astype(np.float32)
    scene = dataclasses.replace(random_scene(len(means), 0), means=means)
    path = tmp_path / "a.compressed.ply"
    scene_writer(path)(scene)
    # Positions have 11, 10 and 11 bits: bounds of the whole scene would leave 0.35 / 1023 on average.
    distances, index = cKDTree(means).query(load_scene(path).means)
    assert len(np.unique(index)) == len(means)
    assert distances.mean() < 0.2 / 1023


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element vertex 1500", b"element vertex 1501", "1500 rows"),
        (b"element chunk 6", b"element chunk 5", "5 chunks"),
        (b"property float min_r\n", b"", "older layout"),
        (b"property uchar f_rest_0\n", b"", "44 SH coefficients"),
        (b"binary_little", b"binary_big\x20\x20\x20", "no compressed PLY that can be read"),
        (b"element vertex 1500", b"element vertex 0000", "no splat"),
        (b"end_header", b"end_haeder", "damaged"),
    ],
)
def test_bad_compressed_ply_files(tmp_path, data, old, new, message):
    content = (data / "foreign" / "degree_3.compressed.ply").read_bytes()
    assert old in content
    path = tmp_path / "bad.compressed.ply"
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        load_scene(path)


def test_a_truncated_compressed_ply(tmp_path, data):
    path = tmp_path / "short.ply"  # the content tells the format, not the name
    path.write_bytes((data / "foreign" / "degree_3.compressed.ply").read_bytes()[:-1])
    with pytest.raises(DataError, match="truncated"):
        load_scene(path)
