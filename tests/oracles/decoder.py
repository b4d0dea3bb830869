"""An independent decoder of .potr files, written from docs/format.md alone.

It is kept to prove that the page suffices to write a decoder; the package never uses it. It is plain and slow on
purpose: one loop for each sentence of the page, and Python integers, which cannot overflow.

python -m tests.oracles.decoder FILE.potr VALUES.npz     writes what a file yields, as the golden files' values are kept
"""

import json
import math
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
FIXED_HEADER = 120
ENTRY_SIZE = 24

METADATA = 0
OCCUPANCY = 1
SEVERAL = 2
MULTIPLICITY = 3
TAIL_LENGTH = 4
TAIL = 5
STEPS = 6
SCALE = 16
ROTATION = 17
OPACITY = 18
SH = 19

BYTE_STREAMS = (METADATA, OCCUPANCY, SEVERAL, TAIL_LENGTH, TAIL, STEPS)
ONE_INTEGER_A_SPLAT = (SCALE, ROTATION, OPACITY, SH)

STORED = 0
ZSTANDARD = 1
ZLIB = 2
CONTEXT = 3
BUNDLES = 4
LARGEST_SINGLE = (2 - 2.0**-23) * 2.0**127
LARGEST_EXPANSION = {STORED: 1, ZSTANDARD: 2**15, ZLIB: 1032, CONTEXT: 2**15, BUNDLES: 2**16}


class Header(NamedTuple):
    """The numbers of the fixed part of the header that decoding needs."""

    version: int
    size: int
    splats: int
    coefficients: int
    deepest: int
    sections: int
    origin: tuple[float, float, float]
    edge: float
    scale_factors: dict[int, float]
    sh_factors: tuple[float, float]
    antialiased: bool
    low_pass: float


class Section(NamedTuple):
    """One section after undoing its coder: its bytes, or with the context coder the integers of its streams."""

    planes: int
    raw: bytes
    streams: list[list[int]] | None = None


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


Sections = dict[tuple[int, int], Section]

#: Property, first index and number of streams of the sections that the context coder can have.
CONTEXT_SECTIONS = (
    (SCALE, 0, 3),
    (ROTATION, 0, 3),
    (OPACITY, 0, 1),
    (SH, 0, 3),
    (SH, 3, 9),
    (SH, 12, 15),
    (SH, 27, 21),
)


def decode(data: bytes) -> dict[str, Any]:
    """Decode a file; the arrays are float64 and in the format's order of splats.

    Keys: means (N, 3), scales (N, 3) linear, quaternions (N, 4) as w x y z, opacities (N,), sh (N, M, 3) as RGB,
    metadata, a dict, and how the scene is to be rendered: antialiased, a bool, and low_pass, square pixels. Raises
    ValueError for a file that breaks the format.
    """
    if data[:8] == MAGIC and data[8:10] == bytes([4, 0]):
        return decode_blocks(data)
    header = read_header(data)
    sections = read_sections(data, header)
    return {
        "means": decode_means(sections, header),
        "scales": decode_scales(sections, header),
        "quaternions": decode_quaternions(sections, header),
        "opacities": decode_opacities(sections, header),
        "sh": decode_sh(sections, header),
        "metadata": decode_metadata(sections),
        "antialiased": header.antialiased,
        "low_pass": header.low_pass,
    }


# Container


def decode_blocks(data: bytes) -> dict[str, Any]:
    """Decode a file of blocks: version 4."""
    check(len(data) >= 48, "truncated header")
    flags, size, whole, splats, degree = struct.unpack_from("<HIQQB", data, 10)
    count, metadata_size, zero = struct.unpack_from("<III", data, 36)
    check(data[33:36] == bytes(3) and zero == 0, "reserved bytes are not zero")
    check(flags in (0, 1, 3) and degree <= 3 and count >= 1, "flags, degree or number of blocks")
    check(metadata_size <= 65536 and size == 48 + 48 * count + metadata_size + 4, "size of the header")
    check(whole == len(data) and size <= whole, "size of the file")
    check(struct.unpack_from("<I", data, size - 4)[0] == zlib.crc32(data[: size - 4]), "checksum of the header")
    parts = []
    start = size
    for block in range(count):
        box = struct.unpack_from("<6f", data, 48 + 48 * block)
        own, nbytes, crc, zero = struct.unpack_from("<QQII", data, 48 + 48 * block + 24)
        check(all(map(math.isfinite, box)) and box[0] <= box[3] and box[1] <= box[4] and box[2] <= box[5], "box")
        check(own >= 1 and zero == 0 and start + nbytes <= whole, "entry of the table")
        stored = data[start : start + nbytes]
        check(zlib.crc32(stored) == crc, "checksum of a block")
        header = read_header(stored)
        check(header.version == 3, "version of a block")
        check(header.splats == own and header.coefficients == (degree + 1) ** 2, "splats or degree of a block")
        check(struct.unpack_from("<H", stored, 10)[0] == flags, "flags of a block")
        part = decode(stored)
        centres = part["means"].astype(np.float32)
        low, high = np.float32(box[:3]), np.float32(box[3:])
        check(bool(((centres >= low) & (centres <= high)).all()), "a centre outside of its block's box")
        parts.append(part)
        start += nbytes
    check(start == whole, "blocks do not fill the file")
    check(sum(len(part["means"]) for part in parts) == splats, "number of splats")
    names = ("means", "scales", "quaternions", "opacities", "sh")
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in names},
        "metadata": metadata_object(data[size - 4 - metadata_size : size - 4]),
        "antialiased": parts[0]["antialiased"],
        "low_pass": parts[0]["low_pass"],
    }


def read_header(data: bytes) -> Header:
    """Read and check the header, except for the section table."""
    check(data[:8] == MAGIC, "not a .potr file: wrong magic")
    check(len(data) >= FIXED_HEADER + 4, "the file is shorter than the smallest header")
    version, flags, header_size, file_size, splats = struct.unpack_from("<HHIQQ", data, 8)
    degree, deepest, section_count = struct.unpack_from("<BBH", data, 32)
    origin = struct.unpack_from("<3d", data, 40)
    (edge,) = struct.unpack_from("<d", data, 64)
    scale_factors = struct.unpack_from("<4d", data, 72)

    check(version in (1, 2, 3), f"version {version} is not supported, only 1 to 3")
    check(file_size == len(data), f"the file has {len(data)} bytes, but its header says {file_size}")
    check(header_size == 124 + ENTRY_SIZE * section_count, "the header's size does not fit the number of sections")
    check(header_size <= len(data), "the file ends within the header")
    (checksum,) = struct.unpack_from("<I", data, header_size - 4)
    check(zlib.crc32(data[: header_size - 4]) == checksum, "the header's checksum is wrong")

    check(flags in (0, 1, 3), f"unknown flags {flags}")
    check(data[36:40] == bytes(4), "bytes 36 to 39 are not zero")
    ac_factor = scale_factors[3]
    if version == 1:
        check(data[104:112] == bytes(8), "the reserved bytes 104 to 111 are not zero")
    else:
        (ac_factor,) = struct.unpack_from("<d", data, 104)
    check(data[112:120] == bytes(8), "the reserved bytes 112 to 119 are not zero")
    check(splats >= 1, "the file holds no splats")
    check(degree <= 3, f"SH degree {degree} is above 3")
    check(deepest <= 52, f"deepest octree level {deepest} is above 52")
    check(all(abs(value) <= LARGEST_SINGLE for value in origin), "the origin of the root cube is out of range")
    check(0 <= edge <= 2 * LARGEST_SINGLE, "the edge of the root cube is out of range")
    for factor in (*scale_factors, ac_factor):
        check(0.001 <= factor <= 1e9, f"scale factor {factor} is not within 0.001 to 10^9")

    return Header(
        version=version,
        size=header_size,
        splats=splats,
        coefficients=(degree + 1) ** 2,
        deepest=deepest,
        sections=section_count,
        origin=origin,
        edge=edge,
        scale_factors=dict(zip((SCALE, ROTATION, OPACITY), scale_factors[:3], strict=True)),
        sh_factors=(scale_factors[3], ac_factor),
        antialiased=flags % 2 == 1,
        low_pass=0.1 if flags == 3 else 0.3,
    )


def read_sections(data: bytes, header: Header) -> Sections:
    """Check the section table and undo the coders."""
    number_of_indices = {
        METADATA: 1,
        OCCUPANCY: 1,
        SEVERAL: 1,
        MULTIPLICITY: 1,
        TAIL_LENGTH: 1,
        TAIL: 1,
        SCALE: 3,
        ROTATION: 3,
        OPACITY: 1,
        SH: 3 * header.coefficients,
    }
    if header.version == 3:
        number_of_indices[STEPS] = 1
    sections: Sections = {}
    coded: dict[tuple[int, int], bytes] = {}
    bundled: set[bool] = set()
    start = header.size
    for number in range(header.sections):
        entry = struct.unpack_from("<BBBBIQQ", data, FIXED_HEADER + ENTRY_SIZE * number)
        prop, index, coder, planes, checksum, raw_size, stored_size = entry
        name = f"section (property {prop}, index {index})"

        check(prop in number_of_indices, f"{name}: unknown property")
        check(index < number_of_indices[prop], f"{name}: unknown index")
        check((prop, index) not in sections, f"{name} stands twice")
        check(coder in LARGEST_EXPANSION, f"{name}: coder {coder}")
        check(coder != CONTEXT or header.version == 2, f"{name}: coder {coder}")
        check(coder != BUNDLES or header.version == 3, f"{name}: coder {coder}")
        if coder in (CONTEXT, BUNDLES):
            check((prop, index, planes) in CONTEXT_SECTIONS, f"{name}: the context coder has no such section")
            check(index + planes <= number_of_indices[prop], f"{name}: more streams than the property has")
            check(not any((prop, index + k) in sections for k in range(planes)), f"{name} stands twice")
        else:
            check(1 <= planes <= 8, f"{name}: {planes} planes")
        if prop in BYTE_STREAMS:
            check(planes == 1, f"{name}: {planes} planes instead of 1")
        if prop in ONE_INTEGER_A_SPLAT:
            check(raw_size == header.splats * planes, f"{name}: raw size {raw_size} is not splats times planes")
        if prop == METADATA:
            check(raw_size <= 65536, f"{name}: more than 65536 bytes of metadata")
        check(stored_size <= len(data) - start, f"{name} reaches beyond the end of the file")
        check(raw_size <= LARGEST_EXPANSION[coder] * stored_size, f"{name}: impossible raw size {raw_size}")

        stored = data[start : start + stored_size]
        start += stored_size
        check(zlib.crc32(stored) == checksum, f"{name}: wrong checksum")
        if prop in ONE_INTEGER_A_SPLAT:
            bundled.add(coder == BUNDLES)
        if coder in (CONTEXT, BUNDLES):
            for k in range(planes):
                sections[prop, index + k] = Section(planes, b"", [])
            coded[prop, index] = stored
        else:
            sections[prop, index] = Section(planes, undo_coder(coder, stored, raw_size, name))

    check(start == len(data), "the sections do not fill the file")
    check_octree_sizes(sections, header)
    # It also bounds the number of splats by the size of the file, before anything is made for each splat.
    check((OPACITY, 0) in sections, "the opacity section is absent")
    check(len(bundled) == 1, "only some sections of splats are of coder 4")
    if True in bundled:
        undo_bundles(coded, sections, header)
    else:
        undo_context_coder(coded, sections, header)
    return sections


def check_octree_sizes(sections: Sections, header: Header) -> None:
    """Check that the streams of the octree are not longer than the number of splats allows."""
    occupancy, several, tail_length, tail = (
        len(raw_bytes(sections, prop)) for prop in (OCCUPANCY, SEVERAL, TAIL_LENGTH, TAIL)
    )
    check(occupancy <= header.splats * header.deepest, "too much occupancy")
    check(several <= bytes_for_bits(header.splats + occupancy), "too much of several")
    check(tail_length <= header.splats, "too many tail lengths")
    check(tail <= 3 * header.deepest * bytes_for_bits(header.splats), "too much tail")
    if (MULTIPLICITY, 0) in sections:
        check(len(unsigned_integers(sections[MULTIPLICITY, 0])) <= header.splats / 2, "too many multiplicities")


def undo_context_coder(coded: dict[tuple[int, int], bytes], sections: Sections, header: Header) -> None:
    """Decode the sections of the context coder; AC coefficients in the order of their indices."""
    splats = header.splats
    ac_history = History(splats)
    for prop, index in sorted(coded):
        history = ac_history if prop == SH and index > 0 else History(splats)
        streams = decode_context_section(
            coded[prop, index],
            splats,
            count=sections[prop, index].planes,
            signed=prop in (ROTATION, SH),
            predicted=prop == SH and index == 0,
            history=history,
        )
        for k, stream in enumerate(streams):
            sections[prop, index + k] = Section(0, b"", [stream])


def undo_bundles(coded: dict[tuple[int, int], bytes], sections: Sections, header: Header) -> None:
    """Decode the sections of coder 4."""
    from tests.oracles import bundles

    for (prop, index), integers in bundles.decode_bundles(coded, sections, header).items():
        sections[prop, index] = Section(0, b"", [integers])


def undo_coder(coder: int, stored: bytes, raw_size: int, name: str) -> bytes:
    """Return the raw bytes of a section."""
    if coder == STORED:
        raw = stored
    elif coder == ZSTANDARD:
        raw = undo_zstandard(stored, raw_size, name)
    else:
        raw = undo_zlib(stored, raw_size, name)
    check(len(raw) == raw_size, f"{name} yields {len(raw)} bytes instead of {raw_size}")
    return raw


def undo_zstandard(stored: bytes, raw_size: int, name: str) -> bytes:
    """Decompress one Zstandard frame that names its content size."""
    # A skippable frame is not one that holds content, but the library takes it for an empty one.
    check(stored[:4] == ZSTANDARD_MAGIC, f"{name} is not a Zstandard frame")
    try:
        check(zstandard.frame_content_size(stored) == raw_size, f"{name}: the Zstandard frame names another size")
        # The page sets no limit to the window, so the library's smaller default must not.
        decompressor = zstandard.ZstdDecompressor(max_window_size=2**31).decompressobj()
        raw = decompressor.decompress(stored)
    except zstandard.ZstdError as error:
        raise ValueError(f"{name}: broken Zstandard frame: {error}") from error
    check(decompressor.eof, f"{name}: the Zstandard frame is cut off")
    check(not decompressor.unused_data, f"{name}: bytes after the Zstandard frame")
    return raw


def undo_zlib(stored: bytes, raw_size: int, name: str) -> bytes:
    """Decompress one zlib stream."""
    decompressor = zlib.decompressobj()
    try:
        # One byte more than allowed shows a stream that is too long; the library reads a limit of 0 as none.
        raw = decompressor.decompress(stored, raw_size + 1)
    except zlib.error as error:
        raise ValueError(f"{name}: broken zlib stream: {error}") from error
    check(decompressor.eof, f"{name}: the zlib stream does not end with its raw size")
    check(not decompressor.unused_data, f"{name}: bytes after the zlib stream")
    return raw


def decode_metadata(sections: Sections) -> dict[str, Any]:
    """Parse the metadata."""
    return metadata_object(raw_bytes(sections, METADATA))


def metadata_object(raw: bytes) -> dict[str, Any]:
    """Parse the bytes of metadata."""
    if not raw:
        return {}
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


def raw_bytes(sections: Sections, prop: int) -> bytes:
    """Return the raw bytes of a property with a single index, empty if it is absent."""
    if (prop, 0) not in sections:
        return b""
    return sections[prop, 0].raw


def unsigned_integers(section: Section) -> list[int]:
    """Put the integers together from their byte planes."""
    count, remainder = divmod(len(section.raw), section.planes)
    check(remainder == 0, "a section is not a whole number of integers")
    values = []
    for n in range(count):
        value = 0
        for plane in range(section.planes):
            value += section.raw[plane * count + n] << (8 * plane)
        values.append(value)
    return values


def unsigned_stream(sections: Sections, prop: int, index: int, splats: int) -> list[int]:
    """Return one unsigned integer a splat."""
    if (prop, index) not in sections:
        return [0] * splats
    streams = sections[prop, index].streams
    if streams is not None:
        return streams[0]
    return unsigned_integers(sections[prop, index])


def signed_stream(sections: Sections, prop: int, index: int, splats: int) -> list[int]:
    """Return one signed integer a splat."""
    if (prop, index) in sections and sections[prop, index].streams is not None:
        return unsigned_stream(sections, prop, index, splats)
    values = []
    for u in unsigned_stream(sections, prop, index, splats):
        if u % 2 == 0:
            values.append(u // 2)
        else:
            values.append(-(u + 1) // 2)
    return values


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


# Context coder


class History:
    """The sizes of earlier streams: sums by channel, and of the channels before of the same coefficient."""

    def __init__(self, splats: int) -> None:
        self.sums = [[0] * splats for _ in range(3)]
        self.same: list[list[int]] = []

    def add(self, sizes: list[int]) -> None:
        """Take in the sizes of the next stream."""
        self.same.append(sizes)
        if len(self.same) == 3:
            for channel in range(3):
                self.sums[channel] = [a + b for a, b in zip(self.sums[channel], self.same[channel], strict=True)]
            self.same = []


class Model(NamedTuple):
    """The contexts of one channel: thresholds of the expected size, and a row of frequencies for each context."""

    thresholds: list[int]
    frequencies: list[list[int]]


def decode_context_section(
    stored: bytes, splats: int, count: int, signed: bool, predicted: bool, history: History
) -> list[list[int]]:
    """Return the integers of the streams of one section."""
    check(len(stored) >= 8, "a context section is shorter than its two sizes")
    description_size, bits_size = struct.unpack_from("<II", stored, 0)
    lanes = min(-(-splats // 256), 8192)
    steps = -(-splats // lanes)
    bits_start = 8 + description_size
    states_start = bits_start + bits_size
    words_start = states_start + 4 * lanes
    check(words_start <= len(stored), "a context section is shorter than its parts")
    check((len(stored) - words_start) % 2 == 0, "a context section ends within a word")

    description = stored[8:bits_start]
    size = zstandard.frame_content_size(description)
    check(0 <= size <= 2**20, "impossible size of a description")
    weights, models = read_models(undo_zstandard(description, size, "description of contexts"), count)
    extra = stored[bits_start:states_start]
    states = list(struct.unpack_from(f"<{lanes}I", stored, states_start))
    check(all(state >= 65536 for state in states), "a state is below 65536")
    words = struct.unpack(f"<{(len(stored) - words_start) // 2}H", stored[words_start:])
    words_read = 0
    extra_read = 0

    streams = []
    for number in range(count):
        model = models[number % 3]
        w = weights[number]
        tokens = [0] * splats
        recent = [0] * lanes
        for step in range(steps):
            for lane in range(lanes):
                n = lane * steps + step
                if n >= splats:
                    continue
                total = w[6] + w[5] * recent[lane]
                for channel in range(3):
                    total += w[channel] * history.sums[channel][n]
                for channel in range(len(history.same)):
                    total += w[3 + channel] * history.same[channel][n]
                expected = min(max(total >> 8, 0), 255)
                row = model.frequencies[sum(threshold <= expected for threshold in model.thresholds)]

                residue = states[lane] % 4096
                token = 0
                below = 0
                while below + row[token] <= residue:
                    below += row[token]
                    token += 1
                states[lane] = row[token] * (states[lane] // 4096) + residue - below
                if states[lane] < 65536:
                    check(words_read < len(words), "a context section has too few words")
                    states[lane] = states[lane] * 65536 + words[words_read]
                    words_read += 1
                tokens[n] = token
                recent[lane] += 2 * token_size(token, signed) - recent[lane] // 4

        values = [least_of_token(token) for token in tokens]
        for b in range(max(extra_bits(token) for token in tokens)):
            for step in range(steps):
                for lane in range(lanes):
                    n = lane * steps + step
                    if n < splats and extra_bits(tokens[n]) > b:
                        check(extra_read < 8 * len(extra), "a context section has too few extra bits")
                        values[n] += get_bit(extra, extra_read) << b
                        extra_read += 1
        if signed:
            values = [u // 2 if u % 2 == 0 else -(u + 1) // 2 for u in values]
        if predicted:
            for n in range(splats):
                place = n % steps
                before = [values[n - k] for k in range(1, 5) if place - k >= 0]
                values[n] = wrapped(values[n] + wrapped(sum(before) + 2) // 4)
        history.add([token_size(token, signed) for token in tokens])
        streams.append(values)
    check(words_read == len(words), "a context section has too many words")
    check(all(state == 65536 for state in states), "a lane does not end where it began")
    check(bytes_for_bits(extra_read) == len(extra), "a context section has too many extra bits")
    check_padding(extra, extra_read, "extra bits")
    return streams


def read_models(raw: bytes, count: int) -> tuple[list[list[int]], list[Model]]:
    """Return the seven weights of each stream, and the models of the channels."""
    check(len(raw) >= 14 * count, "a description is too short")
    weights = [list(struct.unpack_from("<7h", raw, 14 * number)) for number in range(count)]
    return weights, read_models_of(raw, 14 * count, [252] * min(3, count))


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


def decode_means(sections: Sections, header: Header) -> np.ndarray:
    """Return the centres of all splats."""
    root = read_tree(sections, header)
    leaves: list[Cell] = []
    collect_leaves(root, leaves)
    total = sum(leaf.splats for leaf in leaves)
    check(total == header.splats, f"the tree holds {total} splats instead of {header.splats}")
    follow_tails(sections, header, [leaf for leaf in leaves if not leaf.crowded])

    means = []
    for leaf in leaves:
        for _ in range(leaf.splats):
            means.append(centre(leaf, header))
    with np.errstate(over="ignore"):
        singles = np.array(means).astype(np.float32)
    check(bool(np.isfinite(singles).all()), "a centre is out of range")
    return np.array(means, dtype=np.float64).reshape(header.splats, 3)


def read_tree(sections: Sections, header: Header) -> Cell:
    """Read the octree level by level and return its root."""
    occupancy = raw_bytes(sections, OCCUPANCY)
    several = raw_bytes(sections, SEVERAL)
    multiplicity: list[int] = []
    if (MULTIPLICITY, 0) in sections:
        multiplicity = unsigned_integers(sections[MULTIPLICITY, 0])

    root = Cell(0, 0, 0, 0, crowded=len(occupancy) > 0 or len(multiplicity) > 0)
    cells = [root]
    occupancy_read = 0
    several_read = 0
    for _ in range(header.deepest):
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


def follow_tails(sections: Sections, header: Header, lone: list[Cell]) -> None:
    """Move each lone splat's leaf down to the cell where its tail ends."""
    lengths = list(raw_bytes(sections, TAIL_LENGTH))
    tail = raw_bytes(sections, TAIL)
    check(len(lengths) == len(lone), f"tail length has {len(lengths)} bytes for {len(lone)} lone splats")
    if header.version >= 2:
        check(max(lengths, default=0) <= header.deepest, "a leaf's level is below the deepest one")
        lengths = [max(level - leaf.level, 0) for level, leaf in zip(lengths, lone, strict=True)]
    for leaf, length in zip(lone, lengths, strict=True):
        check(leaf.level + length <= header.deepest, "a tail goes below the deepest level")

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


def centre(cell: Cell, header: Header) -> tuple[float, float, float]:
    """Return the centre of a cell in world units."""
    edge = header.edge * 2.0**-cell.level
    x, y, z = header.origin
    return x + (cell.i + 0.5) * edge, y + (cell.j + 0.5) * edge, z + (cell.k + 0.5) * edge


# Attributes


def decode_scales(sections: Sections, header: Header) -> np.ndarray:
    """Return the standard deviations along the splats' own axes."""
    factor = header.scale_factors[SCALE]
    scales = np.zeros((header.splats, 3), dtype=np.float64)
    for axis in range(3):
        for n, value in enumerate(unsigned_stream(sections, SCALE, axis, header.splats)):
            scales[n, axis] = max(value, 0.25) / factor
    return scales


def decode_quaternions(sections: Sections, header: Header) -> np.ndarray:
    """Return the rotations as w x y z."""
    factor = header.scale_factors[ROTATION]
    streams = [signed_stream(sections, ROTATION, axis, header.splats) for axis in range(3)]
    scales = [unsigned_stream(sections, SCALE, axis, header.splats) for axis in range(3)]
    quaternions = np.zeros((header.splats, 4), dtype=np.float64)
    for n in range(header.splats):
        own_factor = factor
        if header.version >= 2:
            own_factor = factor * math.sqrt(max(1, *(scale[n] for scale in scales)))
        x, y, z = (stream[n] / own_factor for stream in streams)
        w = math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))
        quaternions[n] = (w, x, y, z)
    return quaternions


def decode_opacities(sections: Sections, header: Header) -> np.ndarray:
    """Return the opacities."""
    factor = header.scale_factors[OPACITY]
    opacities = np.zeros(header.splats, dtype=np.float64)
    for n, value in enumerate(unsigned_stream(sections, OPACITY, 0, header.splats)):
        if header.version == 1:
            opacities[n] = min(1.0, (value + 0.25) / factor)
        else:
            opacities[n] = 1 / (1 + math.exp(-(value / factor - 8)))
    return opacities


def decode_sh(sections: Sections, header: Header) -> np.ndarray:
    """Return the spherical harmonics coefficients as RGB."""
    sh = np.zeros((header.splats, header.coefficients, 3), dtype=np.float64)
    dc_classes, ac_classes = decode_classes(sections, header)
    for coefficient in range(header.coefficients):
        factor = header.sh_factors[0 if coefficient == 0 else 1]
        classes = dc_classes if coefficient == 0 else ac_classes
        streams = [signed_stream(sections, SH, 3 * coefficient + channel, header.splats) for channel in range(3)]
        context_coded = (SH, 0) in sections and sections[SH, 0].streams is not None
        if coefficient == 0 and header.version == 3:
            streams = [undo_prediction(stream, classes) for stream in streams]
        elif coefficient == 0 and not context_coded:
            streams = [running_sums(stream) for stream in streams]
        for n in range(header.splats):
            luma, orange, green = (stream[n] for stream in streams)
            own_factor = factor * 2.0 ** (classes[n] / 4)
            sh[n, coefficient, 0] = wrapped(luma + orange - green) / own_factor
            sh[n, coefficient, 1] = wrapped(luma + green) / own_factor
            sh[n, coefficient, 2] = wrapped(luma - orange - green) / own_factor
    return sh


def decode_classes(sections: Sections, header: Header) -> tuple[list[int], list[int]]:
    """Return the classes of each splat's steps, of DC and of AC."""
    if (STEPS, 0) not in sections:
        return [0] * header.splats, [0] * header.splats
    raw = raw_bytes(sections, STEPS)
    check(len(raw) >= 50, "steps is too short")
    g, h, j, dc_power, ac_power, zero, dc_offset, ac_offset, w1, w2, w3, *t = struct.unpack_from("<6B2h3h17h", raw)
    check(g <= 40 and h <= 40 and zero == 0, "impossible steps")
    check(len(raw) == 50 + -(-header.splats // 2**g), "steps does not have a byte for each group")
    groups = struct.unpack_from(f"<{len(raw) - 50}b", raw, 50)
    scales = [unsigned_stream(sections, SCALE, axis, header.splats) for axis in range(3)]
    opacities = unsigned_stream(sections, OPACITY, 0, header.splats)
    classes: tuple[list[int], list[int]] = ([], [])
    for n in range(header.splats):
        a1, a2, a3 = sorted((scale_logarithm(scale[n]) for scale in scales), reverse=True)
        o = min(max(opacities[n] - 2**h * j, 0), 2**h * 16 - 1)
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
    """Return the values of DC of one channel, in version 3."""
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
