"""Files that fuzzers found: memory reserved on a file's word, warnings of libraries where one line should stand."""

from __future__ import annotations

import contextlib
import struct
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from potr_cl.errors import DataError
from potr_cl.formats import load_scene, save_scene
from potr_cl.formats.images import image_size, read_ground_truth
from tests.cases.cameras import nerfstudio, refused, view, write_json
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings
from tests.reference.scenes import random_scene

#: Of double precision, by its bits: one that must not be computed with.
SIGNALLING_NAN = struct.pack("<Q", 0x7FF0000000000001)


@pytest.fixture(autouse=True)
def _warnings_are_errors():
    with no_warnings():
        yield


@pytest.mark.parametrize("value", [SIGNALLING_NAN, struct.pack("<d", 1e300), struct.pack("<d", float("inf"))])
def test_a_number_that_single_precision_has_not_gives_no_warning(tmp_path, value):
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    header += [*(f"property double {name}" for name in names), "end_header", ""]
    values = np.ones((3, len(names)), "<f8").tobytes()
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + value + values[8:])
    assert len(load_scene(tmp_path / "a.ply")) == 2


def test_infinite_bounds_of_a_chunk_give_no_warning(tmp_path):
    save_scene(tmp_path / "a.compressed.ply", random_scene(300, 0))
    data = bytearray((tmp_path / "a.compressed.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = data[start + 12 : start + 16] = struct.pack("<f", float("inf"))
    (tmp_path / "a.compressed.ply").write_bytes(data)
    assert len(load_scene(tmp_path / "a.compressed.ply")) == 300 - 256


def test_a_view_or_frame_beyond_all_numbers_gives_no_warning(tmp_path):
    turned = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    content = nerfstudio(["a.png"])
    content["frames"][0]["transform_matrix"] = [[*row, 1.7e308] for row in turned]
    for each in ([view(rotation=turned, position=[1.7e308] * 3)], content):
        refused(write_json(tmp_path / "a.json", each), "non-finite")


def test_pngs_whose_rows_are_said_to_take_gigabytes_or_that_are_said_to_be_animated(tmp_path):
    path = tmp_path / "a.png"
    Image.new("RGB", (8, 8)).save(path)
    good = path.read_bytes()  # with a header of 33 bytes
    path.write_bytes(good[:33] + struct.pack(">I", 0x40000000) + good[37:])
    with takes_at_most(1 << 20), contextlib.suppress(DataError):
        read_ground_truth(path)
    kind = b"acTL" + bytes(8)
    path.write_bytes(good[:33] + struct.pack(">I", 8) + kind + struct.pack(">I", zlib.crc32(kind)) + good[33:])
    assert image_size(path) == (8, 8)
    assert read_ground_truth(path).shape == (8, 8, 3)


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
