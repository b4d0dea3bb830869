"""Pictures: small good ones, and changes of PNG with its chunks' checksums made right, of JPEG, of WebP; other kinds
under their names."""

from __future__ import annotations

import io
import struct
import zlib
from functools import cache
from random import Random

import numpy as np
from PIL import Image

from tools.stress.hostile.changes import Files, Rules, damaged, interesting, with_number

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
_CHUNKS = (b"tEXt", b"zTXt", b"iTXt", b"PLTE", b"tRNS", b"iCCP", b"eXIf", b"acTL", b"fcTL", b"fdAT", b"gAMA")
_CONTENTS = (b"", b"a\0\0" + zlib.compress(bytes(1 << 16)), b"Description\0\x1b[2J", bytes(range(30)))
#: Of large pictures only some: those that are let through take their time.
_SIDES = (0, 1, 2, 7, 9, 12, 100, 65535, 1 << 30)


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """The chunks of a PNG file, kind and content, as far as there are whole ones."""
    found, at = [], len(_SIGNATURE)
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def png_of(width: int, height: int, pixels: bytes, *others: bytes) -> bytes:
    """A PNG file in colours from its rows, each with the number of its filter in front, and further chunks."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"".join((_SIGNATURE, head, *others, chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b"")))


@cache
def saved_as(mode: str, kind: str, *options: tuple[str, int | bytes | str]) -> bytes:
    """A good picture of 8 x 6 pixels."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4), np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).convert(mode).save(out, kind, **dict(options))
    return out.getvalue()


def png(rng: Random) -> Files:
    """Of 8 bits a channel."""
    return {"a.png": saved_as(rng.choice(("RGB", "RGBA", "L", "LA", "P", "1")), "PNG")}


def jpeg(rng: Random) -> Files:
    progressive = ("progressive", 1), ("quality", 30), ("comment", "a")
    kinds = [(mode, (("quality", quality),)) for mode, quality in (("RGB", 50), ("L", 20), ("CMYK", 20))]
    mode, options = rng.choice([*kinds, ("RGB", progressive)])
    return {"a.jpg": saved_as(mode, "JPEG", *options)}


def webp(rng: Random) -> Files:
    options = rng.choice(((("quality", 20),), (("lossless", 1),), (("lossless", 1), ("exif", b"Exif\0\0II*\0"))))
    return {"a.webp": saved_as(rng.choice(("RGB", "RGBA")), "WEBP", ("method", 0), *options)}


def _inside(name: str, content: bytes, rng: Random) -> bytes | None:
    """Other sides in the header; other bytes behind the coder of the pixels."""
    if name.endswith("IHDR") and len(content) == 13:
        at = rng.choice((0, 4))
        return content[:at] + rng.choice(_SIDES).to_bytes(4, "big") + content[at + 4 :]
    try:
        raw = damaged(zlib.decompress(content), rng) if name.endswith("IDAT") else None
    except zlib.error:
        return None
    return None if raw is None else zlib.compress(raw + bytes(rng.choice((0, 0, 1 << 16))))


_CHUNKS_OF = Rules(
    fields=lambda name, data: [(8 + k, 1) for k in range(5)] if name.endswith("IHDR") and len(data) == 13 else (),
    others=_inside,
    beside={f"{at}{kind.decode()}": _CONTENTS for at in "05" for kind in _CHUNKS},
)


def changed_png(files: Files, rng: Random) -> Files:
    """Parts are chunks, in the order of their names."""
    if rng.random() < 0.06:
        other = rng.choice(_OTHER_KINDS)
        return {"a.png": other if rng.random() < 0.5 else damaged(other, rng)}
    parts = {f"{at}{kind.decode()}": content for at, (kind, content) in enumerate(chunks(files["a.png"]))}
    made = _CHUNKS_OF.changed(parts, rng)
    out = _SIGNATURE + b"".join(chunk(name[1:].encode(), made[name]) for name in sorted(made))
    return {"a.png": damaged(out, rng) if rng.random() < 0.1 else out}


def _markers(_: str, data: bytes) -> list[tuple[int, int]]:
    """Kinds and lengths of a JPEG's segments, and the size that its frame says."""
    found = [at for at in range(len(data) - 4) if data[at] == 0xFF and data[at + 1] not in (0, 0xFF)]
    frame = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    places = [*((at + 1, 1) for at in found), *((at + 2, -2) for at in found), *[(frame + 5, -2), (frame + 7, -2)] * 4]
    return [(at, size) for at, size in places if 0 <= at < len(data) - 2]


JPEG = Rules(fields=_markers)


def changed_webp(files: Files, rng: Random) -> Files:
    data = files["a.webp"]
    kind = rng.randrange(5)
    if kind == 0:
        sizes = b"".join(interesting(rng, 3).to_bytes(3, "little") for _ in range(2))
        data = data[:12] + b"VP8X" + struct.pack("<IB3x", 10, rng.randrange(64)) + sizes + data[12:]
    elif kind == 1:
        name = rng.choice((b"ANIM", b"ICCP", b"EXIF", b"XMP ", b"ALPH"))
        data = data[:12] + name + b"\6\0\0\0" + rng.randbytes(6) + data[12:]
    elif kind == 2:  # the frame's size, and its own header
        data = with_number(data, rng, ((16, 4), *((20 + k, 1) for k in range(10))))
    if kind > 2 or rng.random() < 0.3:
        data = damaged(data, rng)
    sealed = len(data) > 8 and rng.random() < 0.8
    return {"a.webp": data[:4] + struct.pack("<I", len(data) - 8) + data[8:] if sealed else data}
