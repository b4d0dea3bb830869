"""Files made to harm: what would take memory out of proportion, and what only a strict reader finds."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl.codec import container, plain
from potr_cl.codec.container import MOST_A_BYTE, Block, EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER, SH, Coder, Property
from potr_cl.errors import DataError, UsageError
from potr_cl.host.inputs import FREE_SPLATS
from potr_cl.model.box import Box
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings
from tests.oracles.decoder import decode as decode_independently
from tests.reference.file_parts import File
from tests.reference.file_parts import Section as Padding
from tests.reference.scenes import random_scene

LONE = (Property.LEAF_LEVEL, b"\0")  # what the octree of a single splat consists of
ZSTD = EntropyCoder("zstd", 19)
LARGEST = float(np.finfo(np.float32).max)
EVERYWHERE = Box((-LARGEST,) * 3, (LARGEST,) * 3)


def made_of(
    streams, splats=1, depth=0, degree=0, coder=ZSTD, origin=(0.0, 0.0, 0.0), side=1.0, quantiser=1, metadata=None
) -> bytes:
    """A file of a block of some sections (property, content); opacity is 0 unless it is among them."""
    contents = {Property.OPACITY: plain.pack([np.zeros(splats, np.int64)], False)} | dict(streams)
    block = Block(splats, degree, origin, side, depth, *[10.0] * 5, quantiser, Coder.PLAIN, EVERYWHERE)
    coded = [coder.section(prop, contents[prop]) for prop in ORDER if prop in contents]
    own = [] if metadata is None else [coder.section(Property.METADATA, metadata)]
    return b"".join(container.assemble([(block, coded)], own))


def one_leaf(splats, depth=0) -> list:
    """Positions of splats that all lie in one leaf, the first cell of every level."""
    crowded = np.packbits(np.ones(depth, bool), bitorder="little").tobytes()
    tree = [(Property.OCCUPANCY, b"\1" * depth), (Property.SEVERAL, crowded)] if depth else []
    return [*tree, (Property.MULTIPLICITY, splats.to_bytes(4, "little"))]


def refused_without_memory(data, message, trust=False):
    """That a file is refused before anything of it is unpacked: its header alone tells."""
    with takes_at_most(1 << 20), pytest.raises(DataError, match=message):
        open_file(data, trust)


# Bombs ---------------------------------------------------------------------------------------------------------------


def test_a_long_run_in_the_octree_of_one_splat():
    """Whether or not the file is trusted: no octree of one splat needs that."""
    zeros = bytes(1 << 25)
    for prop in (*ORDER[: ORDER.index(Property.STEPS) + 1], Property.SCALE):
        data = made_of([(prop, zeros)], depth=52, coder=EntropyCoder("zstd", 1))
        for trust in (False, True):
            refused_without_memory(data, "holds 33554432 bytes, more than 1 splats", trust)


def test_the_longest_octree_that_some_splats_can_need_is_read():
    """Two splats in the same cell of all levels but the last."""
    octants = [(Property.OCCUPANCY, b"\1" * 51 + b"\3")]
    crowded = np.packbits(np.arange(53) < 51, bitorder="little").tobytes()
    streams = [*octants, (Property.SEVERAL, crowded), (Property.LEAF_LEVEL, bytes(2))]
    assert len(decode(made_of(streams, splats=2, depth=52))) == 2


def test_a_leaf_of_countless_splats():
    """A kilobyte that would become a gigabyte; and more than a block may have."""
    data = made_of(one_leaf(1 << 22), 1 << 22)
    assert len(data) < 2000
    refused_without_memory(data, "4194304 splats.*--trust")
    with pytest.raises(DataError, match="4194305 splats"):
        open_file(made_of(one_leaf((1 << 22) + 1), (1 << 22) + 1), trust=True)


def test_who_trusts_a_file_gets_all_its_splats(tmp_path):
    assert len(decode(made_of(one_leaf(FREE_SPLATS), FREE_SPLATS))) == FREE_SPLATS
    splats = FREE_SPLATS + 50_000
    data = made_of(one_leaf(splats), splats)
    (tmp_path / "a.potr").write_bytes(data)
    for source, named in ((data, "--trust"), (tmp_path / "a.potr", r"a\.potr.*--trust")):
        for read in (decode, open_file):
            with pytest.raises(DataError, match=named):
                read(source)
        assert len(decode(source, trust=True)) == len(open_file(source, trust=True).scene()) == splats


def test_a_bomb_of_bundles():
    """Constant attributes take hardly a bit."""
    splats = 300_000
    scene = random_scene(1, 0).subset(np.zeros(splats, np.int64))
    data = b"".join(code_scene(scene, HyperParameters.from_quality(0.5, "best")).pieces)
    assert open_file(data, trust=True).blocks[0].coder == Coder.BUNDLES
    assert splats > FREE_SPLATS + MOST_A_BYTE * len(data)
    refused_without_memory(data, "--trust")


def test_a_bomb_of_octree_cells():
    """Few splats, but a chain of cells above each of them."""
    levels, splats = 5, 8**5
    occupancy = b"\377" * sum(8**level for level in range(levels)) + b"\1" * splats * 40
    cells = sum(8**level for level in range(1, levels + 1)) + splats * 40
    several = np.packbits(np.arange(cells) < cells - splats, bitorder="little").tobytes()
    streams = [(Property.OCCUPANCY, occupancy), (Property.SEVERAL, several)]
    data = made_of([*streams, (Property.LEAF_LEVEL, bytes(splats))], splats, depth=levels + 40)
    refused_without_memory(data, "octree cells")
    assert len(decode(data, trust=True)) == splats


def test_the_worst_that_is_let_through():
    """As many splats as a file may claim, every attribute of them as long as can be: 8 kB of memory a byte of file."""
    splats = 160_000
    contents = one_leaf(splats, 52)
    for prop in (Property.SCALE, Property.ROTATION, *SH):
        contents.append((prop, bytes([7] * prop.streams) + bytes(7 * splats * prop.streams)))
    file = File.of(made_of(contents, splats, 52, degree=3, coder=EntropyCoder("zstd", 1)))
    # An optional section of noise, which makes the block long.
    padding = np.random.default_rng(0).integers(0, 256, 20_000, np.uint8).tobytes()
    file.blocks[0].sections.append(Padding(b"junk", padding, len(padding)))
    data = file.bytes()
    for threads in (1, 16):
        with takes_at_most(min(8192 * len(data), 800 * splats)):
            assert len(open_file(data).scene(threads)) == splats


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


def test_names_that_no_file_can_have(tmp_path):
    for name in ("none.potr", "a\0b.potr", tmp_path):
        with pytest.raises(UsageError):
            decode(tmp_path / name)


# Strictness ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "metadata",
    [
        b"", b"[1]", b"{", b"[" * 60000, b'{"a": "\xff"}', b'\xef\xbb\xbf{"a": 1}', '{"a": 1}'.encode("utf-16"),
        b'{"q": NaN}', b'{"q": -Infinity}', b'{"q": 1e400}', b'{"source_bytes": -9223372036854775808}',
        b'{"source_bytes": ' + b"9" * 400 + b"}", b'{"source_bytes": ' + b"9" * 5000 + b"}",
        b'{"cameras": "\\ud800"}', b'{"\\udfff": 1}',
    ],
    ids=lambda value: repr(value[:24]),
)  # fmt: skip
def test_metadata_that_is_no_json(metadata):
    data = made_of([LONE], metadata=metadata)
    for read in (open_file, decode):
        with pytest.raises(DataError, match="section 'metadata' is not a JSON object"):
            read(data)
    with pytest.raises(ValueError, match=r"JSON|finite|64 bits"):
        decode_independently(data)


def test_metadata_that_is_json():
    metadata = '{"q": 0.5, "n": 9223372036854775807, "s": "\\ud83d\\ude00ä", "e": -1e-400, "x": [null, {}]}'
    data = made_of([LONE], metadata=metadata.encode())
    wanted = {"q": 0.5, "n": (1 << 63) - 1, "s": "\U0001f600ä", "e": 0, "x": [None, {}]}
    assert open_file(data).metadata == wanted
    assert len(decode(data)) == 1
    damaged = bytearray(data)
    damaged[open_file(data).header.start + 3] ^= 1
    with pytest.raises(DataError, match="section 'metadata' is damaged"):
        decode(bytes(damaged))
    data = made_of([LONE])
    assert open_file(data).metadata == decode_independently(data)["metadata"] == {}


@pytest.mark.parametrize(
    ("origin", "side", "good"),
    [
        ((1e38, -2e38, 3e38), 0.0, True),
        ((-LARGEST, 0.0, LARGEST), 0.0, True),
        ((-LARGEST, -LARGEST, -LARGEST), 2 * LARGEST, True),
        ((LARGEST, 0.0, 0.0), 1e38, False),  # the centre lies beyond
        ((0.0, 0.0, 0.0), 2.5 * LARGEST, False),
        ((float("-inf"), 0.0, 0.0), 0.0, False),
        ((0.0, float("nan"), 0.0), 0.0, False),
        ((0.0, 0.0, 0.0), float("inf"), False),
    ],
)
def test_root_cubes_at_the_limits_of_single_precision(origin, side, good):
    data = made_of([LONE], origin=origin, side=side)
    if not good:
        with pytest.raises(DataError, match=r"root cube|beyond what single precision"):
            decode(data)
        with pytest.raises(ValueError, match=r"out of range|outside"):
            decode_independently(data)
        return
    expected = np.array(origin) + side / 2
    assert np.array_equal(decode(data).means, [expected.astype(np.float32)])
    assert np.allclose(decode_independently(data)["means"], [expected])


def test_a_scene_at_the_limits_of_single_precision_comes_back():
    scene, means = random_scene(20, 0), np.linspace(-3.3e38, 3.3e38, 60).reshape(20, 3).astype(np.float32)
    for preset in ("paper", "best"):
        coded = code_scene(dataclasses.replace(scene, means=means), HyperParameters.from_quality(0.5, preset))
        back = decode(b"".join(coded.pieces))
        assert np.abs(back.means.astype(np.float64) - means[coded.order]).max() <= 3.4e38 * 2.0**-22


def test_the_largest_integers_give_no_warning():
    """Squares and sums beyond single precision are none of the user's business."""
    contents = [
        (prop, bytes([7] * prop.streams) + b"\377" * 7 * 2 * prop.streams)
        for prop in (Property.OPACITY, Property.SCALE, Property.ROTATION, Property.SH0)
    ]
    for quantiser in (0, 1):
        data = made_of([*one_leaf(2), *contents], 2, quantiser=quantiser)
        with no_warnings():
            scene = decode(data)
        for array in (scene.means, scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh):
            assert np.isfinite(array).all()
        assert np.allclose(decode_independently(data)["sh"], scene.sh, rtol=1e-6)


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
                coded = code_scene(scene.cleaned()[0], HyperParameters.from_quality(0.5, preset))
                assert len(decode(b"".join(coded.pieces))) == len(coded.order)
