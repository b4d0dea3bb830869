"""Coder 1 of the independent decoder, written from docs/format.md alone: section "Bundles".

Plain and slow on purpose, as the rest of it.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from tests.oracles import decoder as rest

#: The sections whose states go on from one to the next.
MAIN_CHAIN = ("OPAC", "SCAL", "SHC0", "SHC1", "SHC2", "SHC3")
NAMES = {"OPAC": "opacity", "SCAL": "scale", "ROTA": "rotation", "SHC0": "dc"}


class Stream(NamedTuple):
    """What the description says of a stream."""

    weights: list[int]
    recent: int
    constant: int
    biases: list[int]
    model: rest.Model


class Part(NamedTuple):
    """A section's description, the states of all lanes if it has them, and the words of each bundle."""

    streams: list[Stream]
    states: list[int]
    words: list[list[int]]


class Bundle:
    """What is decoded of a bundle: sizes and integers of its n splats, by the names of streams."""

    def __init__(self, splats: int) -> None:
        self.splats = splats
        self.sizes: dict[str, list[int]] = {}
        self.sums = [[0] * splats for _ in range(3)]
        self.integers: dict[tuple[str, int], list[int]] = {}

    def size(self, name: str, splat: int) -> int:
        """Return the size of a splat's token, 0 where its section is absent."""
        return self.sizes[name][splat] if name in self.sizes else 0


def decode_bundles(coded: dict[str, bytes], sections: rest.Sections, block: rest.Block) -> rest.Integers:
    """Return the integers of all streams of the sections that there are; of DC what its prediction has left."""
    sizes = [min(8192, block.splats - 8192 * b) for b in range(-(-block.splats // 8192))]
    parts = {name: take_apart(coded[name], name, sizes) for name in coded}
    bundles = []
    for b, splats in enumerate(sizes):
        bundle = Bundle(splats)
        states = parts["OPAC"].states[32 * b : 32 * b + -(-splats // 256)]
        for name in MAIN_CHAIN[:2]:
            decode_section(name, parts, b, bundle, states, [])
        bundles.append((bundle, states))
    whole = {name: joined([bundle for bundle, _ in bundles], name) for name in ("OPAC", "SCAL")}
    classes, _ = rest.decode_classes(sections, whole, block)
    for b, (bundle, states) in enumerate(bundles):
        own = classes[8192 * b : 8192 * b + bundle.splats]
        for name in MAIN_CHAIN[2:]:
            decode_section(name, parts, b, bundle, states, own)
        rest.check(all(state == 65536 for state in states), "a lane does not end where it began")
        if "ROTA" in parts:
            states = parts["ROTA"].states[32 * b : 32 * b + len(states)]
            decode_section("ROTA", parts, b, bundle, states, own)
            rest.check(all(state == 65536 for state in states), "a lane does not end where it began")
    return {name: joined([bundle for bundle, _ in bundles], name) for name in coded}


def joined(bundles: list[Bundle], name: str) -> list[list[int]]:
    """Return the streams of a section, of all bundles together; 0 where there is none."""
    streams: list[list[int]] = [[] for _ in range(rest.STREAMS[name])]
    for bundle in bundles:
        for k, stream in enumerate(streams):
            stream += bundle.integers.get((name, k), [0] * bundle.splats)
    return streams


def take_apart(stored: bytes, name: str, sizes: list[int]) -> Part:
    """Return the parts of a section."""
    rest.check(len(stored) >= 4, "a section of bundles is shorter than its size")
    (description_size,) = struct.unpack_from("<I", stored)
    at = 4 + description_size
    lanes = sum(-(-splats // 256) for splats in sizes) if name in ("OPAC", "ROTA") else 0
    rest.check(at + 4 * lanes + 4 * len(sizes) <= len(stored), "a section of bundles is shorter than its parts")
    description = stored[4:at]
    raw = None
    if description:
        size = rest.zstandard.frame_content_size(description)
        rest.check(0 <= size <= 2**20, "impossible size of a description")
        raw = rest.undo_zstandard(description, size, "description of contexts")
    streams = read_streams(raw, name)
    states = list(struct.unpack_from(f"<{lanes}I", stored, at))
    rest.check(all(state >= 65536 for state in states), "a state is below 65536")
    at += 4 * lanes
    counts = struct.unpack_from(f"<{len(sizes)}I", stored, at)
    at += 4 * len(sizes)
    rest.check(at + 2 * sum(counts) == len(stored), "a section of bundles has other words than it says")
    words = []
    for count in counts:
        words.append(list(struct.unpack_from(f"<{count}H", stored, at)))
        at += 2 * count
    return Part(streams, states, words)


def read_streams(raw: bytes | None, name: str) -> list[Stream]:
    """Return what a description says; None: there is none."""
    if name in NAMES:
        known = {"OPAC": 0, "SCAL": 0, "ROTA": 6, "SHC0": 5}[name]
        numbers = [(known + s, 0) for s in range(rest.STREAMS[name])]
        alphabets = [252] * rest.STREAMS[name]
    else:
        coefficients = 2 * int(name[3]) + 1
        numbers = [(11, 0), (5, coefficients), (6, coefficients), (7, coefficients), (8, coefficients)]
        alphabets = [2**coefficients, 8, 252, 252, 252]
    if raw is None:
        return [
            Stream([0] * terms, 28, 0, [0] * biases, known_model(min(alphabet, 216)))
            for (terms, biases), alphabet in zip(numbers, alphabets, strict=True)
        ]
    at = 0
    read = []
    for terms, biases in numbers:
        count = terms + 2 + biases
        rest.check(len(raw) >= at + 2 * count, "a description is too short")
        read.append(list(struct.unpack_from(f"<{count}h", raw, at)))
        at += 2 * count
    models = rest.read_models_of(raw, at, alphabets)
    return [
        Stream(weights[:terms], weights[terms], weights[terms + 1], weights[terms + 2 :], model)
        for (terms, _), weights, model in zip(numbers, read, models, strict=True)
    ]


def known_model(tokens: int) -> rest.Model:
    """Return the model of a stream without a description."""
    rows = []
    for k in range(32):
        c = ((4096 if k % 2 == 0 else 5793) * 2 ** (k // 2)) >> 6
        below = []
        for a in range(tokens):
            r = (c + 16 * min(rest.least_of_token(a), 2**20)) ** 2
            below.append((4096 - tokens) * (r - c**2) // r + a)
        below.append(4096)
        rows.append([below[a + 1] - below[a] for a in range(tokens)])
    return rest.Model(list(range(8, 256, 8)), rows)


def decode_section(key: str, parts: dict[str, Part], b: int, bundle: Bundle, states: list[int], own: list[int]) -> None:
    """Decode a section of a bundle, if the file has it; ``own`` are the classes of the steps of DC."""
    if key not in parts:
        return
    streams, words = parts[key].streams, list(reversed(parts[key].words[b]))
    if key in NAMES:
        for s, stream in enumerate(streams):
            items = [(terms_of(bundle, NAMES[key], n, s, own), 0) for n in range(bundle.splats)]
            signed = key in ("ROTA", "SHC0")
            found, tokens = decode_items(
                stream, items, states, words, lambda t, signed=signed: rest.token_size(t, signed)
            )
            bundle.sizes[f"{NAMES[key]} {s}"] = [rest.token_size(token, signed) for token in tokens]
            bundle.integers[key, s] = [rest.signed_of(u) if signed else u for u in found]
    else:
        decode_degree(key, streams, bundle, states, words, own)
    rest.check(not words, "a bundle has too many words")


def terms_of(bundle: Bundle, name: str, n: int, s: int, own: list[int]) -> list[int]:
    """Return the terms of a stream of an item a splat."""
    before = [bundle.size(f"{name} {k}", n) for k in range(s)]
    scales = [bundle.size(f"scale {axis}", n) for axis in range(3)]
    if name == "rotation":
        a, b, c = scales
        return [a, b, c, abs(a - b), abs(b - c), abs(a - c), *before]
    if name == "dc":
        return [bundle.size("opacity 0", n), *scales, 4 * (own[n] + 32), *before]
    return before


def decode_degree(
    key: str, streams: list[Stream], bundle: Bundle, states: list[int], words: list[int], own: list[int]
) -> None:
    """Decode the AC coefficients of a degree."""
    coefficients = 2 * int(key[3]) + 1
    mask, pattern, *of_channels = streams
    items = []
    for n in range(bundle.splats):
        dc = [bundle.size(f"dc {c}", n) for c in range(3)]
        terms = terms_of(bundle, "dc", n, 0, own)
        items.append(([*terms, *dc, *(bundle.sums[c][n] for c in range(3))], 0))
    masks, _ = decode_items(mask, items, states, words, mask_size)
    where = [(n, k) for n in range(bundle.splats) for k in range(coefficients) if masks[n] >> k & 1]
    known = {
        n: [*(bundle.sums[c][n] for c in range(3)), mask_size(masks[n]), 4 * (own[n] + 32)]
        for n in range(bundle.splats)
    }
    patterns, _ = decode_items(pattern, [(known[n], k) for n, k in where], states, words, pattern_size)
    for k in range(coefficients):
        for c in range(3):
            bundle.integers[key, 3 * k + c] = [0] * bundle.splats
    sizes: list[dict[tuple[int, int], int]] = [{}, {}, {}]
    for c, stream in enumerate(of_channels):
        there = [(place, p) for place, p in zip(where, patterns, strict=True) if p >> c & 1]
        items = []
        for (n, k), p in there:
            before = [sizes[channel].get((n, k), 0) for channel in range(c)]
            items.append(([*known[n], pattern_size(p), *before], k))
        values, tokens = decode_items(stream, items, states, words, value_size)
        for ((n, k), _), value, token in zip(there, values, tokens, strict=True):
            bundle.integers[key, 3 * k + c][n] = rest.signed_of(value + 1)
            sizes[c][n, k] = value_size(token)
    for c in range(3):
        for (n, _), size in sizes[c].items():
            bundle.sums[c][n] += size


def decode_items(stream: Stream, items, states: list[int], words: list[int], size_of) -> tuple[list[int], list[int]]:
    """Return the integers of some items, and their tokens.

    ``items`` are the terms of each, and the number of its coefficient; ``words`` are those left, the next one last.
    """
    lanes = len(states)
    steps = -(-len(items) // lanes)
    tokens = [0] * len(items)
    values = [0] * len(items)
    recent = [0] * lanes
    for step in range(steps):
        active = [lane for lane in range(lanes) if lane * steps + step < len(items)]
        for lane in active:
            terms, coefficient = items[lane * steps + step]
            total = sum(weight * term for weight, term in zip(stream.weights, terms, strict=True))
            total += stream.recent * recent[lane] + stream.constant
            if stream.biases:
                total += stream.biases[coefficient]
            expected = min(max(total >> 8, 0), 255)
            row = stream.model.frequencies[sum(threshold <= expected for threshold in stream.model.thresholds)]
            residue = states[lane] % 4096
            token = 0
            below = 0
            while below + row[token] <= residue:
                below += row[token]
                token += 1
            states[lane] = row[token] * (states[lane] // 4096) + residue - below
            tokens[lane * steps + step] = token
            recent[lane] += 2 * size_of(token) - recent[lane] // 4
        take_words(active, states, words)
        taken = 0
        left = {lane: rest.extra_bits(tokens[lane * steps + step]) for lane in active}
        for lane in active:
            values[lane * steps + step] = rest.least_of_token(tokens[lane * steps + step])
        while any(bits > taken for bits in left.values()):
            for lane in active:
                bits = min(12, left[lane] - taken)
                if bits > 0:
                    values[lane * steps + step] += (states[lane] % 2**bits) << taken
                    states[lane] //= 2**bits
            take_words(active, states, words)
            taken += 12
    return values, tokens


def take_words(active: list[int], states: list[int], words: list[int]) -> None:
    """Give each lane a word whose state is too low."""
    for lane in active:
        if states[lane] < 65536:
            rest.check(len(words) > 0, "a bundle has too few words")
            states[lane] = states[lane] * 65536 + words.pop()


def mask_size(mask: int) -> int:
    """Return the size of a mask."""
    return 32 * bin(mask).count("1")


def pattern_size(pattern: int) -> int:
    """Return the size of a pattern."""
    return 128 if pattern > 1 else 0


def value_size(token: int) -> int:
    """Return the size of a token of values that are not 0."""
    magnitude = (rest.least_of_token(token) + 2) // 2
    return math.floor(16 * math.log2(1 + magnitude) + 0.5)
