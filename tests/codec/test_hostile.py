"""Files made to harm: what would take memory out of proportion, and what only a strict reader finds."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from potr_cl.codec import container
from potr_cl.codec.byte_planes import pack_integers
from potr_cl.codec.container import MOST_A_BYTE, EntropyCoder, Header
from potr_cl.codec.decoder import PotrFile, decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Coder, Property
from potr_cl.errors import DataError, UsageError
from potr_cl.model.claims import FREE_SPLATS
from potr_cl.model.scene import Scene
from tests.cases.own_warnings import no_warnings
from tests.oracles.decoder import decode as decode_independently
from tests.reference.scenes import random_scene

LONE = (Property.TAIL_LENGTH, 0, b"\0", 1)  # what the octree of a single splat consists of
ZSTD = EntropyCoder("zstd", 19)
DEFLATE = EntropyCoder("npz")
LARGEST = float(np.finfo(np.float32).max)


def made_of(streams, splats=1, depth=0, version=2, degree=0, coder=ZSTD, origin=(0.0, 0.0, 0.0), side=1.0) -> bytes:
    """A file of some sections (property, index, bytes, planes); opacity is 0 unless it is among them."""
    if not any(prop == Property.OPACITY for prop, *_ in streams):
        streams = [*streams, (Property.OPACITY, 0, bytes(splats), 1)]
    header = Header(version, splats, degree, origin, side, depth, 10.0, 10.0, 10.0, 10.0, 10.0)
    return b"".join(container.assemble(header, [coder.section(*stream) for stream in streams]))


def one_leaf(splats, depth=0) -> list:
    """Positions of splats that all lie in one leaf, the first cell of every level."""
    crowded = np.packbits(np.ones(depth, bool), bitorder="little").tobytes()
    tree = [(Property.OCCUPANCY, 0, b"\1" * depth, 1), (Property.SEVERAL, 0, crowded, 1)] if depth else []
    return [*tree, (Property.MULTIPLICITY, 0, splats.to_bytes(8, "little"), 8)]


def refused_without_memory(data, message, trust=False):
    """That a file is refused before anything of it is unpacked: its header alone tells."""
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=message):
            PotrFile.from_bytes(data, trust)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


# Bombs ---------------------------------------------------------------------------------------------------------------

ZEROS = bytes(1 << 25)
LONG = {
    "several": (Property.SEVERAL, 0, ZEROS, 1),
    "multiplicity": (Property.MULTIPLICITY, 0, ZEROS, 1),
    "multiplicity of eight planes": (Property.MULTIPLICITY, 0, ZEROS, 8),
    "occupancy": (Property.OCCUPANCY, 0, b"\1" * (1 << 25), 1),
    "tail length": (Property.TAIL_LENGTH, 0, ZEROS, 1),
    "tail": (Property.TAIL, 0, ZEROS, 1),
}


@pytest.mark.parametrize("coder", [ZSTD, DEFLATE], ids=["zstd", "deflate"])
@pytest.mark.parametrize("name", LONG)
def test_a_long_run_in_the_octree_of_one_splat(name, coder):
    """Whether or not the file is trusted: no octree of one splat needs that."""
    data = made_of([LONG[name]], coder=coder, version=1, depth=52)
    for trust in (False, True):
        refused_without_memory(data, "holds 33554432 integers|holds 4194304 integers", trust)


def test_the_longest_octree_that_some_splats_can_need_is_read():
    """Two splats in the same cell of all levels but the last."""
    octants = [(Property.OCCUPANCY, 0, b"\1" * 51 + b"\3", 1)]
    crowded = np.packbits(np.arange(53) < 51, bitorder="little").tobytes()
    streams = [*octants, (Property.SEVERAL, 0, crowded, 1), (Property.TAIL_LENGTH, 0, bytes(2), 1)]
    assert len(decode(made_of(streams, splats=2, depth=52))) == 2


@pytest.mark.parametrize("splats", [10_000_000, 1 << 30])
def test_a_leaf_of_countless_splats(splats):
    """A kilobyte that would become gigabytes."""
    data = made_of(one_leaf(splats), splats, coder=ZSTD) if splats < 1 << 26 else None
    if data is None:  # the bytes of a thousand million opacities need not be made to be claimed
        data = claiming(made_of(one_leaf(10_000_000), 10_000_000), splats)
    assert len(data) < 2000
    refused_without_memory(data, rf"{splats}.*--trust|opacity.*claims a size")


def claiming(data, splats):
    """The same file with another number of splats in header and opacity."""
    header = PotrFile.from_bytes(data, trust=True).header
    coded = []
    for section in header.sections:
        stored = bytes(container.stored_bytes(data, section))
        per_splat = section.kind == Property.OPACITY
        coded.append((dataclasses.replace(section, integers=splats) if per_splat else section, stored))
    return b"".join(container.assemble(dataclasses.replace(header, splats=splats), coded))


def test_who_trusts_a_file_gets_all_its_splats():
    splats = FREE_SPLATS + 50_000
    data = made_of(one_leaf(splats), splats)
    with pytest.raises(DataError, match="--trust"):
        decode(data)
    assert len(decode(data, trust=True)) == splats
    assert len(PotrFile.from_bytes(data, trust=True).scene()) == splats


def test_trust_reaches_files_by_their_path(tmp_path):
    splats = FREE_SPLATS + 50_000
    (tmp_path / "a.potr").write_bytes(made_of(one_leaf(splats), splats))
    for read in (decode, PotrFile.open):
        with pytest.raises(DataError, match=r"a\.potr.*--trust"):
            read(tmp_path / "a.potr")
    assert len(decode(tmp_path / "a.potr", trust=True)) == splats
    assert PotrFile.open(tmp_path / "a.potr", trust=True).header.splats == splats


def test_few_splats_may_be_as_alike_as_they_are():
    assert len(decode(made_of(one_leaf(FREE_SPLATS), FREE_SPLATS))) == FREE_SPLATS


def test_a_bomb_of_bundles():
    """Constant attributes take hardly a bit."""
    splats = 300_000
    scene = random_scene(1, 0).subset(np.zeros(splats, np.int64))
    data = b"".join(code_scene(scene, HyperParameters.from_quality(0.5, "best")).pieces)
    assert any(s.coder == Coder.BUNDLES for s in PotrFile.from_bytes(data, trust=True).header.sections)
    assert splats > FREE_SPLATS + MOST_A_BYTE * len(data)
    refused_without_memory(data, "--trust")


def test_a_bomb_of_octree_cells():
    """Few splats, but a chain of cells above each of them."""
    levels, splats = 5, 8**5
    occupancy = b"\377" * sum(8**level for level in range(levels)) + b"\1" * splats * 40
    cells = sum(8**level for level in range(1, levels + 1)) + splats * 40
    several = np.packbits(np.arange(cells) < cells - splats, bitorder="little").tobytes()
    streams = [(Property.OCCUPANCY, 0, occupancy, 1), (Property.SEVERAL, 0, several, 1)]
    data = made_of([*streams, (Property.TAIL_LENGTH, 0, bytes(splats), 1)], splats, depth=levels + 40)
    refused_without_memory(data, "octree cells")
    assert len(decode(data, trust=True)) == splats


@pytest.mark.parametrize("threads", [1, 16])
def test_the_worst_that_is_let_through(threads):
    """As many splats as a file may claim, every attribute of them as long as can be: 8 kB of memory a byte of file."""
    padding = b'{"a": "' + np.random.default_rng(0).integers(97, 123, 20_000, np.uint8).tobytes() + b'"}'
    splats = 160_000
    attributes = [(prop, i, bytes(8 * splats), 8) for prop in (Property.SCALE, Property.ROTATION) for i in range(3)]
    attributes += [(Property.SH, i, bytes(8 * splats), 8) for i in range(48)]
    streams = [(Property.METADATA, 0, padding, 1), *one_leaf(splats, 52), *attributes]
    data = made_of(streams, splats, 52, degree=3, coder=EntropyCoder("zstd", 1))
    file = PotrFile.from_bytes(data)
    tracemalloc.start()
    assert len(file.scene(threads)) == splats
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8192 * len(data)
    assert peak < 800 * splats


# Things that have no size and no end ---------------------------------------------------------------------------------


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="there is no such device")
def test_a_device_without_end_is_refused():
    """In a process that may not grow: reading on would fill the memory."""
    program = (
        "import resource\n"
        "from potr_cl.codec.decoder import decode\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))\n"
        "decode('/dev/zero')\n"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=300)
    assert "UsageError: '/dev/zero' is not a regular file" in result.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_a_file_from_a_pipe_is_read(tmp_path):
    data = made_of([LONE])
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=(data,))
    writer.start()
    assert len(decode(tmp_path / "pipe")) == 1
    writer.join()


def test_names_that_no_file_can_have(tmp_path):
    for name in ("none.potr", "a\0b.potr", tmp_path):
        with pytest.raises(UsageError):
            decode(tmp_path / name)


# Strictness ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "metadata",
    [
        b'{"q": NaN}',
        b'{"q": -Infinity}',
        b'{"q": 1e400}',
        b'{"source_bytes": ' + b"9" * 400 + b"}",
        b'{"source_bytes": ' + b"9" * 5000 + b"}",
        b'{"source_bytes": -9223372036854775808}',
        b'{"cameras": "\\ud800"}',
        b'{"\\udfff": 1}',
        b'{"a": "\xff"}',
        '{"a": 1}'.encode("utf-16"),
        b'\xef\xbb\xbf{"a": 1}',
        b"[1]",
        b"{",
        b"[" * 60000,
    ],
    ids=lambda value: repr(value[:24]),
)
def test_metadata_that_is_no_json(metadata):
    data = made_of([LONE, (Property.METADATA, 0, metadata, 1)])
    with pytest.raises(DataError, match="section 'metadata' is not a JSON object"):
        _ = PotrFile.from_bytes(data).metadata
    with pytest.raises(DataError, match="section 'metadata' is not a JSON object"):
        decode(data)
    with pytest.raises(ValueError, match=r"JSON|finite|64 bits"):
        decode_independently(data)


def test_metadata_that_is_json():
    metadata = '{"q": 0.5, "n": 9223372036854775807, "s": "\\ud83d\\ude00ä", "e": -1e-400, "x": [null, {}]}'
    data = made_of([LONE, (Property.METADATA, 0, metadata.encode(), 1)])
    assert PotrFile.from_bytes(data).metadata == {
        "q": 0.5,
        "n": (1 << 63) - 1,
        "s": "\U0001f600ä",
        "e": 0,
        "x": [None, {}],
    }
    assert len(decode(data)) == 1


def test_damage_in_metadata_is_seen_by_who_decodes():
    data = bytearray(made_of([LONE, (Property.METADATA, 0, b'{"q": 0.5}', 1)]))
    section = PotrFile.from_bytes(bytes(data)).header.find(Property.METADATA)
    data[section.offset + 3] ^= 1
    with pytest.raises(DataError, match="section 'metadata' is damaged"):
        decode(bytes(data))


@pytest.mark.parametrize("prop", [Property.METADATA, Property.OCCUPANCY, Property.SEVERAL, Property.TAIL_LENGTH])
def test_bytes_have_one_plane(prop):
    data = made_of([(prop, 0, b"{}", 2)], splats=4, depth=4)
    with pytest.raises(DataError, match="holds integers of 2 bytes"):
        decode(data)
    with pytest.raises(ValueError, match="2 planes instead of 1"):
        decode_independently(data)


@pytest.mark.parametrize(
    ("origin", "side", "good"),
    [
        ((1e38, -2e38, 3e38), 0.0, True),
        ((-LARGEST, 0.0, LARGEST), 0.0, True),
        ((-LARGEST, -LARGEST, -LARGEST), 2 * LARGEST, True),
        ((LARGEST, 0.0, 0.0), 1e38, False),  # the centre lies beyond
        ((0.0, 0.0, 0.0), 2.5 * LARGEST, False),
        ((1e39, 0.0, 0.0), 0.0, False),
        ((0.0, float("nan"), 0.0), 0.0, False),
        ((0.0, 0.0, 0.0), float("inf"), False),
    ],
)
def test_root_cubes_at_the_limits_of_single_precision(origin, side, good):
    data = made_of([LONE], origin=origin, side=side)
    if not good:
        with pytest.raises(DataError, match=r"root cube|beyond what single precision"):
            decode(data)
        with pytest.raises(ValueError, match="out of range"):
            decode_independently(data)
        return
    expected = np.array(origin) + side / 2
    assert np.array_equal(decode(data).means, [expected.astype(np.float32)])
    assert np.allclose(decode_independently(data)["means"], [expected])


def test_a_scene_at_the_limits_of_single_precision_comes_back():
    scene = random_scene(20, 0)
    means = np.linspace(-3.3e38, 3.3e38, 60, dtype=np.float64).reshape(20, 3).astype(np.float32)
    for preset in ("paper", "best"):
        coded = code_scene(dataclasses.replace(scene, means=means), HyperParameters.from_quality(0.5, preset))
        back = decode(b"".join(coded.pieces))
        assert np.abs(back.means.astype(np.float64) - means[coded.order]).max() <= 3.4e38 * 2.0**-22


@pytest.mark.parametrize("coefficient", [0, 1])
def test_sums_of_colours_wrap_round(coefficient):
    """Y + Co − Cg of 64 bits; DC besides as sums over the splats."""
    largest, least = (1 << 63) - 1, -(1 << 63)
    channels = [[largest, largest, 5], [largest, 1, -7], [least, -3, 1 << 62]]
    streams = [(Property.SH, 3 * coefficient + c, *zig_zag(values)) for c, values in enumerate(channels)]
    data = made_of([*one_leaf(3), *streams], 3, degree=1)
    with no_warnings():
        decoded = decode(data).sh[:, coefficient]
    if coefficient == 0:
        channels = np.cumsum(np.array(channels, np.int64), axis=1).tolist()
    y, co, cg = (np.array(values, np.int64).astype(object) for values in channels)
    exact = np.stack([y + co - cg, y + cg, y - co - cg], axis=1)
    wrapped = (exact + (1 << 63)) % (1 << 64) - (1 << 63)
    assert (wrapped != exact).any()
    assert np.array_equal(decoded, wrapped.astype(np.float64).astype(np.float32) / np.float32(10))
    assert np.allclose(decode_independently(data)["sh"][:, coefficient], decoded, rtol=1e-6)


def zig_zag(values) -> tuple[bytes, int]:
    """Eight planes of integers, also of those whose map does not fit what an encoder writes."""
    mapped = [(2 * v if v >= 0 else -2 * v - 1) for v in values]
    return bytes((u >> (8 * p)) & 255 for p in range(8) for u in mapped), 8


def test_zig_zag_is_the_packages():
    values = np.array([0, -1, 1, 1 << 61, -(1 << 61)])
    assert zig_zag(values.tolist()) == pack_integers(values, signed=True)


def test_the_largest_integers_give_no_warning():
    """Squares and sums beyond single precision are none of the user's business."""
    streams = [
        (prop, axis, b"\377" * 8 * 2, 8)
        for prop in (Property.SCALE, Property.ROTATION, Property.SH)
        for axis in range(3)
    ]
    for version in (1, 2):
        data = made_of([*one_leaf(2), *streams, (Property.OPACITY, 0, b"\377" * 16, 8)], 2, version=version)
        with no_warnings():
            scene = decode(data)
        for array in (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh):
            assert np.isfinite(array).all()


def test_encoding_extreme_scenes_gives_no_warning():
    extreme = random_scene(40, 1, seed=3)
    extreme.means[:5] *= np.float32(1e30)
    extreme.log_scales[::3] = -80
    extreme.log_scales[1] = (-1e30, -3e38, -200)
    extreme.quaternions[7] = (3e38, 3e38, -3e38, 1e-38)
    extreme.quaternions[8] = (1e-20, 0, 0, 1e-25)
    extreme.opacity_logits[:4] = (3e38, -3e38, 800, -800)
    for preset in ("paper", "best"):
        for scene in (extreme.subset(np.r_[5:40]), extreme.subset(np.r_[:5])):
            with no_warnings():
                coded = code_scene(clean(scene), HyperParameters.from_quality(0.5, preset))
                assert len(decode(b"".join(coded.pieces))) == len(coded.order)


def clean(scene: Scene) -> Scene:
    return scene.cleaned()[0]
