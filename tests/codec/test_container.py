"""Container: integers to planes and back, every lie in header and table refused."""

from __future__ import annotations

import dataclasses
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec import byte_planes, container
from potr_cl.codec.container import EntropyCoder, Header
from potr_cl.codec.sections import Coder, Property, Section
from potr_cl.errors import DataError, UsageError


@given(
    hnp.arrays(np.int64, st.integers(1, 60), elements=st.integers(-(2**52), 2**52)),
    st.integers(0, 52),
    st.data(),
)
def test_signed_integers(values, shift, data):
    values >>= shift
    raw, planes = byte_planes.pack_integers(values, signed=True)
    start = data.draw(st.integers(0, len(values)))
    stop = data.draw(st.integers(start, len(values)))
    back = byte_planes.unpack_integers(np.frombuffer(raw, np.uint8), planes, True, start, stop)
    assert np.array_equal(back, values[start:stop])
    assert len(raw) == planes * len(values)


@given(hnp.arrays(np.int64, st.integers(1, 60), elements=st.integers(0, 2**53)), st.integers(0, 53))
def test_unsigned_integers(values, shift):
    values >>= shift
    raw, planes = byte_planes.pack_integers(values, signed=False)
    assert planes == (int(values.max()).bit_length() + 7) // 8
    back = byte_planes.unpack_integers(np.frombuffer(raw, np.uint8), planes, False, 0, len(values))
    assert np.array_equal(back, values)


@pytest.mark.parametrize("name", ["zstd", "npz"])
@pytest.mark.parametrize("raw", [b"", b"a", b"abc" * 1000, bytes(range(256))])
def test_sections(name, raw):
    section, stored = EntropyCoder(name, 3).section(Property.TAIL, 0, raw, 1)
    assert bytes(container.read_section(stored, section)) == raw
    assert len(stored) <= len(raw)


def test_npz_is_what_numpy_writes(tmp_path):
    """The 'npz' coder and a real .npz of the same bytes differ by no more than the zip's own records."""
    raw = np.random.default_rng(0).normal(0, 9, 20000).astype(np.int8).view(np.uint8)
    np.savez_compressed(tmp_path / "a.npz", stream=raw)
    section, _ = EntropyCoder("npz").section(Property.TAIL, 0, raw.tobytes(), 1)
    assert section.coder == Coder.DEFLATE
    assert abs((tmp_path / "a.npz").stat().st_size - section.stored_bytes) < 400


@pytest.mark.parametrize("bad", [{"name": "lzma"}, {"level": 0}, {"level": 23}])
def test_unknown_coder(bad):
    with pytest.raises(UsageError):
        EntropyCoder(**bad)


def small_file(splats=4, version=1):
    header = Header(version, splats, 0, (0.0, 0.0, 0.0), 1.0, 3, 10.0, 10.0, 10.0, 10.0, 11.0)
    coder = EntropyCoder("zstd", 3)
    coded = [
        coder.section(Property.OPACITY, 0, bytes(range(splats)), 1),
        coder.section(Property.METADATA, 0, b'{"a": 1}' + b" " * 100, 1),
    ]
    return b"".join(container.assemble(header, coded))


def resealed(data):
    """With the header's checksum made right again, so that only the lie itself can be found."""
    size = struct.unpack_from("<I", data, 12)[0]
    if not 124 <= size <= len(data):
        return data
    return data[: size - 4] + struct.pack("<I", zlib.crc32(data[: size - 4])) + data[size:]


def changed(data, offset, form, value):
    out = bytearray(data)
    struct.pack_into(form, out, offset, value)
    return resealed(bytes(out))


def test_header_roundtrip():
    data = small_file()
    header = container.read_header(data, len(data))
    assert (header.splats, header.sh_degree, header.depth, header.side) == (4, 0, 3, 1.0)
    assert [s.kind for s in header.sections] == [Property.OPACITY, Property.METADATA]
    assert header.find(Property.SCALE) is None
    assert (header.sf_dc, header.sf_ac) == (10.0, 10.0)  # version 1 has one factor for both


def test_sections_come_back_as_they_were():
    """The table's two fields of double meaning: planes and bytes, or streams and integers."""
    splats = 5
    header = Header(2, splats, 1, (0.0, 0.0, 0.0), 1.0, 3, 10.0, 10.0, 10.0, 10.0, 11.0)
    coded = [
        EntropyCoder("zstd", 3).section(Property.SCALE, 1, bytes(3 * splats), 3),
        EntropyCoder("zstd", 3).section(Property.OPACITY, 0, bytes(range(splats)), 1),
        container.stream_section(Coder.CONTEXT, Property.SH, 3, 9, 9 * splats, bytes(70)),
    ]
    data = b"".join(container.assemble(header, coded))
    scale, opacity, sh = container.read_header(data, len(data)).sections
    assert (scale.streams, scale.integers, scale.planes, scale.raw_bytes) == (1, splats, 3, 3 * splats)
    assert (opacity.coder, opacity.integers, opacity.raw_bytes, opacity.stored_bytes) == (Coder.RAW, 5, 5, 5)
    assert (sh.coder, sh.streams, sh.integers, sh.planes) == (Coder.CONTEXT, 9, 9 * splats, 0)
    assert (sh.raw_bytes, sh.stored_bytes, sh.indices) == (None, 70, range(3, 12))
    for section, (before, stored) in zip((scale, opacity, sh), coded, strict=True):
        assert dataclasses.replace(section, offset=0) == before
        assert bytes(container.stored_bytes(data, section)) == stored


def test_what_the_context_coder_holds_is_not_read_as_bytes():
    section, stored = container.stream_section(Coder.CONTEXT, Property.OPACITY, 0, 1, 4, zlib.compress(b"abcd"))
    with pytest.raises(DataError, match="'opacity'"):
        container.read_section(stored, section)


def test_header_roundtrip_of_version_2():
    data = small_file(version=2)
    header = container.read_header(data, len(data))
    assert (header.version, header.sf_dc, header.sf_ac) == (2, 10.0, 11.0)


@pytest.mark.parametrize(
    ("offset", "form", "value"),
    [
        (122, "<B", 3),  # opacity of coder 3, which has one stream of four integers: possible, so the raw size lies
        (104, "<d", 0.0),
        (104, "<d", float("nan")),
        (112, "<B", 1),
    ],
)
def test_lies_in_the_header_of_version_2(offset, form, value):
    data = changed(small_file(version=2), offset, form, value)
    if offset == 122:
        data = changed(data, 128, "<Q", 5)
    with pytest.raises(DataError):
        container.read_header(data, len(data))


@pytest.mark.parametrize(("prop", "index", "streams"), [(18, 0, 2), (16, 0, 2), (19, 3, 9), (5, 0, 1), (0, 0, 1)])
def test_sections_that_the_context_coder_has_not(prop, index, streams):
    data = small_file(version=2)
    for offset, value in [(144, prop), (145, index), (146, Coder.CONTEXT), (147, streams)]:
        data = changed(data, offset, "<B", value)
    with pytest.raises(DataError):
        container.read_header(changed(data, 152, "<Q", 4 * streams), len(data))


LIES = {
    "empty": (lambda d: b"", "empty"),
    "other magic": (lambda d: b"PLY" + d[3:], "not a .potr file"),
    "line ends converted": (lambda d: d.replace(b"\r\n", b"\n", 1), "changed in transfer"),
    "only the magic": (lambda d: d[:8], "truncated"),
    "half a header": (lambda d: d[:130], "truncated"),
    "cut": (lambda d: d[:-1], "truncated"),
    "longer": (lambda d: d + b"x", "followed by"),
    "future version": (lambda d: changed(d, 8, "<H", 1000), "update potr_cl"),
    "version 2 with version 1's reserved bytes": (lambda d: changed(d, 8, "<H", 2), "scale factor"),
    "coder of version 2": (lambda d: changed(d, 122, "<B", 3), "coder 3"),
    "version 0": (lambda d: changed(d, 8, "<H", 0), "unknown"),
    "a low-pass filter of antialiased scenes alone": (lambda d: changed(d, 10, "<H", 2), "unknown"),
    "flags of a later day": (lambda d: changed(d, 10, "<H", 5), "flags 5 is unknown: update potr_cl"),
    "header size": (lambda d: changed(d, 12, "<I", 4000), "damaged"),
    "gigantic header size": (lambda d: changed(d, 12, "<I", 2**32 - 1), "damaged"),
    "file size": (lambda d: changed(d, 16, "<Q", 2**60), "truncated"),
    "no splats": (lambda d: changed(d, 24, "<Q", 0), "makes no sense"),
    "too many splats": (lambda d: changed(d, 24, "<Q", 2**40), "splats"),
    "SH degree": (lambda d: changed(d, 32, "<B", 4), "makes no sense"),
    "octree depth": (lambda d: changed(d, 33, "<B", 53), "makes no sense"),
    "section count": (lambda d: changed(d, 34, "<H", 3), "damaged"),
    "origin": (lambda d: changed(d, 40, "<d", float("nan")), "not finite"),
    "side": (lambda d: changed(d, 64, "<d", -1.0), "not finite"),
    "infinite side": (lambda d: changed(d, 64, "<d", float("inf")), "not finite"),
    "scale factor": (lambda d: changed(d, 72, "<d", 0.0), "scale factor"),
    "reserved": (lambda d: changed(d, 110, "<B", 1), "unknown"),
    "unknown property": (lambda d: changed(d, 120, "<B", 99), "unknown kind"),
    "unknown coder": (lambda d: changed(d, 122, "<B", 9), "unknown kind"),
    "index": (lambda d: changed(d, 121, "<B", 1), "impossible index"),
    "twice": (lambda d: changed(d, 144, "<B", 18), "impossible index"),
    "planes": (lambda d: changed(d, 123, "<B", 9), "integers of 9 bytes"),
    "raw size of a stream": (lambda d: changed(d, 128, "<Q", 2**50), "4 splats of 1 bytes"),
    "raw size of metadata": (lambda d: changed(d, 152, "<Q", 2**50), "more than its"),
    "stored size": (lambda d: changed(d, 136, "<Q", 2**50), "beyond the end"),
    "stored size too small": (lambda d: changed(d, 160, "<Q", 5), "more than its|do not fill"),
    "no opacity": (lambda d: changed(d, 120, "<B", 1), "no opacity"),
    "SH beyond the degree": (lambda d: changed(changed(d, 121, "<B", 3), 120, "<B", 19), "does not belong"),
    "bit flip in the header": (lambda d: d[:40] + bytes([d[40] ^ 1]) + d[41:], "checksum"),
}


@pytest.mark.parametrize("version", [1, 2])
def test_flags_say_how_a_scene_is_rendered(version):
    for flags, antialiased, low_pass in [(0, False, 0.3), (1, True, 0.3), (3, True, 0.1)]:
        data = changed(small_file(version), 10, "<H", flags)
        header = container.read_header(data, len(data))
        assert (header.antialiased, header.low_pass) == (antialiased, low_pass)


@pytest.mark.parametrize("name", LIES)
def test_lies_in_the_header(name):
    lie, message = LIES[name]
    data = lie(small_file())
    with pytest.raises(DataError, match=message) as caught:
        container.read_header(data, len(data))
    assert "\n" not in str(caught.value)


def section_of(raw, coder, stored, **lies):
    said = {"integers": len(raw), "crc": zlib.crc32(stored), **lies}
    return Section(Property.TAIL, 0, coder, streams=1, planes=1, stored_bytes=len(stored), **said)


def test_sections_that_lie():
    import zstandard

    raw = b"abc" * 1000
    frame = zstandard.ZstdCompressor().compress(raw)
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(raw)
    deflated = zlib.compress(raw)
    for coder, stored, lies in [
        (Coder.ZSTD, frame, {"crc": 1}),
        (Coder.ZSTD, frame, {"integers": 2999}),
        (Coder.ZSTD, frame, {"integers": 3001}),
        (Coder.ZSTD, frame[:-1], {}),
        (Coder.ZSTD, frame + b"x", {}),
        (Coder.ZSTD, frame + frame, {}),
        (Coder.ZSTD, unsized, {}),
        (Coder.ZSTD, b"garbage" * 9, {}),
        (Coder.DEFLATE, deflated, {"integers": 2999}),
        (Coder.DEFLATE, deflated, {"integers": 3001}),
        (Coder.DEFLATE, deflated[:-1], {}),
        (Coder.DEFLATE, deflated + b"x", {}),
        (Coder.DEFLATE, b"garbage" * 9, {}),
        (Coder.RAW, raw, {"integers": 2999}),
    ]:
        with pytest.raises(DataError, match="section 'tail'"):
            container.read_section(stored, section_of(raw, coder, stored, **lies))


def test_a_frame_that_claims_a_gigabyte_takes_no_memory():
    """A zstd frame's own content size is a claim like any other."""
    import zstandard

    frame = bytearray(zstandard.ZstdCompressor().compress(b"abc" * 100))
    huge = (
        frame[:4]
        + bytes([(frame[4] & 0x1F) | 0xC0 | 0x20])
        + struct.pack("<Q", 1 << 40)
        + frame[6 + (1 if frame[4] >> 6 == 1 else 0) :]
    )
    assert zstandard.get_frame_parameters(bytes(huge)).content_size == 1 << 40
    with pytest.raises(DataError):
        container.read_section(bytes(huge), section_of(b"abc" * 100, Coder.ZSTD, bytes(huge)))
