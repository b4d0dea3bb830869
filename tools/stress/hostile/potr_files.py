""".potr files: small good ones, and changes of header, table of blocks, and every stream behind its coder, mostly with
checksums made right.

They are taken apart by :mod:`tests.reference.file_parts`, which shares no mistake with the package's own reader.
"""

from __future__ import annotations

import base64
import dataclasses
import itertools
import struct
import zlib
from collections.abc import Callable
from functools import cache
from random import Random
from typing import Any

import numpy as np
import zstandard

from potr_cl.codec.blocks import GeometryOfBlocks, blocks_of, quantise
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import Level, code_levels
from potr_cl.codec.quantize import HyperParameters, Preset
from potr_cl.codec.steps.fitting import fit_steps
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.formats.scenes.page import BEGIN, END
from potr_cl.model.scene import Scene
from tests.reference.file_parts import STREAMS, File, Section
from tests.reference.scenes import random_scene, ring_of_cameras
from tools.stress.hostile.changes import Files, damaged, damaged_json, interesting, interesting_double

_CRC = struct.Struct("<I")
_BYTES = (b"OCCU", b"SEVE", b"MULT", b"LEAF", b"TAIL", b"STEP")
#: Numbers that tell contexts before the models in a description of bundles.
_AC = 13 + 7 + 8 + 9 + 10
_NUMBERS = {
    b"OPAC": 2, b"SCAL": 9, b"ROTA": 27, b"SHC0": 24, b"SHC1": _AC + 12, b"SHC2": _AC + 20, b"SHC3": _AC + 28,
}  # fmt: skip
#: Splats, SH degree, preset, coder, most splats of a block, and levels of the files that are changed: few splats, as a
#: file should take no more than a millisecond.
_ORIGINALS: list[tuple[int, int, Preset, str, int, int]] = [
    (7, 3, "paper", "zstd", 99, 1),
    (30, 0, "paper", "zstd", 99, 1),
    (1, 0, "paper", "zstd", 99, 1),
    (9, 1, "best", "zstd", 99, 1),
    (1, 0, "best", "bundles", 99, 1),
    (12, 1, "best", "bundles", 99, 1),
    (20, 3, "best", "bundles", 99, 1),
    (300, 0, "best", "bundles", 999, 1),
    (300, 2, "best", "bundles", 999, 1),
    (12, 1, "best", "bundles", 5, 1),
    (40, 0, "best", "zstd", 8, 1),
    (20, 1, "best", "bundles", 20, 2),
]
#: Of these: the ones of most work least.
HOW_OFTEN = (3, 4, 3, 5, 4, 12, 8, 2, 2, 4, 4, 4)


@cache
def originals() -> list[bytes]:
    """Good files, some hundred bytes each, with and without splats in one place."""
    files = []
    for number, (splats, degree, preset, entropy, most, levels) in enumerate(_ORIGINALS):
        scene = random_scene(splats, degree, seed=number)
        if number in (1, 4, 5):  # splats in the same place
            scene = scene.subset(np.r_[np.arange(splats), np.arange(splats // 3), [0, 0]])
        scenes = [scene, *(scene.subset(np.arange(0, splats, 2)) for _ in range(levels - 1))]
        files.append(file_of(scenes, HyperParameters.from_quality(0.5, preset), entropy, most))
        coders = {block.coder for block in File.of(files[-1]).blocks}
        if coders != {int(entropy == "bundles")}:
            raise RuntimeError(f"the encoder takes another coder than {entropy} for what is to be changed")
    return files


def file_of(scenes: list[Scene], parameters: HyperParameters, entropy: str, most: int) -> bytes:
    """Scenes as the levels of a file, the finest first, in blocks of so few splats."""
    levels = []
    for number, scene in enumerate(scenes):
        rows = blocks_of(scene.means, most) if len(scene) > most else None
        geometry = quantise(scene, parameters, ring_of_cameras(2), rows=rows)
        if parameters.quantiser and not isinstance(geometry, GeometryOfBlocks):
            effects = np.exp(np.random.default_rng(1).normal(size=len(scene)))
            steps = fit_steps(geometry.scales, geometry.opacities, geometry.parameters.sf_opacity, effects)
            groups = np.arange(-(-len(scene) >> 2)).astype(np.int8) % 7 - 3
            few = ColourSteps(2, 3, 1, (8, 5), (20, -900), (188, -86, 55), tuple(range(-160, 180, 20)), groups)
            geometry = dataclasses.replace(geometry, steps=steps or few)
        levels.append(Level(scene, geometry, 0.5 * number))
    metadata = b'{"encoder": "potr_cl", "preset": "best", "quality": 0.5}'
    return b"".join(code_levels(levels, metadata, EntropyCoder(entropy, 3), 1).pieces)


def potr(rng: Random) -> Files:
    return {"a.potr": rng.choices(originals(), HOW_OFTEN)[0]}


def changed(files: Files, rng: Random) -> Files:
    return {name: _changed(data, rng) for name, data in files.items()}


def _changed(data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.15:  # as it comes, checksums and all
        for _ in range(1 + rng.randrange(3)):
            data = damaged(data, rng)
        return data
    if rng.random() < 0.05:  # anywhere in the header, made right
        size = int.from_bytes(data[12:16], "little")
        head = _flipped(data[8 : size - 4], rng)
        return data[:8] + head + _CRC.pack(zlib.crc32(data[:8] + head)) + data[size:]
    file = File.of(data)
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        rng.choice(_CHANGES)(file, rng)
    try:
        out = file.bytes()
    except (struct.error, OverflowError):  # a field took a number that it cannot hold
        return damaged(data, rng)
    return out if rng.random() < 0.97 else damaged(out, rng)


#: What may stand in a field of a header, of a block and of a table's entry, by the part that it stands in.
Fields = dict[str, Callable[[Any, Random], Any]]
_HEADER: Fields = {
    "version": lambda _, rng: rng.choice((0, 1, 2, interesting(rng, 2))),
    "quantiser": lambda _, rng: rng.choice((0, 1, 2, interesting(rng, 1))),
    "degree": lambda _, rng: rng.choice((0, 1, 2, 3, 4, interesting(rng, 1))),
    "flags": lambda _, rng: rng.choice((0, 1, 2, 3, 4, interesting(rng, 1))),
    "reserved": lambda _, rng: interesting(rng, 2),
    "count": lambda file, rng: rng.choice((0, len(file.blocks) + 1, interesting(rng, 4))),
}
_BLOCK: Fields = {
    "level": lambda _, rng: rng.choice((0, 1, 2, 255)),
    "coder": lambda _, rng: rng.choice((0, 1, 2, 255)),
    "depth": lambda b, rng: rng.choice((0, 1, 52, 53, b.depth + 1, max(b.depth - 1, 0), interesting(rng, 1))),
    "splats": lambda b, rng: rng.choice((interesting(rng, 4), interesting(rng, 2), b.splats + 1, b.splats - 1, 0)),
    "reals": lambda b, rng: _with_one(b.reals, (float("nan"), float("inf"), -1e38, 0.0, 1e38, -3.4e38, 1.0), rng),
    "side": lambda _, rng: interesting_double(rng),
    "factors": lambda b, rng: _with_one(b.factors, (0.0, 9e-4, 1e-3, 1.0, 1e9, 2e9, float("nan"), -1.0), rng),
    "count": lambda b, rng: rng.choice((0, len(b.sections) + 1, max(len(b.sections) - 1, 0), 32, 33, 255)),
}
#: An entry that says something else of the same bytes.
_ENTRY: Fields = {
    "name": lambda _, rng: rng.choice((*STREAMS, *_BYTES, b"meta", b"newA", b"\0\0\0\0", b"a\x1b[m", rng.randbytes(4))),
    "raw": lambda s, rng: rng.choice((interesting(rng, 4), interesting(rng, 2), s.raw + 1, s.raw * 2 % 2**32)),
    "crc": lambda _, rng: interesting(rng, 4),
    "size": lambda s, rng: rng.choice((interesting(rng, 4), len(s.stored) + 1, max(len(s.stored) - 1, 0))),
    "stored": lambda s, rng: damaged(s.stored, rng),
}


def _with_one(values: list[float], others: tuple[float, ...], rng: Random) -> list[float]:
    at = rng.randrange(len(values))
    return [*values[:at], rng.choice(others), *values[at + 1 :]]


def _field(file: File, rng: Random) -> None:
    parts: dict[str, list[Any]] = {"block": file.blocks, "entry": [section for _, section in file.all_sections()]}
    kind = rng.choice(("header", "block", "block", "block", "entry", "entry"))
    if not parts.get(kind):
        part, fields = file, _HEADER
    else:
        part, fields = rng.choice(parts[kind]), {"block": _BLOCK, "entry": _ENTRY}[kind]
    name = rng.choice(list(fields))
    setattr(part, name, fields[name](part, rng))


def _order(file: File, rng: Random) -> None:
    """Sections and blocks that lack, stand twice, are another file's or in another order; and new ones."""
    kind = rng.randrange(8)
    block = rng.choice(file.blocks) if file.blocks else None
    if block is None or not block.sections:
        return
    at = rng.randrange(len(block.sections))
    if kind == 0:
        del block.sections[at]
    elif kind == 1:
        block.sections.append(dataclasses.replace(block.sections[at]))
    elif kind == 2:
        rng.shuffle(block.sections)
    elif kind == 3:
        block.sections[at] = rng.choice(File.of(rng.choice(originals())).all_sections())[1]
    elif kind == 4:
        new = Section(rng.choice((b"newA", b"NewB", b"zzz1")), rng.randbytes(9), rng.choice((9, 9, 10, 1 << 20)))
        rng.choice((file.sections, block.sections)).insert(0, new)
    elif kind == 5:
        file.blocks.append(dataclasses.replace(block, level=rng.choice((0, block.level))))
    elif kind == 6:
        rng.shuffle(file.blocks)
    else:
        other = File.of(rng.choice(originals()))
        file.blocks = rng.choice((file.blocks[1:], file.blocks + other.blocks, other.blocks + file.blocks))


def _claim(file: File, rng: Random) -> None:
    """Another number of splats, which all plain streams claim to fit."""
    if not file.blocks:
        return
    block = rng.choice(file.blocks)
    block.splats = max(1, interesting(rng, rng.randrange(1, 4)))
    for section in block.sections:
        if section.name in STREAMS and block.coder == 0:
            section.raw = (STREAMS[section.name] * (1 + rng.randrange(6) * block.splats)) % 2**32


def _behind_the_coder(file: File, rng: Random) -> None:
    """Another content of a section, coded anew."""
    plain = [(b, s) for b, s in file.all_sections() if b is None or b.coder == 0 or s.name not in STREAMS]
    if not plain:
        return
    block, section = rng.choice(plain)
    raw = _content(section)
    if section.name == b"meta":
        raw = damaged_json(raw, rng)
    elif section.name in STREAMS and block is not None and rng.random() < 0.5:
        widths = bytes(rng.choice((0, 1, 2, 3, 4, 5, 5, 6)) for _ in range(STREAMS[section.name]))
        pattern = rng.choice((b"\0", b"\xff", b"\x7f", b"\x80", rng.randbytes(5)))
        size = sum(widths) * min(block.splats, 1000)
        raw = widths + (pattern * size)[:size]
    elif section.name == b"MULT" and rng.random() < 0.5:
        raw = b"".join(struct.pack("<I", rng.choice((0, 1, 2, 3, 2**31, 2**32 - 1))) for _ in range(rng.randrange(4)))
    elif section.name in _BYTES and raw and rng.random() < 0.5:
        values = bytearray(raw)
        for _ in range(1 + rng.randrange(3)):
            values[rng.randrange(len(values))] = rng.choice((0, 1, 2, 3, 52, 53, 128, 255, rng.randrange(256)))
        raw = bytes(values)
    else:
        raw = damaged(raw, rng) if rng.random() < 0.5 or not raw else _flipped(raw, rng)
    section.stored = _coded(raw, rng)
    section.raw = len(raw) if rng.random() < 0.9 else interesting(rng, 2)


def _content(section: Section) -> bytes:
    if len(section.stored) != section.raw:
        try:
            return zstandard.ZstdDecompressor().decompress(section.stored, max_output_size=1 << 20)
        except (zstandard.ZstdError, MemoryError):
            pass
    return section.stored


def _coded(raw: bytes, rng: Random) -> bytes:
    if rng.random() < 0.4:
        return raw
    odd = rng.random()
    packer = zstandard.ZstdCompressor(level=1, write_checksum=odd < 0.1, write_content_size=not 0.1 < odd < 0.2)
    stored = packer.compress(raw)
    if odd > 0.95:
        stored += stored
    elif odd > 0.9:
        stored = b"\x50\x2a\x4d\x18\x04\0\0\0skip" + stored
    return stored if rng.random() < 0.9 else damaged(stored, rng)


def _in_bundles(file: File, rng: Random) -> None:
    """Description, states, counts or words of a section of bundles."""
    coded = [(b, s) for b in file.blocks if b.coder == 1 for s in b.sections if s.name in STREAMS and len(s.stored) > 4]
    if not coded:
        _behind_the_coder(file, rng)
        return
    block, section = rng.choice(coded)
    (described,) = struct.unpack_from("<I", section.stored)
    start, bundles = 4 + described, min(-(-block.splats // 8192), 100)
    lanes = min(-(-block.splats // 256), 8192) if section.name in (b"OPAC", b"ROTA") else 0
    ends = [4, start, start + 4 * lanes, start + 4 * (lanes + bundles), len(section.stored)]
    parts = [section.stored[a:b] for a, b in itertools.pairwise(ends)]
    kind = rng.randrange(8)
    if kind <= 1 and parts[0]:
        parts[0] = _changed_description(parts[0], 2 * _NUMBERS[section.name], rng)
    elif kind == 2 and lanes:
        which = 4 * rng.randrange(lanes)
        state = rng.choice((0, 1, 65535, 65536, 65537, 2**32 - 1, rng.randrange(2**32)))
        parts[1] = parts[1][:which] + struct.pack("<I", state) + parts[1][which + 4 :]
    elif kind == 3:  # words that are one more or one less, and are counted
        parts[3] = parts[3][:-2] if rng.random() < 0.5 else parts[3] + rng.randbytes(2)
        parts[2] = struct.pack("<I", len(parts[3]) // 2) + parts[2][4:]
    elif kind == 4:
        parts[2] = damaged(parts[2], rng)
    elif kind == 5:  # models that decoders know, for words of others
        parts[0] = b""
    elif parts[3]:
        parts[3] = damaged(parts[3], rng) if rng.random() < 0.3 else _flipped(parts[3], rng)
    head = struct.pack("<I", len(parts[0]) if rng.random() < 0.95 else interesting(rng, 4))
    section.stored = head + b"".join(parts)
    section.raw = len(section.stored)


def _flipped(data: bytes, rng: Random) -> bytes:
    """Of the same length."""
    changed_bytes = bytearray(data)
    for _ in range(1 + rng.randrange(3)):
        changed_bytes[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(changed_bytes)


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
    return zstandard.ZstdCompressor(level=1).compress(bytes(raw))


_CHANGES = (*[_field] * 6, *[_order] * 2, _claim, *[_behind_the_coder] * 4, *[_in_bundles] * 5)


def page(rng: Random) -> Files:
    return {"a.html": page_of(potr(rng)["a.potr"])}


def changed_page(files: Files, rng: Random) -> Files:
    """Its text, or the file in it."""
    ((name, data),) = files.items()
    if rng.random() < 0.5:
        return {name: damaged(data, rng)}
    return {name: page_of(_changed(base64.b64decode(data.partition(BEGIN)[2].partition(END)[0]), rng))}


def page_of(potr: bytes) -> bytes:
    """A web page with a file in it."""
    return b"".join((b"<!doctype html><title>a</title>", BEGIN, base64.b64encode(potr), END))
