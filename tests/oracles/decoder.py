"""An independent decoder of .potr files, written from docs/format.md alone.

It is kept to prove that the page suffices to write a decoder; the package never uses it. It is plain and slow on
purpose: one loop for each sentence of the page, and Python integers, which cannot overflow.

python -m tests.oracles.decoder FILE.potr VALUES.npz     writes what a file yields, as the golden files' values are kept
"""

import json
import math
import re
import struct
import sys
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard

MAGIC = bytes.fromhex("504F54520D0A1A0A")
ZSTANDARD_MAGIC = bytes.fromhex("28B52FFD")
LARGEST_SINGLE = (2 - 2.0**-23) * 2.0**127
#: Sections of a block in their order, and how many streams those of splats have.
ORDER = ["OCCU", "SEVE", "MULT", "LEAF", "TAIL", "STEP", "OPAC", "SCAL", "ROTA", "SHC0", "SHC1", "SHC2", "SHC3"]
STREAMS = {"OPAC": 1, "SCAL": 3, "ROTA": 3, "SHC0": 3, "SHC1": 9, "SHC2": 15, "SHC3": 21}
ARRAYS = ("means", "scales", "quaternions", "opacities", "sh")


class Entry(NamedTuple):
    """A section in the table."""

    name: str
    stored: int
    size: int
    checksum: int


class Block(NamedTuple):
    """What the table says of a block, and what the header says of all."""

    level: int
    coder: int
    deepest: int
    splats: int
    box: tuple[float, ...]
    origin: tuple[float, ...]
    edge: float
    factors: tuple[float, ...]
    entries: list[Entry]
    degree: int
    quantiser: int


#: The contents of a block's sections, and the integers of its streams.
Sections = dict[str, bytes]
Integers = dict[str, list[list[int]]]


@dataclass
class Cell:
    """A cell of the octree; `splats` counts only in leaves."""

    level: int
    i: int
    j: int
    k: int
    crowded: bool = False
    splats: int = 1
    children: list["Cell"] = field(default_factory=list)

    def child(self, x: int, y: int, z: int) -> "Cell":
        """Make the child with the given coordinate bits."""
        return Cell(self.level + 1, 2 * self.i + x, 2 * self.j + y, 2 * self.k + z)


class Model(NamedTuple):
    """Contexts: thresholds of the expected size, and a row of frequencies for each context."""

    thresholds: list[int]
    frequencies: list[list[int]]


def decode(data: bytes, level: int = 0) -> dict[str, Any]:
    """Decode a level of a file; the arrays are float64 and in the format's order of splats.

    Keys: means (N, 3), scales (N, 3) linear, quaternions (N, 4) as w x y z, opacities (N,), sh (N, M, 3) as RGB,
    metadata, a dict, and how the scene is to be rendered: antialiased, a bool, and low_pass, square pixels. Raises
    ValueError for a file that breaks the format.
    """
    flags, own, blocks, start = read_header(data)
    contents, start = read_sections(data, own, ["meta"], start)
    parts = []
    for block in blocks:
        known = [name for name in ORDER if not name.startswith("SHC") or int(name[3]) <= block.degree]
        sections, start = read_sections(data, block.entries, known, start, block)
        if block.level == level:
            parts.append(decode_block(sections, block))
    check(start == len(data), "the sections do not fill the file")
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in ARRAYS},
        "metadata": metadata_object(contents.get("meta", b"{}")),
        "antialiased": flags > 0,
        "low_pass": 0.1 if flags == 3 else 0.3,
    }


# Container


def read_header(data: bytes) -> tuple[int, list[Entry], list[Block], int]:
    """Return the flags, the entries of the file's own sections, the blocks, and where the first section begins."""
    check(data[:8] == MAGIC, "not a .potr file: wrong magic")
    check(len(data) >= 36, "the file is shorter than the smallest header")
    version, flags, degree, size, file_size, count, quantiser, own_count, zero = struct.unpack_from(
        "<HBBIQIBBH", data, 8
    )
    check(version == 1, f"version {version} is not supported")
    check(36 <= size <= len(data) == file_size, "sizes of header and file")
    check(zlib.crc32(data[: size - 4]) == struct.unpack_from("<I", data, size - 4)[0], "the header's checksum is wrong")
    check(flags in (0, 1, 3) and degree <= 3 and quantiser <= 1 and zero == 0, "the header is invalid")
    check(count >= 1 and own_count <= 32, "number of blocks or sections")
    at = 32

    def take(form: str) -> tuple[Any, ...]:
        nonlocal at
        check(at + struct.calcsize(form) <= size - 4, "the table is longer than the header")
        at += struct.calcsize(form)
        return struct.unpack_from(form, data, at - struct.calcsize(form))

    def entries(number: int) -> list[Entry]:
        found = []
        for _ in range(number):
            name, stored, content, checksum = take("<4sIII")
            check(re.fullmatch(rb"[A-Za-z][A-Za-z0-9]{3}", name) is not None, "a name that is none")
            check(content <= stored * 2**15, "impossible size of a content")
            found.append(Entry(name.decode(), stored, content, checksum))
        return found

    own = entries(own_count)
    blocks: list[Block] = []
    for _ in range(count):
        level, coder, deepest, sections, splats = take("<BBBBI")
        numbers = take("<10fd5f")
        box, origin, error, edge, factors = numbers[:6], numbers[6:9], numbers[9], numbers[10], numbers[11:]
        check(coder == 0 or (coder == 1 and quantiser == 1), f"coder {coder}")
        check(deepest <= 52 and sections <= 32 and 1 <= splats <= 2**22, "a block is invalid")
        check(all(map(math.isfinite, (*box, *origin, error, edge))), "a number of a block is out of range")
        check(all(low <= high for low, high in zip(box, box[3:], strict=False)), "a box ends before it begins")
        check(0 <= edge <= 2 * LARGEST_SINGLE and error >= 0, "edge or error out of range")
        check(all(np.float32(0.001) <= factor <= 1e9 for factor in factors), "a scale factor is out of range")
        check(not blocks or 0 <= blocks[-1].level - level <= 1, "levels rise, or fall by more than one")
        block = Block(level, coder, deepest, splats, box, origin, edge, factors, entries(sections), degree, quantiser)
        blocks.append(block)
    check(at == size - 4, "the table does not fill the header")
    check(blocks[-1].level == 0, "the finest level is not there")
    check(count <= 16 + sum(block.splats for block in blocks) // 16384, "too many blocks")
    return flags, own, blocks, size


def read_sections(
    data: bytes, entries: list[Entry], known: list[str], start: int, block: Block | None = None
) -> tuple[Sections, int]:
    """Return the contents of the sections that are known, and where the stored bytes of the last one end."""
    sections: Sections = {}
    place = 0
    for name, stored_size, size, checksum in entries:
        stored = data[start : start + stored_size]
        start += stored_size
        check(start <= len(data), f"{name} reaches beyond the end of the file")
        if name not in known:
            check(name[0].islower(), f"a section {name}, which is required and unknown")
            continue
        check(name in known[place:], f"{name} stands twice, or not in its place")
        place = known.index(name) + 1
        check(zlib.crc32(stored) == checksum, f"{name}: wrong checksum")
        check(name != "meta" or size <= 65536, "more than 65536 bytes of metadata")
        in_bundles = block is not None and block.coder == 1 and name in STREAMS
        check(not in_bundles or size == stored_size, f"{name} is of bundles and not stored as it is")
        if block is not None and not in_bundles:
            check(size <= largest(name, block, len(sections.get("OCCU", b""))), f"{name} is too long")
        sections[name] = stored if size == stored_size else undo_zstandard(stored, size, name)
    check(block is None or "OPAC" in sections, "the opacity section is absent")
    return sections, start


def largest(name: str, block: Block, occupancy: int) -> int:
    """Return the most bytes that a content may have."""
    splats, deepest = block.splats, block.deepest
    return {
        "OCCU": splats * deepest,
        "SEVE": bytes_for_bits(splats + occupancy),
        "MULT": 4 * (splats // 2),
        "LEAF": splats,
        "TAIL": 3 * deepest * bytes_for_bits(splats),
        "STEP": 50 + splats if block.quantiser == 1 else 0,
    }.get(name, STREAMS.get(name, 0) * (1 + 7 * splats))


def undo_zstandard(stored: bytes, size: int, name: str) -> bytes:
    """Decompress one Zstandard frame that names its content size."""
    # A skippable frame is not one that holds content, but the library takes it for an empty one.
    check(stored[:4] == ZSTANDARD_MAGIC, f"{name} is not a Zstandard frame")
    try:
        check(zstandard.frame_content_size(stored) == size, f"{name}: the Zstandard frame names another size")
        # The page sets no limit to the window, so the library's smaller default must not.
        decompressor = zstandard.ZstdDecompressor(max_window_size=2**31).decompressobj()
        raw = decompressor.decompress(stored)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: broken Zstandard frame: {error}") from error
    check(decompressor.eof, f"{name}: the Zstandard frame is cut off")
    check(not decompressor.unused_data, f"{name}: bytes after the Zstandard frame")
    check(len(raw) == size, f"{name} yields another size")
    return raw


def metadata_object(raw: bytes) -> dict[str, Any]:
    """Parse the bytes of metadata."""
    try:
        metadata = json.loads(raw.decode("utf-8"), parse_constant=reject, parse_float=finite, parse_int=of_64_bits)
        # Python takes half of a surrogate pair for a character, but cannot write it as UTF-8.
        json.dumps(metadata, ensure_ascii=False).encode("utf-8")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the metadata is not JSON in UTF-8: {error}") from error
    if not isinstance(metadata, dict):
        raise ValueError("the metadata is not a JSON object")
    return metadata


def reject(text: str) -> None:
    """Refuse the constants that only Python's JSON has."""
    raise ValueError(f"{text} is no JSON")


def finite(text: str) -> float:
    """Return a number with a point or an exponent."""
    check(math.isfinite(float(text)), "a number is not finite")
    return float(text)


def of_64_bits(text: str) -> int:
    """Return a whole number."""
    check(-(2**63) < int(text) < 2**63, "a whole number has more than 64 bits")
    return int(text)


# Integers


def decode_block(sections: Sections, block: Block) -> dict[str, Any]:
    """Return the arrays of a block."""
    from tests.oracles import bundles

    coded = {name: content for name, content in sections.items() if name in STREAMS}
    if block.coder == 1:
        integers = bundles.decode_bundles(coded, sections, block)
    else:
        integers = {name: plain_streams(name, content, block.splats) for name, content in coded.items()}
    for name, streams in STREAMS.items():
        integers.setdefault(name, [[0] * block.splats for _ in range(streams)])
    classes = decode_classes(sections, integers, block)
    if block.coder == 1:
        integers["SHC0"] = [undo_prediction(stream, classes[0]) for stream in integers["SHC0"]]
    else:
        integers["SHC0"] = [running_sums(stream) for stream in integers["SHC0"]]
    means = decode_means(sections, block)
    singles = means.astype(np.float32)
    low, high = np.array(block.box[:3], np.float32), np.array(block.box[3:], np.float32)
    check(bool(((singles >= low) & (singles <= high)).all()), "a centre outside of its block's box")
    return {
        "means": means,
        "scales": np.array([[max(x, 0.25) / block.factors[0] for x in axis] for axis in integers["SCAL"]]).T,
        "quaternions": decode_quaternions(integers, block),
        "opacities": np.array([opacity(x, block) for x in integers["OPAC"][0]]),
        "sh": decode_sh(integers, classes, block),
    }


def plain_streams(name: str, content: bytes, splats: int) -> list[list[int]]:
    """Return the integers of plain streams, of DC the differences."""
    count = STREAMS[name]
    check(len(content) >= count, f"{name} is shorter than its streams' widths")
    widths = content[:count]
    check(max(widths) <= 7, f"{name}: an integer of more than 7 bytes")
    check(len(content) == count + splats * sum(widths), f"{name} does not hold an integer of each splat")
    streams = []
    at = count
    for width in widths:
        values = []
        for n in range(splats):
            u = sum(content[at + p * splats + n] << (8 * p) for p in range(width))
            values.append(u if name in ("OPAC", "SCAL") else signed_of(u))
        at += width * splats
        streams.append(values)
    return streams


def signed_of(u: int) -> int:
    """Undo the mapping of signed integers."""
    return u // 2 if u % 2 == 0 else -(u + 1) // 2


def get_bit(data: bytes, position: int) -> int:
    """Return one bit of a byte stream."""
    return (data[position // 8] >> (position % 8)) & 1


def bytes_for_bits(bits: int) -> int:
    """Return the number of whole bytes that hold so many bits."""
    return (bits + 7) // 8


def check_padding(data: bytes, bits: int, name: str) -> None:
    """Check that the bits of the last byte after so many bits are zero."""
    for position in range(bits, 8 * len(data)):
        check(get_bit(data, position) == 0, f"{name}: a padding bit is not zero")


def read_models_of(raw: bytes, at: int, alphabets: list[int]) -> list[Model]:
    """Return the models that fill a description from some place on; each has at most so many tokens."""
    models = []
    for most in alphabets:
        check(len(raw) >= at + 2, "a description is too short")
        contexts, alphabet = raw[at], raw[at + 1]
        at += 2
        check(1 <= contexts <= 32 and 1 <= alphabet <= most, "impossible contexts")
        check(len(raw) >= at + contexts - 1 + 2 * contexts * alphabet, "a description is too short")
        thresholds = list(raw[at : at + contexts - 1])
        at += contexts - 1
        check(all(a < b for a, b in zip([0, *thresholds], thresholds, strict=False)), "thresholds do not rise")
        rows = []
        for context in range(contexts):
            row = []
            for token in range(alphabet):
                low = raw[at + token * contexts + context]
                high = raw[at + contexts * alphabet + token * contexts + context]
                row.append(low + 256 * high)
            check(sum(row) == 4096, "frequencies do not add up")
            rows.append(row)
        at += 2 * contexts * alphabet
        models.append(Model(thresholds, rows))
    check(at == len(raw), "a description is too long")
    return models


def extra_bits(token: int) -> int:
    """Return how many bits are stored beside a token."""
    return 0 if token < 128 else 5 + (token - 128) // 4


def least_of_token(token: int) -> int:
    """Return the least integer of a token."""
    return token if token < 128 else (4 + token % 4) << extra_bits(token)


def token_size(token: int, signed: bool) -> int:
    """Return the size of a token's integers."""
    magnitude = least_of_token(token)
    if signed:
        magnitude = (magnitude + 1) // 2
    return math.floor(16 * math.log2(1 + magnitude) + 0.5)


# Positions


def decode_means(sections: Sections, block: Block) -> np.ndarray:
    """Return the centres of all splats."""
    root = read_tree(sections, block)
    leaves: list[Cell] = []
    collect_leaves(root, leaves)
    total = sum(leaf.splats for leaf in leaves)
    check(total == block.splats, f"the tree holds {total} splats instead of {block.splats}")
    follow_tails(sections, block, [leaf for leaf in leaves if not leaf.crowded])
    means = []
    for leaf in leaves:
        for _ in range(leaf.splats):
            means.append(centre(leaf, block))
    with np.errstate(over="ignore"):
        singles = np.array(means).astype(np.float32)
    check(bool(np.isfinite(singles).all()), "a centre is out of range")
    return np.array(means, dtype=np.float64).reshape(block.splats, 3)


def read_tree(sections: Sections, block: Block) -> Cell:
    """Read the octree level by level and return its root."""
    occupancy = sections.get("OCCU", b"")
    several = sections.get("SEVE", b"")
    counts = sections.get("MULT", b"")
    check(len(counts) % 4 == 0, "multiplicity is not a whole number of integers")
    multiplicity = struct.unpack(f"<{len(counts) // 4}I", counts)

    root = Cell(0, 0, 0, 0, crowded=len(occupancy) > 0 or len(multiplicity) > 0)
    cells = [root]
    occupancy_read = 0
    several_read = 0
    for _ in range(block.deepest):
        next_cells = []
        for cell in cells:
            if not cell.crowded:
                continue
            check(occupancy_read < len(occupancy), "occupancy is shorter than the tree asks for")
            byte = occupancy[occupancy_read]
            occupancy_read += 1
            check(byte != 0, "an occupancy byte is zero")
            for number in range(8):
                if (byte >> number) & 1:
                    cell.children.append(cell.child(number & 1, (number >> 1) & 1, (number >> 2) & 1))
            next_cells.extend(cell.children)
        for cell in next_cells:
            check(several_read < 8 * len(several), "several is shorter than the tree asks for")
            cell.crowded = get_bit(several, several_read) == 1
            several_read += 1
        cells = next_cells

    multiplicity_read = 0
    for cell in cells:
        if cell.crowded:
            check(multiplicity_read < len(multiplicity), "multiplicity is shorter than the tree asks for")
            cell.splats = multiplicity[multiplicity_read]
            multiplicity_read += 1
            check(cell.splats >= 2, "a multiplicity is below 2")

    check(occupancy_read == len(occupancy), "occupancy is longer than the tree asks for")
    check(bytes_for_bits(several_read) == len(several), "several is longer than the tree asks for")
    check_padding(several, several_read, "several")
    check(multiplicity_read == len(multiplicity), "multiplicity is longer than the tree asks for")
    return root


def collect_leaves(cell: Cell, leaves: list[Cell]) -> None:
    """Append the leaves of a cell in depth-first order, which is the order of splats."""
    if not cell.children:
        leaves.append(cell)
    for child in cell.children:
        collect_leaves(child, leaves)


def follow_tails(sections: Sections, block: Block, lone: list[Cell]) -> None:
    """Move each lone splat's leaf down to the cell where its tail ends."""
    levels = sections.get("LEAF", b"")
    tail = sections.get("TAIL", b"")
    check(len(levels) == len(lone), f"leaf level has {len(levels)} bytes for {len(lone)} lone splats")
    check(max(levels, default=0) <= block.deepest, "a leaf's level is below the deepest one")
    lengths = [max(level - leaf.level, 0) for level, leaf in zip(levels, lone, strict=True)]

    order = sorted(range(len(lone)), key=lambda n: -lengths[n])
    longest = max(lengths, default=0)
    start = 0
    for step in range(1, longest + 1):
        moving = [lone[n] for n in order if lengths[n] >= step]
        plane_size = bytes_for_bits(len(moving))
        planes = []
        for _ in range(3):
            plane = tail[start : start + plane_size]
            start += plane_size
            check(len(plane) == plane_size, "tail is shorter than the tree asks for")
            check_padding(plane, len(moving), "tail")
            planes.append(plane)
        for position, leaf in enumerate(moving):
            leaf.level += 1
            leaf.i = 2 * leaf.i + get_bit(planes[0], position)
            leaf.j = 2 * leaf.j + get_bit(planes[1], position)
            leaf.k = 2 * leaf.k + get_bit(planes[2], position)
    check(start == len(tail), "tail is longer than the tree asks for")


def centre(cell: Cell, block: Block) -> tuple[float, float, float]:
    """Return the centre of a cell in world units."""
    edge = block.edge * 2.0**-cell.level
    x, y, z = block.origin
    return x + (cell.i + 0.5) * edge, y + (cell.j + 0.5) * edge, z + (cell.k + 0.5) * edge


# Values


def opacity(x: int, block: Block) -> float:
    """Return an opacity."""
    if block.quantiser == 0:
        return min(1.0, (x + 0.25) / block.factors[2])
    return 1 / (1 + math.exp(-(x / block.factors[2] - 8)))


def decode_quaternions(integers: Integers, block: Block) -> np.ndarray:
    """Return the rotations as w x y z."""
    quaternions = np.zeros((block.splats, 4), dtype=np.float64)
    for n in range(block.splats):
        factor = block.factors[1]
        if block.quantiser == 1:
            factor *= math.sqrt(max(1, *(axis[n] for axis in integers["SCAL"])))
        x, y, z = (stream[n] / factor for stream in integers["ROTA"])
        quaternions[n] = (math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z)), x, y, z)
    return quaternions


def decode_sh(integers: Integers, classes: tuple[list[int], list[int]], block: Block) -> np.ndarray:
    """Return the spherical harmonics coefficients as RGB."""
    sh = np.zeros((block.splats, (block.degree + 1) ** 2, 3), dtype=np.float64)
    for degree in range(block.degree + 1):
        factor = block.factors[3 if degree == 0 else 4]
        own = classes[0 if degree == 0 else 1]
        streams = integers[f"SHC{degree}"]
        for number in range(2 * degree + 1):
            for n in range(block.splats):
                luma, orange, green = (stream[n] for stream in streams[3 * number : 3 * number + 3])
                own_factor = factor * 2.0 ** (own[n] / 4)
                sh[n, degree**2 + number, 0] = wrapped(luma + orange - green) / own_factor
                sh[n, degree**2 + number, 1] = wrapped(luma + green) / own_factor
                sh[n, degree**2 + number, 2] = wrapped(luma - orange - green) / own_factor
    return sh


def decode_classes(sections: Sections, integers: Integers, block: Block) -> tuple[list[int], list[int]]:
    """Return the classes of each splat's steps, of DC and of AC."""
    if "STEP" not in sections:
        return [0] * block.splats, [0] * block.splats
    raw = sections["STEP"]
    check(len(raw) >= 50, "steps is too short")
    g, h, j, dc_power, ac_power, zero, dc_offset, ac_offset, w1, w2, w3, *t = struct.unpack_from("<6B2h3h17h", raw)
    check(g <= 40 and h <= 40 and zero == 0, "impossible steps")
    check(len(raw) == 50 + -(-block.splats // 2**g), "steps does not have a byte for each group")
    groups = struct.unpack_from(f"<{len(raw) - 50}b", raw, 50)
    classes: tuple[list[int], list[int]] = ([], [])
    for n in range(block.splats):
        a1, a2, a3 = sorted((scale_logarithm(axis[n]) for axis in integers["SCAL"]), reverse=True)
        o = min(max(integers["OPAC"][0][n] - 2**h * j, 0), 2**h * 16 - 1)
        p = o >> h
        r = o - 2**h * p
        z = ((w1 * a1 + w2 * a2 + w3 * a3) >> 8) + t[p] + ((r * (t[p + 1] - t[p])) >> h) + 8 * groups[n // 2**g]
        for own, power, offset in zip(classes, (dc_power, ac_power), (dc_offset, ac_offset), strict=True):
            own.append(min(max((power * z + offset) >> 6, -32), 31))
    return classes


def scale_logarithm(x: int) -> int:
    """Return the logarithm of an integer of scale."""
    v = max(1, 4 * min(x, 2**32 - 1))
    i = v.bit_length() - 1
    return 16 * i + 16 * (v - 2**i) // 2**i


def undo_prediction(differences: list[int], classes: list[int]) -> list[int]:
    """Return the values of DC of one channel."""
    values: list[int] = []
    for n, difference in enumerate(differences):
        total = 0
        for k in range(1, 5):
            if n % 256 - k >= 0:
                total = wrapped(total + values[n - k] * step_of_class(-classes[n - k]))
        product = wrapped(step_of_class(classes[n]) * total + 2**33)
        values.append(wrapped(difference + (product >> 34)))
    return values


def step_of_class(k: int) -> int:
    """Return 2 to the power of k / 4 with 16 bits behind the point."""
    return math.floor((65536, 77936, 92682, 110218)[k % 4] * 2.0 ** (k // 4))


def running_sums(differences: list[int]) -> list[int]:
    """Undo the differences: each value is the sum of all up to and including it."""
    total = 0
    sums = []
    for difference in differences:
        total = wrapped(total + difference)
        sums.append(total)
    return sums


def wrapped(value: int) -> int:
    """Return what is left of an integer in signed 64 bits that wrap round."""
    return (value + 2**63) % 2**64 - 2**63


def check(condition: bool, message: str) -> None:
    """Raise ValueError with the message unless the condition holds."""
    if not condition:
        raise ValueError(message)


def main() -> None:
    """Write the arrays that a file yields."""
    source, values = map(Path, sys.argv[1:])
    decoded = decode(source.read_bytes())
    np.savez_compressed(values, **{name: value for name, value in decoded.items() if isinstance(value, np.ndarray)})


if __name__ == "__main__":
    main()
