"""Rows of binary PLY files that several threads read."""

from __future__ import annotations

import os

import numpy as np
import pytest

from potr_cl import DataError, load_scene, save
from potr_cl.formats.scenes import ply_rows
from potr_cl.formats.scenes.ply_rows import Target, read_rows

KINDS = {
    "floats": np.dtype([("a", "<f4"), ("other", "<f4"), ("b", "<f4"), ("c", "<f4")]),
    "of the other byte order": np.dtype([("a", ">f4"), ("b", ">f4"), ("c", ">f4")]),
    "of many kinds": np.dtype([("a", "<f8"), ("other", "u1"), ("c", "<i4"), ("b", "<f4")]),
}


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setattr(ply_rows, "_BLOCK_BYTES", 300)


@pytest.fixture(params=["at a place", "one after another"])
def _ways(request, monkeypatch):
    """As systems read that can read at a place, and as others do."""
    if request.param == "one after another":
        monkeypatch.delattr(os, "preadv", raising=False)


def written(path, kind: str, count: int) -> np.ndarray:
    rows = np.zeros(count, KINDS[kind])
    for number, name in enumerate("abc"):
        rows[name] = np.arange(count) * 3 + number
    path.write_bytes(b"header" + rows.tobytes() + b"more")
    return rows


@pytest.mark.usefixtures("_ways")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 18, 19, 1000])
def test_every_value_comes_where_it_belongs(tmp_path, kind, count):
    rows = written(tmp_path / "rows", kind, count)
    pair, single = np.full((count, 2), np.nan, np.float32), np.full(count, np.nan, np.float32)
    wide = np.full((count, 3), np.nan, np.float32)
    targets = [Target(pair, ("c", "a")), Target(single[:, None], ("b",)), Target(wide[:, :2], ("b", "c"))]
    with open(tmp_path / "rows", "rb", buffering=0) as stream:
        read_rows("rows", stream, 6, rows.dtype, count, targets)
    assert np.array_equal(pair, np.stack([rows["c"], rows["a"]], axis=1).astype(np.float32))
    assert np.array_equal(single, rows["b"].astype(np.float32))
    assert np.array_equal(wide[:, :2], np.stack([rows["b"], rows["c"]], axis=1).astype(np.float32))
    assert np.isnan(wide[:, 2]).all()


@pytest.mark.usefixtures("_ways")
def test_a_file_that_became_shorter_is_told_where_it_ends(tmp_path):
    rows = written(tmp_path / "rows", "floats", 1000)
    os.truncate(tmp_path / "rows", 6 + 500 * rows.itemsize + 3)
    found = np.empty((1000, 1), np.float32)
    told = pytest.raises(DataError, match="'rows' is truncated: it ends within splat 500")
    with open(tmp_path / "rows", "rb", buffering=0) as stream, told:
        read_rows("rows", stream, 6, rows.dtype, 1000, [Target(found, ("a",))])


def test_a_scene_of_many_blocks_is_the_scene(tmp_path, plush_excerpt):
    save(plush_excerpt, tmp_path / "scene.ply")
    assert load_scene(tmp_path / "scene.ply") == plush_excerpt


@pytest.mark.skipif(not hasattr(os, "preadv"), reason="reads in another way")
@pytest.mark.parametrize("change", ["grows", "is cut", "is written over"])
def test_a_file_that_another_program_writes_meanwhile(tmp_path, plush_excerpt, monkeypatch, change):
    """Values of two states of a file are no scene."""
    path = tmp_path / "scene.ply"
    save(plush_excerpt, path)
    os.utime(path, ns=(0, 0))
    read = os.preadv

    def disturbed(*arguments):
        if change == "is cut":
            os.truncate(path, path.stat().st_size // 2)
        else:
            with path.open("r+b") as file:
                file.seek(0, os.SEEK_END if change == "grows" else os.SEEK_SET)
                file.write(b"ply")
        return read(*arguments)

    monkeypatch.setattr(os, "preadv", disturbed)
    with pytest.raises(DataError, match=r"scene.ply' was changed while it was read: wait until the program"):
        load_scene(path)
