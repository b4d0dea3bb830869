"""Container: every lie in header and table is refused, what is not known is skipped or named, levels come back."""

from __future__ import annotations

import dataclasses
import struct
import zlib

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec import container, plain
from potr_cl.codec.blocks import blocks_of, quantise
from potr_cl.codec.container import FREE_BLOCKS, EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import Level, code_levels, code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Property, Section
from potr_cl.errors import DataError, UsageError
from tests.oracles.decoder import decode as decode_independently
from tests.reference.file_parts import File
from tests.reference.file_parts import Section as Entry
from tests.reference.scenes import random_scene

BEST = HyperParameters.from_quality(0.5, "best")


@pytest.fixture(scope="module")
def data() -> bytes:
    """One block of the sections OCCU SEVE LEAF TAIL OPAC SCAL ROTA SHC0 SHC1, behind the file's own section."""
    return b"".join(code_scene(random_scene(40, 1), BEST, metadata=b'{"a":1}').pieces)


@given(
    st.lists(hnp.arrays(np.int64, 30, elements=st.integers(-(2**38), 2**38)), min_size=1, max_size=4),
    st.integers(0, 38),
    st.booleans(),
    st.integers(0, 30),
)
def test_plain_integers(streams, shift, signed, start):
    streams = [(stream if signed else abs(stream)) >> shift for stream in streams]
    raw = np.frombuffer(plain.pack(streams, signed), np.uint8)
    at = len(streams)
    for stream, width in zip(streams, raw[:at].tolist(), strict=False):
        planes = raw[at : at + 30 * width].reshape(-1, 30)
        assert np.array_equal(plain.unpack(planes, signed, start, 30), stream[start:])
        at += 30 * width
    assert at == len(raw)


@pytest.mark.parametrize("raw", [b"", b"a", b"abc" * 1000, bytes(range(256))])
def test_sections(raw):
    section, stored = EntropyCoder("zstd", 3).section(Property.TAIL, raw)
    assert bytes(container.read_section(stored, section)) == raw
    assert len(stored) <= len(raw)


@pytest.mark.parametrize("bad", [{"name": "lzma"}, {"name": "npz"}, {"level": 0}, {"level": 23}])
def test_unknown_coder(bad):
    with pytest.raises(UsageError):
        EntropyCoder(**bad)


# Levels --------------------------------------------------------------------------------------------------------------


def test_levels_are_written_and_read():
    """The finest is what readers take; each is a scene by itself, of several blocks or one."""
    fine = random_scene(600, 1, seed=2)
    coarse = fine.subset(np.arange(0, 600, 5))
    coarsest = coarse.subset(np.arange(0, 120, 10))
    levels = [
        Level(fine, quantise(fine, BEST, (), rows=blocks_of(fine.means, 250))),
        Level(coarse, quantise(coarse, BEST, ()), 0.25),
        Level(coarsest, quantise(coarsest, HyperParameters.from_quality(0.1, "best"), ()), 1.5),
    ]
    coded = code_levels(levels)
    data = b"".join(coded.pieces)
    file = open_file(data)
    assert [(b.level, b.splats, b.first, b.error) for b in file.blocks] == [
        (2, 12, 0, 1.5), (1, 120, 0, 0.25), (0, 200, 0, 0), (0, 200, 200, 0), (0, 200, 400, 0),
    ]  # fmt: skip
    assert file.header.splats == len(decode(data)) == 600
    assert np.array_equal(np.sort(coded.order), np.arange(600))
    for k, level in enumerate(levels):
        alone = decode(b"".join(code_levels([dataclasses.replace(level, error=0.0)]).pieces))
        found = file.scene(level=k)
        assert np.array_equal(found.sh, alone.sh)
        assert np.array_equal(found.means, alone.means)
        assert np.allclose(found.sh, decode_independently(data, k)["sh"], rtol=1e-6, atol=1e-6)
    with pytest.raises(UsageError, match="no level 3: the file has levels 0 to 2"):
        file.scene(level=3)


# What is not known ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["file", "block"])
@pytest.mark.parametrize("at", [0, 1])
def test_sections_of_a_later_day(data, where, at):
    """Those that may be skipped are, wherever they stand; others are named."""
    wanted = decode(data)
    for name, skipped in ((b"newA", True), (b"NewB", False)):
        file = File.of(data)
        sections = file.sections if where == "file" else file.blocks[0].sections
        sections.insert(at, Entry(name, b"whatever", 1 << 17))
        grown = file.bytes()
        if skipped:
            assert np.array_equal(decode(grown).sh, wanted.sh)
            assert open_file(grown).metadata == {"a": 1}
            assert len(decode_independently(grown)["sh"]) == 40
            continue
        with pytest.raises(DataError, match="needs a section 'NewB' that this potr_cl does not know: update it"):
            open_file(grown)
        with pytest.raises(ValueError, match="NewB"):
            decode_independently(grown)


# Lies ----------------------------------------------------------------------------------------------------------------


def tell(file: File, place: str, value: object) -> None:
    """Of the file itself, of its first "block", of that block's "reals" by number, or of a section's entry by name."""
    owner, _, name = place.rpartition(".")
    if owner == "reals":
        file.blocks[0].reals[int(name)] = value
    else:
        sections = {section.name.decode(): section for _, section in file.all_sections()}
        setattr({"": file, "block": file.blocks[0], **sections}[owner], name, value)


def rising(file: File) -> None:
    file.blocks += [dataclasses.replace(file.blocks[0], level=1), file.blocks[0]]


def swapped(file: File) -> None:
    file.blocks[0].sections[:2] = file.blocks[0].sections[1::-1]


NAN, INFINITE = float("nan"), float("inf")
LIES = {
    "future version": (("version", 2), "format version 2, this potr_cl reads version 1: update"),
    "version 0": (("version", 0), "format version 0"),
    "a low-pass filter of antialiased scenes alone": (("flags", 2), "flags 2"),
    "flags of a later day": (("flags", 5), "flags 5 and quantiser 1 is unknown: update potr_cl"),
    "quantiser of a later day": (("quantiser", 2), "quantiser 2 is unknown: update potr_cl"),
    "reserved": (("reserved", 1), "unknown"),
    "SH degree": (("degree", 4), "invalid header"),
    "no blocks": (("count", 0), "invalid header"),
    "a block more": (("count", 2), "its table is longer than it says"),
    "thousands of blocks": (("count", 3000), "3000 blocks are too many"),
    "bundles of the paper's quantiser": (("quantiser", 0), "of coder 1, which is unknown"),
    "no splats": (("block.splats", 0), "is invalid"),
    "more splats than a block may have": (("block.splats", 2**22 + 1), "is invalid"),
    "more splats than its bytes hold": (("block.splats", 2**21), "2097152 splats in .* --trust"),
    "coder": (("block.coder", 2), "coder 2, which is unknown"),
    "octree depth": (("block.depth", 53), "is invalid"),
    "a section more": (("block.count", 12), "its table is longer|no name"),
    "a section less": (("block.count", 8), "the sections do not fill"),
    "the finest level is not there": (("block.level", 1), "the finest level is not there"),
    "box": (("reals.0", NAN), "its box is"),
    "box that ends before it begins": (("reals.0", 9e9), "its box is"),
    "origin": (("reals.7", INFINITE), "root cube"),
    "error": (("reals.9", -1.0), "level 0, error -1"),
    "side": (("block.side", -1.0), "root cube"),
    "infinite side": (("block.side", INFINITE), "root cube"),
    "scale factor": (("block.factors", [0.0] * 5), "scale factor"),
    "a name that harms terminals": (("OCCU.name", b"\x1b[2J"), "a section with an invalid name"),
    "size of a content": (("TAIL.raw", 2**31), "more than its"),
    "longer than the octree needs": (("OCCU.raw", 40 * 52 + 1), "octree of .* levels can need"),
    "a size beyond the end": (("SHC1.size", 2**31), "beyond the end"),
    "bundles that are packed": (("SCAL.raw", 40), "not stored as it is|than 40 splats"),
    "a section twice": (
        lambda file: file.blocks[0].sections.append(file.blocks[0].sections[-1]),
        "stands twice, or not in its place",
    ),
    "sections in another order": (swapped, "stands twice, or not in its place"),
    "no opacity": (lambda file: file.blocks[0].sections.pop(4), "no opacity|the finest"),
    "SH beyond the degree": (("degree", 0), "needs a section 'SHC1'"),
    "levels that rise": (rising, "block 1 is invalid: level 1"),
    "a section of the file in a block": (("OCCU.name", b"META"), "needs a section 'META'"),
}


@pytest.mark.parametrize("name", LIES)
def test_lies_in_header_and_table(data, name):
    change, message = LIES[name]
    file = File.of(data)
    if callable(change):
        change(file)
    else:
        tell(file, *change)
    lie = file.bytes()
    with pytest.raises(DataError, match=message) as caught:
        open_file(lie)
    assert "\n" not in str(caught.value)
    if "splats than its bytes" not in name:  # who trusts it may have them
        with pytest.raises((ValueError, struct.error)):
            decode_independently(lie)


DAMAGE = {
    "empty": (lambda d: b"", "empty"),
    "other magic": (lambda d: b"PLY" + d[3:], "not a .potr file"),
    "line ends converted": (lambda d: d.replace(b"\r\n", b"\n", 1), "changed in transfer"),
    "only the magic": (lambda d: d[:8], "truncated"),
    "half a header": (lambda d: d[:130], "truncated"),
    "cut": (lambda d: d[:-1], "truncated"),
    "longer": (lambda d: d + b"x", "followed by"),
    "header size": (lambda d: d[:12] + struct.pack("<I", 40) + d[16:], "checksum"),
    "gigantic header size": (lambda d: d[:12] + struct.pack("<I", 2**32 - 1) + d[16:], "truncated"),
    "bit flip in the header": (lambda d: d[:40] + bytes([d[40] ^ 1]) + d[41:], "checksum"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage(data, name):
    damage, message = DAMAGE[name]
    with pytest.raises(DataError, match=message):
        open_file(damage(data))


def test_blocks_of_next_to_nothing_are_refused():
    """Each costs time of its own, whatever it holds."""
    scene = random_scene(3 * (FREE_BLOCKS + 1), 0)
    geometry = [quantise(scene, BEST, (), rows=blocks_of(scene.means, most)) for most in (4, 3)]
    few, many = (b"".join(code_levels([Level(scene, each)]).pieces) for each in geometry)
    assert len(decode(few)) == len(scene)
    with pytest.raises(DataError, match=f"{FREE_BLOCKS + 1} blocks are too many for {len(scene)} splats"):
        open_file(many)


def section_of(raw, stored, **lies):
    said = {"raw_bytes": len(raw), "crc": zlib.crc32(stored), **lies}
    return Section("TAIL", stored_bytes=len(stored), **said)


def test_sections_that_lie():
    raw = b"abc" * 1000
    frame = zstandard.ZstdCompressor().compress(raw)
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(raw)
    lies = [(frame, {"crc": 1}), *((stored, {"raw_bytes": size}) for stored in (frame, raw) for size in (2999, 3001))]
    damaged = (frame[:-1], frame + b"x", frame + frame, unsized, b"garbage" * 9)
    for stored, said in [*lies, *((stored, {}) for stored in damaged)]:
        with pytest.raises(DataError, match="section 'tail'"):
            container.read_section(stored, section_of(raw, stored, **said))


def test_a_frame_that_claims_a_gigabyte_takes_no_memory():
    """A zstd frame's own content size is a claim like any other."""
    frame = zstandard.ZstdCompressor().compress(b"abc" * 100)
    body = frame[7 if frame[4] >> 6 == 1 else 6 :]
    huge = frame[:4] + bytes([(frame[4] & 0x1F) | 0xC0 | 0x20]) + struct.pack("<Q", 1 << 40) + body
    assert zstandard.get_frame_parameters(huge).content_size == 1 << 40
    with pytest.raises(DataError):
        container.read_section(huge, section_of(b"abc" * 100, huge))
