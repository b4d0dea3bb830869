"""Changed pictures: PNG with its chunks' checksums made right, JPEG, WebP, and other kinds under their names."""

from __future__ import annotations

import io
import struct
import zlib
from functools import cache
from random import Random

import numpy as np
from PIL import Image

from tools.stress.hostile.changes import damaged, interesting

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: Beginnings of kinds that nobody should open because of a name that ends in .png.
_OTHER_KINDS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n(x) print\nshowpage\n%%EOF\n",
    b"\0\0\0\x1cftypavif\0\0\0\0avifmif1miafMA1B" + bytes(40),
    b"DDS " + struct.pack("<IIIIIII", 124, 0x1007, 8, 8, 16, 0, 1) + bytes(128),
    b"BLP2" + struct.pack("<IBBBB", 1, 2, 8, 0, 0) + struct.pack("<II", 4, 4) + bytes(200),
    b"GIF89a" + struct.pack("<HH", 8, 8) + b"\x80\0\0" + bytes(30),
    b"II*\0\x08\0\0\0\1\0" + bytes(30), b"MM\0*" + bytes(30), b"BM" + bytes(60), b"8BPS\0\1" + bytes(60),
    b"qoif" + bytes(20), b"P6 8 8 255\n" + bytes(192), b"Pf 1 1\n-1.0\n" + bytes(4), b"SIMPLE  =" + bytes(80),
    b"\0\0\1\0\1\0" + bytes(30), b"icns" + bytes(30), b"\x0a\5\1\x08" + bytes(130), b"GRIB" + bytes(30),
    b"\xd7\xcd\xc6\x9a" + bytes(40), b"\x89HDF\r\n\x1a\n" + bytes(40), b"\xff\x4f\xff\x51" + bytes(40),
    b"#define im_width 8\n#define im_height 8\nstatic char im_bits[] = {\n0};", b"<svg xmlns='x'/>", b"",
)  # fmt: skip


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, depth: int, colour: int, pixels: bytes, *others: bytes) -> bytes:
    """A PNG file from its rows, each with the number of its filter in front."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"".join((_SIGNATURE, head, *others, chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b"")))


@cache
def small_png() -> bytes:
    """A good PNG of 8 x 6 pixels."""
    return _saved("RGB", "PNG")


@cache
def _saved(mode: str, kind: str, *options: tuple[str, int | bytes | str]) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4), np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(out, kind, **dict(options))
    return out.getvalue()


@cache
def png_originals() -> list[bytes]:
    rows = b"".join(b"\0" + bytes(range(k, k + 16)) for k in range(4))
    return [
        *(_saved(mode, "PNG") for mode in ("RGB", "RGBA", "L", "LA", "P", "1")),
        png(8, 4, 16, 0, rows),
        png(4, 4, 8, 6, rows),
        png(16, 4, 8, 3, rows, chunk(b"PLTE", bytes(range(60))), chunk(b"tRNS", bytes(20))),
    ]


def good_pngs() -> list[bytes]:
    """Those with 8 bits a channel."""
    return [data for data in png_originals() if data[24] <= 8]


@cache
def jpeg_originals() -> list[bytes]:
    return [
        _saved("RGB", "JPEG", ("quality", 50)),
        _saved("L", "JPEG", ("quality", 20)),
        _saved("CMYK", "JPEG", ("quality", 20)),
        _saved("RGB", "JPEG", ("progressive", 1), ("quality", 30), ("comment", "a")),
    ]


@cache
def webp_originals() -> list[bytes]:
    return [
        _saved("RGB", "WEBP", ("quality", 20), ("method", 0)),
        _saved("RGBA", "WEBP", ("quality", 20), ("method", 0)),
        _saved("RGB", "WEBP", ("lossless", 1), ("method", 0)),
        _saved("RGBA", "WEBP", ("lossless", 1), ("method", 0)),
        _saved("RGB", "WEBP", ("lossless", 1), ("method", 0), ("exif", b"Exif\0\0II*\0")),
    ]


def changed_png(rng: Random) -> bytes:
    if rng.random() < 0.06:
        other = rng.choice(_OTHER_KINDS)
        return other if rng.random() < 0.5 else damaged(other, rng)
    data = rng.choice(png_originals())
    parts = chunks(data)
    for _ in range(1 + rng.choice((0, 0, 1))):
        at = rng.randrange(len(parts))
        kind, content = parts[at]
        way = rng.randrange(8)
        if way <= 1:
            content = _changed_head(parts[0][1], rng)
            at, kind = 0, b"IHDR"
        elif way == 2:
            inside = next((i for i, each in enumerate(parts) if each[0] == b"IDAT"), at)
            at, (kind, content) = inside, parts[inside]
            try:
                raw = damaged(zlib.decompress(content), rng)
                content = zlib.compress(raw + bytes(rng.choice((0, 0, 1 << 16))))
            except zlib.error:
                content = damaged(content, rng)
        elif way == 3:
            other = rng.choice(
                (b"tEXt", b"zTXt", b"iTXt", b"PLTE", b"tRNS", b"iCCP", b"eXIf", b"acTL", b"fcTL", b"fdAT", b"gAMA")
            )
            text = rng.choice(
                (b"", b"a\0\0" + zlib.compress(bytes(1 << 16)), b"Description\0\x1b[2J", rng.randbytes(30))
            )
            parts.insert(rng.randrange(len(parts) + 1), (other, text))
            continue
        elif way == 4:
            del parts[at]
            if not parts:
                return _SIGNATURE
            continue
        elif way == 5:
            parts.insert(at, parts[rng.randrange(len(parts))])
            continue
        else:
            content = damaged(content, rng)
        parts[at] = kind, content
    out = _SIGNATURE + b"".join(chunk(*each) for each in parts)
    return damaged(out, rng) if rng.random() < 0.1 else out


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """The chunks of a PNG file, kind and content, as far as there are whole ones."""
    found, at = [], len(_SIGNATURE)
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def _changed_head(content: bytes, rng: Random) -> bytes:
    if len(content) != 13:
        return damaged(content, rng)
    out = bytearray(content)
    if rng.random() < 0.5:
        at = rng.choice((0, 4))
        side = rng.choice((0, 1, 2, 7, 9, 12, 100, 65535, 1 << 30)) if rng.random() < 0.95 else interesting(rng, 4)
        out[at : at + 4] = struct.pack(">I", side)
    else:
        out[8 + rng.randrange(5)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, rng.randrange(256)))
    return bytes(out)


def changed_jpeg(rng: Random) -> bytes:
    data = bytearray(rng.choice(jpeg_originals()))
    markers = [at for at in range(len(data) - 1) if data[at] == 0xFF and data[at + 1] not in (0, 0xFF)]
    for _ in range(1 + rng.choice((0, 0, 1, 2))):
        kind = rng.randrange(6)
        at = rng.choice(markers)
        if kind == 0:
            data[at + 1 : at + 2] = bytes([rng.choice((0xC0, 0xC2, 0xC3, 0xC9, 0xD8, 0xD9, 0xDA, 0xE1, 0xEE, 0xFE))])
        elif kind == 1:
            data[at + 2 : at + 4] = interesting(rng, 2).to_bytes(2, "big")
        elif kind == 2:  # the size that the frame says
            frame = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
            if frame >= 0:
                field = frame + rng.choice((5, 7))
                side = rng.choice((0, 1, 7, 9, 100, 3000)) if rng.random() < 0.95 else interesting(rng, 2)
                data[field : field + 2] = side.to_bytes(2, "big")
        elif kind == 3:
            data[at + 2 + rng.randrange(12) : at + 2 + rng.randrange(14)] = rng.randbytes(rng.randrange(4))
        else:
            data = bytearray(damaged(bytes(data), rng))
        markers = [at for at in markers if at + 4 < len(data)] or [0]
    return bytes(data)


def changed_webp(rng: Random) -> bytes:
    data = bytearray(rng.choice(webp_originals()))
    for _ in range(1 + rng.choice((0, 0, 1))):
        kind = rng.randrange(6)
        if kind == 0:
            extended = b"VP8X" + struct.pack("<IB3x", 10, rng.randrange(64))
            extended += interesting(rng, 3).to_bytes(3, "little") + interesting(rng, 3).to_bytes(3, "little")
            data[12:12] = extended
        elif kind == 1:
            data[12:12] = rng.choice((b"ANIM", b"ICCP", b"EXIF", b"XMP ", b"ALPH")) + b"\6\0\0\0" + rng.randbytes(6)
        elif kind == 2 and len(data) > 30:  # the frame's own header
            at = 20 + rng.randrange(10)
            data[at] = rng.randrange(256)
        elif kind == 3:
            data[16:20] = struct.pack("<I", interesting(rng, 4))
        else:
            data = bytearray(damaged(bytes(data), rng))
    if len(data) > 8 and rng.random() < 0.8:
        data[4:8] = struct.pack("<I", len(data) - 8)
    return bytes(data)
