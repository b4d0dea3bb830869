"""Small files that unpack to far more, or claim to: BOMBS, by format and name. Each is made when it is asked for."""

from __future__ import annotations

import dataclasses
import gzip
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import zstandard

from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER
from tests.reference.file_parts import STREAMS, File, Section
from tests.reference.scenes import random_scene
from tools.stress.hostile import (
    camera_files,
    picture_files,
    ply_files,
    potr_files,
    scene_bomb_files,
    sog_files,
    spz_files,
)
from tools.stress.hostile.formats import Files

_LONG = 1 << 26
_ORDER = [prop.value for prop in ORDER]


# .potr ---------------------------------------------------------------------------------------------------------------


def _potr(splats: int, depth: int, sections: list[Section], degree: int = 0, blocks: int = 1) -> Files:
    """A file of equal blocks of the plain coder."""
    file = File.of(potr_files.originals()[3])
    block = dataclasses.replace(file.blocks[0], splats=splats, depth=depth, side=0.0)
    block.reals = [*(-9.0,) * 3, *(9.0,) * 3, 0.0, 0.0, 0.0, 0.0]
    if not any(section.name == b"OPAC" for section in sections):
        sections = [*sections, Section(b"OPAC", b"\0", 1)]
    block.sections = sorted(sections, key=lambda section: _ORDER.index(section.name.decode()))
    return {"a.potr": dataclasses.replace(file, degree=degree, blocks=[block] * blocks).bytes()}


def _run(name: bytes, value: int, size: int, before: bytes = b"") -> Section:
    """A section that holds one byte over and over."""
    raw = before + bytes([value]) * size
    return Section(name, zstandard.ZstdCompressor(level=3).compress(raw), len(raw))


def _one_splat(name: bytes, value: int) -> Callable[[], Files]:
    return lambda: _potr(1, 52, [_run(name, value, _LONG)])


def _one_leaf(splats: int, depth: int = 0) -> list[Section]:
    crowded = np.packbits(np.ones(depth, bool), bitorder="little").tobytes()
    tree = [Section(b"OCCU", b"\1" * depth, depth), Section(b"SEVE", crowded, len(crowded))]
    return [*(tree if depth else []), Section(b"MULT", splats.to_bytes(4, "little"), 4)]


def _leaf(splats: int) -> Files:
    return _potr(splats, 0, _one_leaf(splats))


def _equal_splats() -> Files:
    alike = random_scene(1, 0).subset(np.zeros(400_000, np.int64))
    return {"a.potr": b"".join(code_scene(alike, HyperParameters.from_quality(0.5, "best")).pieces)}


def _long_description() -> Files:
    """A description, whose stored size opens the section."""
    file = File.of(potr_files.originals()[8])
    section = next(section for section in file.blocks[0].sections if section.name == b"OPAC")
    (described,) = struct.unpack_from("<I", section.stored)
    packed = zstandard.ZstdCompressor(level=3).compress(bytes(_LONG))
    section.stored = struct.pack("<I", len(packed)) + packed + section.stored[4 + described :]
    section.raw = len(section.stored)
    return {"a.potr": file.bytes()}


def _long_metadata() -> Files:
    file = File.of(potr_files.originals()[3])
    file.sections = [_run(b"meta", 32, _LONG)]
    return {"a.potr": file.bytes()}


def _blocks_of_one_splat(number: int) -> Callable[[], Files]:
    """Each costs time of its own."""

    def made() -> Files:
        file = File.of(potr_files.originals()[4])
        file.blocks = file.blocks * number
        return {"a.potr": file.bytes()}

    return made


def _all_cells() -> Files:
    """A full tree and a long chain of cells above each of its splats."""
    levels, splats = 5, 8**5
    occupancy = b"\377" * sum(8**level for level in range(levels)) + b"\1" * splats * 40
    cells = sum(8**level for level in range(1, levels + 1)) + splats * 40
    several = np.packbits(np.arange(cells) < cells - splats, bitorder="little").tobytes()
    packer = zstandard.ZstdCompressor(level=3)
    sections = [
        Section(b"OCCU", packer.compress(occupancy), len(occupancy)),
        Section(b"SEVE", packer.compress(several), len(several)),
        _run(b"LEAF", 0, splats),
    ]
    return _potr(splats, levels + 40, sections)


def _as_much_as_is_let_through(planes: int) -> Callable[[], Files]:
    """The most splats that a file may claim, with every attribute as long as can be."""

    def made() -> Files:
        splats = 64_000 + 8 * 8_000
        sections = _one_leaf(splats, 52)
        for name in (b"SCAL", b"ROTA", b"SHC0", b"SHC1", b"SHC2", b"SHC3"):
            streams = STREAMS[name]
            sections.append(_run(name, 255, planes * splats * streams, bytes([planes] * streams)))
        file = File.of(_potr(splats, 52, sections, degree=3)["a.potr"])
        noise = np.random.default_rng(0).integers(0, 256, 8_000, np.uint8).tobytes()
        file.blocks[0].sections.append(Section(b"junk", noise, len(noise)))
        return {"a.potr": file.bytes()}

    return made


# Scenes of other tools ------------------------------------------------------------------------------------------------


def _plain(header: list[str], body: bytes) -> Files:
    return {"a.ply": "\n".join([*header, "end_header", ""]).encode() + body}


_PROPERTIES = [f"property float {name}" for name in ply_files.names_of(0)]


def _ply_count(kind: str, count: int) -> Files:
    return _plain(["ply", f"format {kind} 1.0", f"element vertex {count}", *_PROPERTIES], b"0 " * 1000)


def _ply_empty_elements() -> Files:
    header = ["ply", "format ascii 1.0", "element nothing 1000000000000", "element vertex 1", *_PROPERTIES]
    return _plain(header, b"0 " * len(_PROPERTIES) + b"\n")


def _ply_properties() -> Files:
    more = [f"property double p{i}" for i in range(30_000)]
    return _plain(["ply", "format binary_little_endian 1.0", "element vertex 1", *_PROPERTIES, *more], bytes(300_000))


def _ply_elements() -> Files:
    many = [f"element e{i} 0" for i in range(50_000)]
    return _plain(["ply", "format ascii 1.0", *many, "element vertex 1", *_PROPERTIES], b"0 " * 20)


def _ply_long_line() -> Files:
    return _plain(["ply", "format ascii 1.0", "element vertex 1", *_PROPERTIES], b"0 " * 500_000)


def _ply_long_number() -> Files:
    rest = b" 0" * (len(_PROPERTIES) - 1) + b"\n"
    return _plain(["ply", "format ascii 1.0", "element vertex 1", *_PROPERTIES], b"9" * 1_000_000 + rest)


def _ply_comments() -> Files:
    return _plain(["ply", "format ascii 1.0", *["comment"] * 100_000], b"")


def _compressed_count(count: int) -> Files:
    data = ply_files.compressed(1, 3)
    data = data.replace(b"element vertex 1\n", b"element vertex %d\n" % count)
    data = data.replace(b"element sh 1\n", b"element sh %d\n" % count)
    return {"a.compressed.ply": data.replace(b"element chunk 1\n", b"element chunk %d\n" % -(-count // 256))}


def _spz_gzip(version: int, splats: int, more: int = 0, flags: int = 0) -> Files:
    size = splats * (9 + 1 + 3 + 3 + (3 if version < 3 else 4) + 45) + more
    return {"a.spz": gzip.compress(spz_files.legacy(version, splats, 3, bytes(size), flags=flags), 9, mtime=0)}


def _spz_members() -> Files:
    start = gzip.compress(spz_files.legacy(3, 1000, 0, bytes(20_000)), 9, mtime=0)
    return {"a.spz": start + gzip.compress(bytes(1 << 24), 9, mtime=0) * 8}


def _spz_streams(splats: int, said: int | None = None) -> Files:
    sizes = [size * splats for size in (9, 1, 3, 3, 4, 45)]
    streams = [zstandard.ZstdCompressor(level=3).compress(bytes(size)) for size in sizes]
    return {"a.spz": spz_files.streamed(said or splats, 3, streams, sizes)}


def _sog_pictures(side: int, splats: int) -> Files:
    return {"a.sog": sog_files.archive(sog_files.equal_splats(side, splats))}


def _sog_member(name: str, content: bytes) -> Files:
    return {"a.sog": sog_files.archive(sog_files.parts(4, 0) | {name: content}, zipfile.ZIP_DEFLATED)}


def _sog_overlapping() -> Files:
    """Thousands of names for the same packed bytes."""
    crc, packed = zlib.crc32(bytes(1 << 24)), zlib.compress(bytes(1 << 24), 9)[2:-4]
    name = b"a.webp"
    local = struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, 8, 0, 0, crc, len(packed), 1 << 24,
                        len(name), 0) + name + packed  # fmt: skip
    entries = b"".join(
        struct.pack("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 20, 20, 0, 8, 0, 0, crc, len(packed),
                    1 << 24, 6, 0, 0, 0, 0, 0, 0) + (b"%06d" % i)
        for i in range(3000)
    )  # fmt: skip
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 3000, 3000, len(entries), len(local), 0)
    return {"a.sog": local + entries + end}


def _sog_meta(**changes: Any) -> Files:
    files = sog_files.parts(4, 0)
    meta = json.loads(files["meta.json"]) | changes
    return {"a.sog": sog_files.archive(files | {"meta.json": json.dumps(meta).encode()}, zipfile.ZIP_DEFLATED)}


# Cameras --------------------------------------------------------------------------------------------------------------


def _json(name: str, data: bytes) -> Callable[[], Files]:
    return lambda: {name: data}


def _views(**changes: Any) -> Callable[[], Files]:
    def made() -> Files:
        views = json.loads(camera_files.cameras_json())
        views[0] |= changes
        return {"cameras.json": json.dumps(views).encode()}

    return made


def _frames(count: int) -> Files:
    content = json.loads(camera_files.transforms_json())
    content["frames"] *= count // 3
    return {"transforms.json": json.dumps(content).encode()}


def _colmap(cameras: int, images: int, points: int) -> Files:
    files = camera_files.good_colmap_binary()[0]
    lenses = struct.pack("<Q", cameras) + files["cameras.bin"][8:]
    poses = struct.pack("<Q", images) + files["images.bin"][8:]
    end = poses.index(b"view_0.png\0") + len(b"view_0.png\0")
    return {"images.bin": poses[:end] + struct.pack("<Q", points) + poses[end + 8 :], "cameras.bin": lenses}


def _colmap_name() -> Files:
    files = camera_files.good_colmap_binary()[0]
    return files | {"images.bin": files["images.bin"].replace(b"view_0.png\0", b"a" * 1_000_000 + b"\0")}


def _colmap_text(line: bytes) -> Files:
    files = camera_files.good_colmap_text()[0]
    return files | {"images.txt": files["images.txt"] + line}


# Pictures -------------------------------------------------------------------------------------------------------------


def _png(
    width: int, height: int, *others: bytes, rows: int = 0, depth: int = 8, colour: int = 2
) -> Callable[[], Files]:
    return lambda: {"a.png": picture_files.png(width, height, 8, 2, bytes(rows), *others)}


def _packed(kind: bytes, start: bytes) -> bytes:
    return picture_files.chunk(kind, start + zlib.compress(bytes(_LONG), 9))


def _jpeg(side: int) -> Files:
    data = bytearray(picture_files.jpeg_originals()[0])
    frame = data.find(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", side, side)
    return {"a.jpg": bytes(data)}


#: By format and name.
BOMBS: dict[str, dict[str, Callable[[], Files]]] = {
    "potr": {
        "one splat, long several": _one_splat(b"SEVE", 0),
        "one splat, long multiplicity": _one_splat(b"MULT", 0),
        "one splat, long occupancy": _one_splat(b"OCCU", 1),
        "one splat, long leaf levels": _one_splat(b"LEAF", 0),
        "one splat, long tails": _one_splat(b"TAIL", 0),
        "one splat, long metadata": _long_metadata,
        "a leaf of 4 million splats": lambda: _leaf(1 << 22),
        "a leaf of 65,536 splats": lambda: _leaf(65_536),
        "400,000 equal splats": _equal_splats,
        "a long description": _long_description,
        "1.3 million cells above 32,768 splats": _all_cells,
        "the most splats that are let through": _as_much_as_is_let_through(1),
        "the most splats, 7 planes each": _as_much_as_is_let_through(7),
        "1,000 blocks of 65,536 splats": lambda: _potr(65_536, 0, _one_leaf(65_536), blocks=1000),
        "2,000 blocks of a splat": _blocks_of_one_splat(2000),
    },
    "ply": {
        "2³¹ splats claimed, binary": lambda: _ply_count("binary_little_endian", 1 << 31),
        "10¹⁸ splats claimed, text": lambda: _ply_count("ascii", 10**18),
        "10¹² rows of an element without properties": _ply_empty_elements,
        "30,000 properties": _ply_properties,
        "50,000 elements": _ply_elements,
        "a row of 500,000 numbers": _ply_long_line,
        "a number of a million digits": _ply_long_number,
        "100,000 comments": _ply_comments,
    },
    "compressed.ply": {
        "2³⁰ splats claimed": lambda: _compressed_count(1 << 30),
        "10⁹ splats claimed": lambda: _compressed_count(10**9),
    },
    "spz": {
        "a million equal splats, gzip": lambda: _spz_gzip(3, 1_000_000),
        "65,536 equal splats, gzip": lambda: _spz_gzip(2, 65_536),
        "64 MB behind one splat, gzip": lambda: _spz_gzip(3, 1, _LONG),
        "64 MB as an extension, gzip": lambda: _spz_gzip(3, 1, _LONG, 2),
        "128 MB in further members, gzip": _spz_members,
        "a million equal splats, Zstandard": lambda: _spz_streams(1_000_000),
        "65,536 equal splats, Zstandard": lambda: _spz_streams(65_536),
        "streams of a million, one splat claimed": lambda: _spz_streams(1_000_000, 1),
    },
    "sog": {
        "pictures of 4,000², all splats claimed": lambda: _sog_pictures(4000, 16_000_000),
        "pictures of 4,000², one splat claimed": lambda: _sog_pictures(4000, 1),
        "pictures of 256², all splats claimed": lambda: _sog_pictures(256, 65_536),
        "64 MB of blanks as description": lambda: _sog_member("meta.json", b" " * _LONG + b"{}"),
        "64 MB of brackets as description": lambda: _sog_member("meta.json", b"[" * _LONG),
        "64 MB as a picture": lambda: _sog_member("means_l.webp", bytes(_LONG)),
        "48 GB by 3,000 names for one member": _sog_overlapping,
        "a codebook of a million": lambda: _sog_meta(sh0={"codebook": [0] * 1_000_000, "files": ["sh0.webp"]}),
    },
    **scene_bomb_files.BOMBS,
    "cameras.json": {
        "100,000 brackets": _json("cameras.json", b"[" * 100_000),
        "100,000 nested objects": _json("cameras.json", b'{"a":' * 100_000),
        "a number of a million digits": _json("cameras.json", b"[" + b"9" * 1_000_000 + b"]"),
        "a number of 10⁹ as exponent": _json("cameras.json", b"[1e1000000000]"),
        "500,000 empty views": _json("cameras.json", b"[" + b"{}," * 500_000 + b"{}]"),
        "a name of a million letters": _views(img_name="a" * 1_000_000),
        "a name of a million folders": _views(img_name="a/" * 500_000 + "a.png"),
        "a matrix of a million": _views(rotation=[[0] * 1000] * 1000),
    },
    "transforms.json": {
        "30,000 frames of one name": lambda: _frames(30_000),
        "100,000 nested objects": _json("transforms.json", b'{"frames":' * 100_000),
    },
    "colmap-binary": {
        "2⁶³ cameras claimed": lambda: _colmap(1 << 63, 3, 0),
        "2⁶³ images claimed": lambda: _colmap(2, 1 << 63, 0),
        "2⁶³ points claimed": lambda: _colmap(2, 3, 1 << 63),
        "points that wrap round": lambda: _colmap(2, 3, (1 << 64) // 24 + 1),
        "a name of a million letters": _colmap_name,
    },
    "colmap-text": {
        "a line of a million words": lambda: _colmap_text(b"1 " * 1_000_000),
        "a number of a million digits": lambda: _colmap_text(b"9" * 1_000_000 + b" 1 0 0 0 0 0 2 1 a.png\n\n"),
        "500,000 empty lines": lambda: _colmap_text(b"\n" * 500_000),
    },
    "png": {
        "65,535² pixels, no rows": _png(65_535, 65_535),
        "2³¹ x 1 pixels, no rows": _png((1 << 31) - 1, 1),
        "64 MB behind a pixel": _png(1, 1, rows=_LONG),
        "64 MB as a text": lambda: _png(8, 8, _packed(b"zTXt", b"a\0\0"), rows=25 * 8)(),
        "64 MB as an international text": lambda: _png(8, 8, _packed(b"iTXt", b"a\0\1\0\0\0"), rows=25 * 8)(),
        "64 MB as a colour profile": lambda: _png(8, 8, _packed(b"iCCP", b"a\0\0"), rows=25 * 8)(),
        "an animation of 10⁹ frames": _png(
            8, 8, picture_files.chunk(b"acTL", struct.pack(">II", 10**9, 0)), rows=25 * 8
        ),
    },
    "jpeg": {"65,500² pixels": lambda: _jpeg(65_500)},
    "webp": {
        "16,383² pixels claimed": lambda: {
            "a.webp": b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8L" + struct.pack("<I", 10)
            + b"\x2f" + struct.pack("<I", 16382 | 16382 << 14) + bytes(5)
        },
        "2,000² equal pixels": lambda: {"a.webp": sog_files.one_colour(2000)},
    },
}  # fmt: skip
