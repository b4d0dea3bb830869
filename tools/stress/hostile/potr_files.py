"""Changed .potr files: header, section table, and every stream behind its coder, mostly with checksums made right.

The layout is that of docs/format.md and is written out here anew, so that a mistake in the package's own is not shared.
"""

from __future__ import annotations

import dataclasses
import itertools
import struct
import zlib
from functools import cache
from random import Random
from unittest.mock import patch

import numpy as np
import zstandard

from potr_cl.codec import encoder
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import quantise_geometry
from potr_cl.codec.quantize import HyperParameters, Preset
from potr_cl.codec.steps.fitting import fit_steps
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.model.scene import Scene
from tests.reference.scenes import random_scene, ring_of_cameras
from tools.stress.hostile.changes import damaged, damaged_json, interesting, interesting_double

_HEADER = struct.Struct("<8sHHIQQBBHI8d8s8s")
_ENTRY = struct.Struct("<BBBBIQQ")
_CRC = struct.Struct("<I")
_RAW, _ZSTD, _DEFLATE, _CONTEXT, _BUNDLES = range(5)
_METADATA, _OCCUPANCY, _SEVERAL, _MULTIPLICITY, _TAIL_LENGTH, _TAIL, _STEPS = range(7)
_SCALE, _ROTATION, _OPACITY, _SH = range(16, 20)
_FIRST_PER_SPLAT = 16
_HEAD = struct.Struct("<II")
#: Entropy, splats, SH degree, preset and version of the files that are changed: all coders and versions; few splats, as
#: a file should take no more than a millisecond.
_ORIGINALS: list[tuple[str, int, int, Preset, int]] = [
    ("zstd", 7, 3, "paper", 1),
    ("npz", 24, 1, "paper", 1),
    ("zstd", 30, 0, "paper", 1),
    ("npz", 1, 0, "paper", 1),
    ("npz", 5, 1, "best", 2),
    ("zstd", 9, 0, "best", 2),
    ("context", 1, 0, "best", 2),
    ("context", 12, 1, "best", 2),
    ("context", 5, 3, "best", 2),
    ("context", 300, 0, "best", 2),
    ("zstd", 9, 1, "best", 3),
    ("context", 1, 0, "best", 3),
    ("context", 12, 1, "best", 3),
    ("context", 20, 3, "best", 3),
    ("context", 300, 0, "best", 3),
]
#: Of these: the one of most work least.
_HOW_OFTEN = (2, 4, 4, 2, 4, 4, 4, 8, 4, 1, 4, 4, 12, 8, 2)
#: Numbers that tell contexts before the models in a description of coder 4.
_NUMBERS = {
    (_OPACITY, 0): 2,
    (_SCALE, 0): 9,
    (_ROTATION, 0): 27,
    (_SH, 0): 24,
    (_SH, 3): 13 + 7 + 8 + 9 + 10 + 4 * 3,
    (_SH, 12): 13 + 7 + 8 + 9 + 10 + 4 * 5,
    (_SH, 27): 13 + 7 + 8 + 9 + 10 + 4 * 7,
}


@dataclasses.dataclass
class Section:
    """A table entry and what belongs to it."""

    prop: int
    index: int
    coder: int
    number: int
    size: int
    stored: bytes
    crc: int | None = None  # another than the right one


@dataclasses.dataclass
class File:
    """A .potr file in parts that can be changed one by one; :meth:`bytes` makes sizes and checksums right again."""

    magic: bytes
    version: int
    flags: int
    splats: int
    degree: int
    depth: int
    reserved: int
    doubles: list[float]
    factor: bytes
    tail: bytes
    sections: list[Section]

    @staticmethod
    def of(data: bytes) -> File:
        fields = _HEADER.unpack_from(data)
        magic, version, flags, start, _, splats, degree, depth, count, reserved = fields[:10]
        sections = []
        for i in range(count):
            prop, index, coder, number, _, size, stored = _ENTRY.unpack_from(data, _HEADER.size + i * _ENTRY.size)
            sections.append(Section(prop, index, coder, number, size, data[start : start + stored]))
            start += stored
        doubles = list(fields[10:18])
        return File(magic, version, flags, splats, degree, depth, reserved, doubles, fields[18], fields[19], sections)

    def bytes(self) -> bytes:
        start = _HEADER.size + _ENTRY.size * len(self.sections) + _CRC.size
        fixed = _HEADER.pack(
            self.magic, self.version, self.flags, start, start + sum(len(s.stored) for s in self.sections), self.splats,
            self.degree, self.depth, len(self.sections), self.reserved, *self.doubles, self.factor, self.tail,
        )  # fmt: skip
        table = b"".join(
            _ENTRY.pack(
                s.prop, s.index, s.coder, s.number, zlib.crc32(s.stored) if s.crc is None else s.crc,
                s.size, len(s.stored),
            )
            for s in self.sections
        )  # fmt: skip
        return fixed + table + _CRC.pack(zlib.crc32(fixed + table)) + b"".join(s.stored for s in self.sections)


@cache
def originals() -> list[bytes]:
    """Good files, some hundred bytes each, with and without splats in one place."""
    files = []
    # The encoder takes coders of streams where they pay, which is not in files as small as these.
    with patch.object(encoder, "_FEW", 0):
        for number, (entropy, splats, degree, preset, version) in enumerate(_ORIGINALS):
            scene = random_scene(splats, degree, seed=number)
            if number in (1, 4, 7, 12):  # splats in the same place
                scene = scene.subset(np.r_[np.arange(splats), np.arange(splats // 3), [3, 3]])
            files.append(file_of(scene, entropy, HyperParameters.from_quality(0.5, preset), version))
            coders = {section.coder for section in File.of(files[-1]).sections if section.prop >= _FIRST_PER_SPLAT}
            if (entropy == "context") != (coders == {_CONTEXT if version == 2 else _BUNDLES}):
                raise RuntimeError(f"the encoder takes other coders than {entropy} for what is to be changed")
    return files


def file_of(scene: Scene, entropy: str, parameters: HyperParameters, version: int) -> bytes:
    """A scene as it is in a file of a version, if that has them with steps of colours."""
    parameters = dataclasses.replace(parameters, version=version)
    views = ring_of_cameras(2)
    geometry = quantise_geometry(scene, parameters, views)
    if version == 3:
        effects = np.exp(np.random.default_rng(1).normal(size=len(scene)))
        steps = fit_steps(geometry.scales, geometry.opacities, geometry.parameters.sf_opacity, effects)
        groups = np.arange(-(-len(scene) >> 2)).astype(np.int8) % 7 - 3
        few = ColourSteps(2, 3, 1, (8, 5), (20, -900), (188, -86, 55), tuple(range(-160, 180, 20)), groups)
        geometry = dataclasses.replace(geometry, steps=steps or few)
    metadata = b'{"encoder": "potr_cl", "preset": "best", "quality": 0.5}'
    coder = EntropyCoder(entropy, 3)
    return b"".join(code_scene(scene, parameters, views, metadata, coder, 1, geometry=geometry).pieces)


def sealed(data: bytes) -> bytes:
    """A file with sizes and checksums made right for whatever its header and its table say now."""
    count = min(int.from_bytes(data[34:36], "little"), 200)
    start = _HEADER.size + _ENTRY.size * count + _CRC.size
    try:
        return File.of(
            data[:12] + struct.pack("<I", start) + data[16:34] + struct.pack("<H", count) + data[36:]
        ).bytes()
    except struct.error:  # too short
        return data


def changed(rng: Random) -> bytes:
    """One of the originals, changed."""
    data = rng.choices(originals(), _HOW_OFTEN)[0]
    if rng.random() < 0.15:  # as it comes, checksums and all
        for _ in range(1 + rng.randrange(3)):
            data = damaged(data, rng)
        return data
    file = File.of(data)
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        rng.choice(_CHANGES)(file, rng)
    try:
        out = file.bytes()
    except struct.error:  # a field took a number that it cannot hold
        return damaged(data, rng)
    return out if rng.random() < 0.97 else damaged(out, rng)


def _header(file: File, rng: Random) -> None:
    kind = rng.randrange(9)
    if kind == 0:
        file.version = rng.choice((0, 1, 2, 3, 4, interesting(rng, 2)))
    elif kind == 1:
        file.splats = rng.choice((interesting(rng, 8), interesting(rng, 2), file.splats + 1, file.splats - 1))
    elif kind == 2:
        file.degree = rng.choice((0, 1, 2, 3, 4, interesting(rng, 1)))
    elif kind == 3:
        file.depth = rng.choice((0, 1, 52, 53, file.depth + 1, max(file.depth - 1, 0), interesting(rng, 1)))
    elif kind == 4:
        file.flags, file.reserved = interesting(rng, 2), interesting(rng, 4)
    elif kind == 5:
        file.factor = struct.pack("<d", interesting_double(rng))
    elif kind == 6:
        file.tail = rng.randbytes(8)
    else:
        file.doubles[rng.randrange(8)] = interesting_double(rng)


def _table(file: File, rng: Random) -> None:
    """An entry that says something else of the same bytes."""
    section = rng.choice(file.sections)
    kind = rng.randrange(7)
    if kind == 0:
        section.prop = rng.choice((*range(7), *range(16, 20), interesting(rng, 1)))
    elif kind == 1:
        section.index = rng.choice((0, 1, 2, 3, 12, 27, 47, 48, interesting(rng, 1)))
    elif kind == 2:
        section.coder = rng.choice((0, 1, 2, 3, 4, 5, 255))
    elif kind == 3:
        section.number = rng.choice((0, 1, 2, 3, 8, 9, 15, 21, interesting(rng, 1)))
    elif kind == 4:
        section.size = rng.choice((interesting(rng, 8), interesting(rng, 3), section.size + 1, section.size * 2))
    elif kind == 5:
        section.crc = interesting(rng, 4)
    else:
        section.stored = damaged(section.stored, rng)


def _order(file: File, rng: Random) -> None:
    """Sections that lack, stand twice, are another file's or in another order."""
    kind = rng.randrange(5)
    at = rng.randrange(len(file.sections))
    if kind == 0:
        del file.sections[at]
        if not file.sections:
            file.sections.append(Section(18, 0, _RAW, 1, file.splats, bytes(min(file.splats, 1000))))
    elif kind == 1:
        file.sections.append(dataclasses.replace(file.sections[at]))
    elif kind == 2:
        rng.shuffle(file.sections)
    elif kind == 3:
        file.sections[at] = rng.choice(File.of(rng.choice(originals())).sections)
    else:
        file.sections.append(Section(rng.choice((0, 5, 18, 19)), rng.randrange(4), _RAW, 1, 3, rng.randbytes(3)))


def _claim(file: File, rng: Random) -> None:
    """Another number of splats, which all streams claim to fit."""
    file.splats = max(1, interesting(rng, rng.randrange(1, 6)))
    for section in file.sections:
        if section.prop >= _FIRST_PER_SPLAT:
            section.size = file.splats * max(1, section.number) % (1 << 64)


def _behind_the_coder(file: File, rng: Random) -> None:
    """Other integers in a stream, coded anew."""
    plain = [section for section in file.sections if section.coder < _CONTEXT]
    if not plain:
        _in_a_coder_of_streams(file, rng)
        return
    section = rng.choice(plain)
    raw = _decoded(section)
    if section.prop == _METADATA:
        raw = damaged_json(raw, rng)
    elif section.prop >= _FIRST_PER_SPLAT and rng.random() < 0.5:
        section.number = rng.randrange(1, 9)
        pattern = rng.choice((b"\0", b"\xff", b"\x7f", b"\x80", rng.randbytes(5)))
        size = section.number * min(file.splats, 1000)
        raw = (pattern * size)[:size]
    elif section.prop == _MULTIPLICITY and rng.random() < 0.5:
        section.number = rng.randrange(1, 9)
        raw = b"".join(rng.choice((b"\0", b"\1", b"\2", b"\3", b"\xff")) for _ in range(section.number * 2))
    elif section.prop in (_OCCUPANCY, _SEVERAL, _TAIL_LENGTH, _TAIL, _STEPS) and raw and rng.random() < 0.5:
        values = bytearray(raw)
        for _ in range(1 + rng.randrange(3)):
            values[rng.randrange(len(values))] = rng.choice((0, 1, 2, 3, 52, 53, 128, 255, rng.randrange(256)))
        raw = bytes(values)
    else:
        raw = damaged(raw, rng)
    size = len(raw)
    if section.prop >= _FIRST_PER_SPLAT and rng.random() < 0.7:  # else it is told by the table alone
        wanted = file.splats * max(1, section.number)
        raw = (raw + bytes(min(wanted, 4000)))[: min(wanted, 4000)]
        size = len(raw)
    section.coder = rng.choice((_RAW, _ZSTD, _DEFLATE))
    section.stored = _coded(raw, section.coder, rng)
    section.size = size if rng.random() < 0.9 else interesting(rng, 2)


def _decoded(section: Section) -> bytes:
    try:
        if section.coder == _ZSTD:
            return zstandard.ZstdDecompressor().decompress(section.stored, max_output_size=1 << 20)
        if section.coder == _DEFLATE:
            return zlib.decompressobj().decompress(section.stored, 1 << 20)
    except (zstandard.ZstdError, zlib.error, MemoryError):
        pass
    return section.stored


def _coded(raw: bytes, coder: int, rng: Random) -> bytes:
    if coder == _ZSTD:
        odd = rng.random()
        packer = zstandard.ZstdCompressor(level=1, write_checksum=odd < 0.1, write_content_size=not 0.1 < odd < 0.2)
        stored = packer.compress(raw)
        if odd > 0.95:
            stored += stored
        elif odd > 0.9:
            stored = b"\x50\x2a\x4d\x18\x04\0\0\0skip" + stored
    elif coder == _DEFLATE:
        stored = zlib.compress(raw, rng.choice((0, 1, 9)))
    else:
        return raw
    return stored if rng.random() < 0.9 else damaged(stored, rng)


def _in_a_coder_of_streams(file: File, rng: Random) -> None:
    if any(section.coder == _BUNDLES for section in file.sections):
        _in_bundles(file, rng)
    else:
        _in_the_context_coder(file, rng)


def _in_bundles(file: File, rng: Random) -> None:
    """Description, states, counts or words of a section of coder 4."""
    section = rng.choice([section for section in file.sections if section.coder == _BUNDLES])
    if len(section.stored) <= 4:
        return
    (described,) = struct.unpack_from("<I", section.stored)
    start, bundles = 4 + described, min(-(-file.splats // 8192), 100)
    lanes = min(-(-file.splats // 256), 8192) if section.prop in (_OPACITY, _ROTATION) else 0
    ends = [4, start, start + 4 * lanes, start + 4 * (lanes + bundles), len(section.stored)]
    parts = [section.stored[a:b] for a, b in itertools.pairwise(ends)]
    kind = rng.randrange(7)
    if kind <= 1:
        parts[0] = _changed_description(parts[0], 2 * _NUMBERS.get((section.prop, section.index), 2), rng)
    elif kind == 2 and lanes:
        which = 4 * rng.randrange(lanes)
        state = rng.choice((0, 1, 65535, 65536, 65537, 2**32 - 1, rng.randrange(2**32)))
        parts[1] = parts[1][:which] + struct.pack("<I", state) + parts[1][which + 4 :]
    elif kind == 3:  # words that are one more or one less, and are counted
        parts[3] = parts[3][:-2] if rng.random() < 0.5 else parts[3] + rng.randbytes(2)
        parts[2] = struct.pack("<I", len(parts[3]) // 2) + parts[2][4:]
    elif kind == 4:
        parts[2] = damaged(parts[2], rng)
    elif parts[3]:
        parts[3] = damaged(parts[3], rng) if rng.random() < 0.3 else _flipped(parts[3], rng)
    head = struct.pack("<I", len(parts[0]) if rng.random() < 0.95 else interesting(rng, 4))
    section.stored = head + b"".join(parts)


def _flipped(data: bytes, rng: Random) -> bytes:
    """Of the same length."""
    changed_bytes = bytearray(data)
    for _ in range(1 + rng.randrange(3)):
        changed_bytes[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(changed_bytes)


def _in_the_context_coder(file: File, rng: Random) -> None:
    """Description, extra bits, states or words of a section of the context coder."""
    coded = [section for section in file.sections if section.coder == _CONTEXT and len(section.stored) > _HEAD.size]
    if not coded:
        _behind_the_coder_again(file, rng)
        return
    section = rng.choice(coded)
    described, beside = _HEAD.unpack_from(section.stored)
    start = _HEAD.size + described
    lanes = min(-(-file.splats // 256), 8192)
    parts = [
        section.stored[_HEAD.size : start],
        section.stored[start : start + beside],
        section.stored[start + beside : start + beside + 4 * lanes],
        section.stored[start + beside + 4 * lanes :],
    ]
    kind = rng.randrange(6)
    if kind <= 1:
        parts[0] = _changed_description(parts[0], 14 * section.number, rng)
    elif kind <= 4:
        part = parts[kind - 1]
        if kind == 3 and rng.random() < 0.5 and lanes < 100:
            part = b"".join(
                struct.pack("<I", rng.choice((0, 1, 65535, 65536, 65537, 2**32 - 1, rng.randrange(2**32))))
                for _ in range(lanes)
            )
        parts[kind - 1] = damaged(part, rng)
    head = _HEAD.pack(len(parts[0]), len(parts[1]))
    if kind == 5:
        head = _HEAD.pack(*(rng.choice((len(part), interesting(rng, 4), len(part) + 1)) for part in parts[:2]))
    section.stored = head + b"".join(parts)


def _behind_the_coder_again(file: File, rng: Random) -> None:
    if any(section.coder < _CONTEXT for section in file.sections):
        _behind_the_coder(file, rng)


def _changed_description(stored: bytes, weights: int, rng: Random) -> bytes:
    try:
        raw = bytearray(zstandard.ZstdDecompressor().decompress(stored, max_output_size=1 << 20))
    except zstandard.ZstdError:
        return damaged(stored, rng)
    kind = rng.randrange(5)
    if kind == 0 and len(raw) >= weights > 0:
        at = 2 * rng.randrange(weights // 2)
        raw[at : at + 2] = interesting(rng, 2).to_bytes(2, "little")
    elif kind == 1 and len(raw) > weights + 1:
        raw[weights + rng.randrange(2)] = rng.choice((0, 1, 32, 33, 252, 253, 255))
    elif kind == 2 and len(raw) > weights + 2:  # frequencies that still add up: what one loses another gets
        contexts, used = raw[weights], raw[weights + 1]
        low = weights + 2 + contexts - 1
        context, one, other = rng.randrange(max(contexts, 1)), rng.randrange(max(used, 1)), rng.randrange(max(used, 1))
        give, take = low + one * contexts + context, low + other * contexts + context
        high = contexts * used
        if max(give, take) + high < len(raw):
            amount = rng.choice((1, raw[give]))
            total = raw[take] + amount
            if raw[give] >= amount and give != take:
                raw[give] -= amount
                raw[take] = total & 255
                raw[take + high] = (raw[take + high] + (total >> 8)) & 255
    elif kind == 3:
        raw = bytearray(damaged(bytes(raw), rng))
    else:
        raw[weights:weights] = raw[weights : weights + 40]
    return _coded(bytes(raw), _ZSTD, rng)


_CHANGES = (
    _header, _header, _table, _table, _order, _claim,
    _behind_the_coder, _behind_the_coder, _behind_the_coder,
    _in_a_coder_of_streams, _in_a_coder_of_streams, _in_a_coder_of_streams, _in_a_coder_of_streams,
)  # fmt: skip
