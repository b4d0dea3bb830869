"""Have every reader read files that unpack to far more than they are, or claim to, each in a process with a limit.

    python -m tools.stress.bombs [--format NAME …] [--json FILE]

A bomb must be refused, or read within 5 s of processor time and the memory that docs/security.md promises. Exits with 1
if one is not. (More are among the tests: tests/codec/test_hostile.py, tests/formats.)
"""

from __future__ import annotations

import dataclasses
import gzip
import json
import re
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import zstandard

from potr_cl.codec.sections import ORDER
from tests.reference.file_parts import File, Section
from tools.results import Results
from tools.stress.hostile import (
    camera_files,
    gltf_files,
    picture_files,
    ply_files,
    potr_files,
    sog_files,
    splat_files,
)
from tools.stress.hostile.changes import Files, saved
from tools.stress.hostile.formats import FORMATS
from tools.stress.hostile.judge import Verdict
from tools.stress.hostile.supervisor import read_again
from tools.stress.hostile.worker import Job, keep
from tools.workloads import plain_parser

_MIB = 1 << 20
_LONG = 1 << 26
_ORDER = [prop.value for prop in ORDER]
Bomb = Callable[[], Files]


def _is(name: str, data: bytes) -> Bomb:
    return lambda: {name: data}


def _claims(form: str, at: int, data: bytes, name: str = "") -> Bomb:
    """A good file of a format, or another that belongs to it, with something else in a place."""

    def make() -> Files:
        files = FORMATS[form].make(Random(0))
        changed = bytearray(files[name or next(iter(files))])
        changed[at : at + len(data)] = data
        return files | {name or next(iter(files)): bytes(changed)}

    return make


def _nested(name: str, opening: bytes) -> dict[str, Bomb]:
    return {"100,000 nested objects": _is(name, opening * 100_000)}


# .potr ---------------------------------------------------------------------------------------------------------------


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
    packed = zstandard.ZstdCompressor(level=3).compress(b" " * _LONG)
    file.sections = [Section(b"meta", packed, _LONG)]
    return {"a.potr": file.bytes()}


def _blocks(number: int, splats: int) -> Files:
    """Each costs time of its own, and claims so many splats."""
    file = File.of(potr_files.originals()[4])
    file.blocks = [dataclasses.replace(file.blocks[0], splats=splats)] * number
    return {"a.potr": file.bytes()}


# Scenes of other tools ------------------------------------------------------------------------------------------------

_PROPERTIES = [f"property float {name}" for name in ply_files.names_of(0)]
_BINARY, _ONE = "binary_little_endian", ["element vertex 1", *_PROPERTIES]


def _ply(layout: str, lines: list[str], body: bytes) -> Bomb:
    return lambda: {"a.ply": "\n".join(["ply", f"format {layout} 1.0", *lines, "end_header", ""]).encode() + body}


def _many_chunks() -> Files:
    data = re.sub(rb"(vertex|sh) 1\n", rb"\1 1073741824\n", saved("a.compressed.ply", 1, 3)["a.compressed.ply"])
    return {"a.compressed.ply": data.replace(b"chunk 1\n", b"chunk 4194304\n")}


def _spz_gzip(splats: int, more: int = 0, flags: int = 0) -> Files:
    content = bytes(splats * (9 + 1 + 3 + 3 + 4 + 45) + more)
    return {"a.spz": gzip.compress(splat_files.spz_content(3, splats, 3, content, flags), 9, mtime=0)}


def _spz_members() -> Files:
    start = gzip.compress(splat_files.spz_content(3, 1000, 0, bytes(20_000)), 9, mtime=0)
    return {"a.spz": start + gzip.compress(bytes(1 << 24), 9, mtime=0) * 8}


def _spz_streams(splats: int, said: int | None = None) -> Files:
    sizes = [size * splats for size in (9, 1, 3, 3, 4, 45)]
    streams = [zstandard.ZstdCompressor(level=3).compress(bytes(size)) for size in sizes]
    return {"a.spz": splat_files.spz_of_streams(said or splats, 3, streams, sizes)}


def _sog(side: int = 0, changes: Bomb = dict, **meta: Any) -> Bomb:
    """A folder of four splats, see :func:`sog_files.parts`, some of its files changed, as an archive."""
    return lambda: {"a.sog": sog_files.archive(sog_files.parts(4, 0, side, **meta) | changes(), zipfile.ZIP_DEFLATED)}


def _sog_overlapping() -> Files:
    """Thousands of names for the same packed bytes."""
    crc, packed = zlib.crc32(bytes(1 << 24)), zlib.compress(bytes(1 << 24), 9)[2:-4]
    sizes = (8, 0, 0, crc, len(packed), 1 << 24, 6, 0)
    local = struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, *sizes) + b"a.webp" + packed
    entry = struct.pack("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 20, 20, 0, *sizes, 0, 0, 0, 0, 0)
    entries = b"".join(entry + b"%06d" % i for i in range(3000))
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 3000, 3000, len(entries), len(local), 0)
    return {"a.sog": local + entries + end}


def _leaves(number: int, count: int) -> Files:
    leaves = [{"lods": {"0": {"file": 0, "offset": 0, "count": count}}}] * number
    meta = {"lodLevels": 1, "filenames": ["0/meta.json"], "tree": {"children": leaves}}
    return sog_files.streamed(meta, {"0": (5, 0)})


def _gltf(name: str, splats: int = 5, **changes: Any) -> Files:
    """An asset with parts of its description replaced; a function is applied to each of a list's entries."""
    description, content = gltf_files.asset(splats, 0)
    for key, value in changes.items():
        description[key] = [each | value for each in description[key]] if isinstance(value, dict) else value
    text = gltf_files.glb(json.dumps(description).encode(), content)
    return {name: text if name.endswith("glb") else gltf_files.gltf(description, content, None)}


def _nodes(name: str, number: int, node: dict[str, int]) -> Files:
    return _gltf(name, 1, nodes=[node] * number, scenes=[{"nodes": list(range(number))}])


# Cameras and pictures -------------------------------------------------------------------------------------------------


def _views(**changes: Any) -> Files:
    views = json.loads(camera_files.cameras(Random(0))["cameras.json"])
    return {"cameras.json": json.dumps([views[0] | changes, *views[1:]]).encode()}


def _frames(count: int) -> Files:
    content = json.loads(next(iter(camera_files.transforms(Random(0)).values())))
    return {"transforms.json": json.dumps(content | {"frames": content["frames"] * (count // 3)}).encode()}


def _name(name: bytes) -> Files:
    files = camera_files.colmap_binary(Random(0))
    return files | {"images.bin": files["images.bin"].replace(b"view_0.png\0", name)}


def _colmap_text(line: bytes) -> Bomb:
    files = camera_files.colmap_text(Random(0))
    return lambda: files | {"images.txt": files["images.txt"] + line}


def _png(width: int, height: int, kind: bytes = b"", start: bytes = b"", rows: int = 0) -> Bomb:
    """Of no rows, or of so many bytes of them; with a chunk of 64 MB behind its start if a kind is given."""
    others = [picture_files.chunk(kind, start + zlib.compress(bytes(_LONG), 9))] if kind else []
    return lambda: {"a.png": picture_files.png_of(width, height, bytes(rows), *others)}


_JPEG = picture_files.saved_as("RGB", "JPEG")
_WEBP = struct.pack("<4sI8sIBI5x", b"RIFF", 22, b"WEBPVP8L", 10, 0x2F, 16382 | 16382 << 14)
_BIG, _EQUAL = "pictures of 4,000², all splats claimed", "a million equal splats"

#: By format and name.
BOMBS: dict[str, dict[str, Bomb]] = {
    "potr": {
        "one splat, long metadata": _long_metadata,
        "a long description": _long_description,
        "2,000 blocks of a splat": partial(_blocks, 2000, 3),
        "1,000 blocks of 65,536 splats": partial(_blocks, 1000, 65_536),
    },
    "html": {"one splat, long metadata": lambda: {"a.html": potr_files.page_of(_long_metadata()["a.potr"])}},
    "ply": {
        "10¹² empty rows": _ply("ascii", [f"element nothing {10**12}", *_ONE], b"0 " * len(_PROPERTIES) + b"\n"),
        "30,000 properties": _ply(_BINARY, [*_ONE, *(f"property double p{i}" for i in range(30_000))], bytes(300_000)),
        "50,000 elements": _ply("ascii", [*(f"element e{i} 0" for i in range(50_000)), *_ONE], b"0 " * 20),
        "a row of 500,000 numbers": _ply("ascii", _ONE, b"0 " * 500_000),
        "a number of a million digits": _ply("ascii", _ONE, b"9" * 1_000_000 + b" 0" * (len(_PROPERTIES) - 1) + b"\n"),
        "100,000 comments": _ply("ascii", ["comment"] * 100_000, b""),
    },
    "compressed.ply": {"2³⁰ splats claimed": _many_chunks},
    "spz": {
        f"{_EQUAL}, gzip": partial(_spz_gzip, 1_000_000),
        "64 MB behind one splat, gzip": partial(_spz_gzip, 1, _LONG),
        "64 MB as an extension, gzip": partial(_spz_gzip, 1, _LONG, 2),
        "128 MB in further members, gzip": _spz_members,
        f"{_EQUAL}, Zstandard": partial(_spz_streams, 1_000_000),
        "streams of a million, one splat claimed": partial(_spz_streams, 1_000_000, 1),
    },
    "sog": {
        _BIG: _sog(4000, count=16_000_000),
        "pictures of 4,000², one splat claimed": _sog(4000, count=1),
        "64 MB of blanks as description": _sog(changes=lambda: {"meta.json": b" " * _LONG + b"{}"}),
        "64 MB of brackets as description": _sog(changes=lambda: {"meta.json": b"[" * _LONG}),
        "64 MB as a picture": _sog(changes=lambda: {"means_l.webp": bytes(_LONG)}),
        "48 GB by 3,000 names for one member": _sog_overlapping,
        "a codebook of a million": _sog(sh0={"codebook": [0] * 1_000_000, "files": ["sh0.webp"]}),
    },
    "sog-folder": {
        _BIG: lambda: sog_files.parts(4, 0, 4000, count=16_000_000),
        "a device as a picture": lambda: sog_files.parts(4, 0, sh0={"codebook": [0] * 256, "files": ["/dev/zero"]}),
    },
    "sog-levels": {
        "one splat in 100,000 leaves": partial(_leaves, 100_000, 1),
        "2⁶⁰ splats claimed in a leaf": partial(_leaves, 1, 1 << 60),
    },
    "glb": {
        "65,536 nodes with one splat": partial(_nodes, "a.glb", 65_536, {"mesh": 0}),
        "a stride of nothing": partial(_gltf, "a.glb", accessors={"count": 1 << 24}, bufferViews={"byteStride": 0}),
    },
    "gltf": {
        "500,000 empty nodes": partial(_nodes, "a.gltf", 500_000, {}),
        "a chain of 20,000 nodes": partial(
            _gltf, "a.gltf", nodes=[*({"children": [k + 1], "scale": [2] * 3} for k in range(20_000)), {"mesh": 0}]
        ),
        "16 MB in base64 that is none": lambda: {
            "a.gltf": gltf_files.gltf(gltf_files.asset(5, 0)[0], b"", "data:;base64," + "!" * (1 << 24))
        },
    },
    "splat": {"empty": _is("a.splat", b"")},
    "ksplat": {"2³² buckets of 2³² claimed": _claims("ksplat", 4104, b"\xff" * 4)},
    "ply.gz": {
        "64 MB of blanks": lambda: {"a.ply.gz": gzip.compress(b" " * _LONG, 9, mtime=0)},
        "members without content": lambda: {"a.ply.gz": gzip.compress(b"", mtime=0) * 100_000},
    },
    "cameras.json": {
        "100,000 brackets": _is("cameras.json", b"[" * 100_000),
        "a number of a million digits": _is("cameras.json", b"[" + b"9" * 1_000_000 + b"]"),
        "500,000 empty views": _is("cameras.json", b"[" + b"{}," * 500_000 + b"{}]"),
        "a name of a million folders": partial(_views, img_name="a/" * 500_000 + "a.png"),
        "a matrix of a million": partial(_views, rotation=[[0] * 1000] * 1000),
        **_nested("cameras.json", b'{"a":'),
    },
    "transforms.json": {
        "30,000 frames of one name": partial(_frames, 30_000),
        **_nested("transforms.json", b'{"frames":'),
    },
    "colmap-binary": {
        "2⁶³ cameras claimed": _claims("colmap-binary", 0, struct.pack("<Q", 1 << 63), name="cameras.bin"),
        "points that wrap round": _claims("colmap-binary", 83, struct.pack("<Q", (1 << 64) // 24 + 1)),
        "a name of a million letters": partial(_name, b"a" * 1_000_000 + b"\0"),
    },
    "colmap-text": {
        "a line of a million words": _colmap_text(b"1 " * 1_000_000),
        "a number of a million digits": _colmap_text(b"9" * 1_000_000 + b" 1 0 0 0 0 0 2 1 a.png\n\n"),
        "500,000 empty lines": _colmap_text(b"\n" * 500_000),
    },
    "png": {
        "65,535² pixels, no rows": _png(65_535, 65_535),
        "64 MB behind a pixel": _png(1, 1, rows=_LONG),
        "64 MB as a text": _png(8, 8, b"zTXt", b"a\0\0", 25 * 8),
        "64 MB as an international text": _png(8, 8, b"iTXt", b"a\0\1\0\0\0", 25 * 8),
        "64 MB as a colour profile": _png(8, 8, b"iCCP", b"a\0\0", 25 * 8),
    },
    "jpeg": {
        "65,500² pixels": lambda: {
            "a.jpg": re.sub(rb"(?s)(\xff[\xc0\xc2]...)....", lambda m: m[1] + b"\xff\xdc" * 2, _JPEG)
        }
    },
    "webp": {
        "16,383² pixels claimed": _is("a.webp", _WEBP),
        "2,000² equal pixels": lambda: {"a.webp": sog_files.one_colour(2000)},
    },
}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--format", action="append", choices=list(BOMBS), dest="formats", help="default: all")
    args = parser.parse_args()
    table = Results(None, args.json).table(
        "bombs", "Files that unpack to far more than they are, or claim to",
        "format; bomb; file|bytes|,; outcome; time|s of processor time|.2f; memory|MiB|.1f",
    )  # fmt: skip
    wrong = []
    for form in args.formats or BOMBS:
        with tempfile.TemporaryDirectory() as scratch:
            made = [make() for make in BOMBS[form].values()]
            nothing = Verdict("", "", 0.0, 0)
            sources = [keep(Path(scratch), Job(form, "", ""), k, files, nothing) for k, files in enumerate(made)]
            found = read_again(sources, Path(scratch, "out"))
        for name, files, result in zip(BOMBS[form], made, found, strict=True):
            size = sum(map(len, files.values()))
            seconds, memory = round(result["seconds"], 3), round(result["memory"] / _MIB, 1)
            table.add(form, name, size, result["kind"], seconds, memory)
            if result["kind"] not in ("read", "refused"):
                wrong.append(f"{form}, {name}: {result['kind']}\n{result['text']}")
    print("\n".join(wrong), file=sys.stderr)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
