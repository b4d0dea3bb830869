"""Files that fuzzers found: memory reserved on a file's word, warnings of libraries where one line should stand."""

from __future__ import annotations

import contextlib
import json
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from potr_cl.errors import DataError
from potr_cl.formats import load_cameras, load_scene, save_scene
from potr_cl.formats.images import image_size, read_ground_truth
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings
from tests.reference.scenes import random_scene

#: Of double precision, by its bits: one that must not be computed with.
SIGNALLING_NAN = struct.pack("<Q", 0x7FF0000000000001)


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with no_warnings():
        yield


def ply_in_double_precision(path: Path, splats: int, first: bytes) -> None:
    """A scene of SH degree 0 whose first value is given by its bytes."""
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {splats}"]
    header += [*(f"property double {name}" for name in names), "end_header", ""]
    values = bytearray(np.ones((splats, len(names)), "<f8").tobytes())
    values[:8] = first
    path.write_bytes("\n".join(header).encode() + values)


@pytest.mark.parametrize("value", [SIGNALLING_NAN, struct.pack("<d", 1e300), struct.pack("<d", float("inf"))])
def test_a_number_that_single_precision_has_not_gives_no_warning(tmp_path, value):
    ply_in_double_precision(tmp_path / "a.ply", 3, value)
    assert len(load_scene(tmp_path / "a.ply")) == 2


def test_infinite_bounds_of_a_chunk_give_no_warning(tmp_path):
    save_scene(tmp_path / "a.compressed.ply", random_scene(300, 0))
    data = bytearray((tmp_path / "a.compressed.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = data[start + 12 : start + 16] = struct.pack("<f", float("inf"))
    (tmp_path / "a.compressed.ply").write_bytes(data)
    assert len(load_scene(tmp_path / "a.compressed.ply")) == 300 - 256


def test_a_view_beyond_all_numbers_gives_no_warning(tmp_path):
    view = {"img_name": "a.png", "width": 8, "height": 8, "fx": 8, "fy": 8, "position": [1.7e308, 1.7e308, 1.7e308]}
    view["rotation"] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    (tmp_path / "cameras.json").write_text(json.dumps([view]))
    with pytest.raises(DataError, match="non-finite"):
        load_cameras(tmp_path / "cameras.json")


def test_a_frame_beyond_all_numbers_gives_no_warning(tmp_path):
    rows = [[0.8, -0.6, 0, 1.7e308], [0.6, 0.8, 0, 1.7e308], [0, 0, 1, 1.7e308], [0, 0, 0, 1]]
    frame = {"file_path": "a.png", "transform_matrix": rows, "w": 8, "h": 8, "fl_x": 8}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with pytest.raises(DataError, match="non-finite"):
        load_cameras(tmp_path / "transforms.json")


def png(path: Path, *more: tuple[bytes, bytes]) -> bytearray:
    """A good PNG of 8 x 8 pixels with some chunks behind its header."""
    Image.new("RGB", (8, 8)).save(path)
    data = path.read_bytes()
    made = b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in more
    )
    return bytearray(data[:33] + made + data[33:])


def test_a_png_whose_rows_are_said_to_take_gigabytes(tmp_path):
    data = png(tmp_path / "a.png")
    data[33:37] = struct.pack(">I", 0x40000000)
    (tmp_path / "a.png").write_bytes(data)
    with takes_at_most(1 << 20), contextlib.suppress(DataError):
        read_ground_truth(tmp_path / "a.png")


def test_a_png_that_is_said_to_be_animated_gives_no_warning(tmp_path):
    (tmp_path / "a.png").write_bytes(png(tmp_path / "a.png", (b"acTL", bytes(8))))
    assert image_size(tmp_path / "a.png") == (8, 8)
    assert read_ground_truth(tmp_path / "a.png").shape == (8, 8, 3)


def test_a_sog_member_that_is_said_to_take_gigabytes(tmp_path, data):
    content = bytearray((data / "foreign" / "degree_0.sog").read_bytes())
    with zipfile.ZipFile(data / "foreign" / "degree_0.sog") as archive:
        number = archive.namelist().index("meta.json")
    entry = -1
    for _ in range(number + 1):
        entry = content.index(b"PK\1\2", entry + 1)
    content[entry + 20 : entry + 24] = struct.pack("<I", 0x40000000)
    (tmp_path / "a.sog").write_bytes(content)
    with takes_at_most(8 << 20), pytest.raises(DataError, match="larger than itself"):
        load_scene(tmp_path / "a.sog")
