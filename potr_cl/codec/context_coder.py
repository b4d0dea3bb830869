"""Context coder: streams of one integer a splat to bytes, each integer's code fitted to how large it should be.

An integer becomes a token (small ones by themselves, large ones by their magnitude, with the low bits stored as they
are) and tokens are coded by :mod:`potr_cl.codec.rans` with the frequencies of a context. The context is the size to
expect, a
weighted sum of the sizes that are known already: of the streams before at the same splat, and of the same stream at the
splats before. Weights, classes and frequencies are fitted to the scene and stored. docs/format.md, "Context coder", is
the normative description.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec import rans
from potr_cl.errors import DataError
from potr_cl.host.threads import Run

#: Integers of at most this many bits are tokens by themselves.
_DIRECT_BITS = 7
_DIRECT = 1 << _DIRECT_BITS
#: Mapped integers have at most this many bits.
_MOST_BITS = 38
#: Tokens there are: 4 for each power of two from the direct ones up.
ALPHABET = _DIRECT + 4 * (_MOST_BITS - _DIRECT_BITS)
#: Streams that belong together, channels of a coefficient or axes, and so the number of models of a section.
_CHANNELS = 3
#: Splats of a lane, unless there are too many for :data:`_MOST_LANES`.
_LANE = 256
_MOST_LANES = 8192
#: Lanes that are split or joined at a time: whole lines of a cache.
_TURNED = 64
#: Expected sizes are from 0 to this.
_LARGEST_SIZE = 255
_MOST_CONTEXTS = 32
#: Weights are in units of 2 to the power of minus this.
_WEIGHT_BITS = 8
#: Splats to which an encoder fits the weights.
_FITTED = 1 << 16
#: Sizes worked on at a time: few enough for temporaries to stay in a cache.
_BLOCK = 1 << 15
#: Of these, those whose products are added at a time.
_COLUMNS = 1 << 11
#: Memory for sizes that are worked on at the same time, and what a coefficient takes of it a splat, bytes.
_WORKING_BYTES = 1 << 27
_COEFFICIENT_BYTES = 48
#: From this many lanes on sections are coded one by one.
_MANY_LANES = 1 << 11
#: Bits that storing one frequency costs, about.
_FREQUENCY_BITS = 7

_HEAD = struct.Struct("<II")
_WEIGHTS = np.dtype("<i2")
#: Weights a stream: the sums of three channels, two channels of the same coefficient, recent ones, constant.
_TERMS = 7

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]


def _size_table(signed: bool) -> I32:
    """(ALPHABET,) 16 log2(1 + magnitude) of the least integer of each token, rounded."""
    token = np.arange(ALPHABET)
    above = np.maximum(token - _DIRECT, 0)
    mapped = np.where(token < _DIRECT, token, (4 + above % 4) << (_DIRECT_BITS - 2 + above // 4))
    magnitude = (mapped + 1) // 2 if signed else mapped
    sizes: I32 = np.floor(16 * np.log2(1.0 + magnitude) + 0.5).astype(np.int32)
    return sizes


_SIZES = {signed: _size_table(signed) for signed in (False, True)}
#: What a decoder's trail is while there are no recent sizes, and what a token adds to it.
_NO_TRAIL = rans.TRAIL_FACTOR
_WORTH = {signed: rans.TRAIL_FACTOR * (2 * sizes.astype(np.int64) + 1) for signed, sizes in _SIZES.items()}


@dataclass(frozen=True)
class Lanes:
    """How n splats lie in lanes: splat ``lane · steps + step``; the last lanes may be shorter or empty."""

    splats: int

    @property
    def number(self) -> int:
        return min(-(-self.splats // _LANE), _MOST_LANES)

    @property
    def steps(self) -> int:
        return -(-self.splats // self.number)

    @property
    def counts(self) -> I64:
        """(steps,) lanes that have a splat in each step."""
        return (self.splats - 1 - np.arange(self.steps)) // self.steps + 1

    def split(self, values: NDArray[np.integer]) -> NDArray[np.integer]:
        """(n,) to (steps, lanes), missing ones 0."""
        padded = np.zeros(self.number * self.steps, values.dtype)
        padded[: len(values)] = values
        lanes = padded.reshape(self.number, self.steps)
        laid = np.empty((self.steps, self.number), values.dtype)
        for start in range(0, self.number, _TURNED):
            laid[:, start : start + _TURNED] = lanes[start : start + _TURNED].T
        return laid

    def join(self, laid: NDArray[np.integer]) -> NDArray[np.integer]:
        """(steps, lanes) to (n,)."""
        lanes = np.empty((self.number, self.steps), laid.dtype)
        for start in range(0, self.number, _TURNED):
            # The steps of thousands of lanes lie where they drive each other out of a cache: so first close together.
            lanes[start : start + _TURNED] = np.ascontiguousarray(laid[:, start : start + _TURNED]).T
        return lanes.reshape(-1)[: self.splats]


class Sizes:
    """Sums of the sizes of all streams so far, by channel: what later streams' contexts are made of.

    Args:
        lanes: of the splats.
    """

    def __init__(self, lanes: Lanes) -> None:
        shape = (lanes.steps, lanes.number)
        self.sums = [np.zeros(shape, np.int32) for _ in range(_CHANNELS)]
        self.same: list[I32] = []  # of the channels before, of the same coefficient

    def known(self) -> list[I32]:
        """The terms of the next stream's expectation, in the order of their weights, but recent ones and constant."""
        return [*self.sums, *self.same]

    def add(self, sizes: I32) -> None:
        """Take in the next stream."""
        self.same.append(sizes)
        if len(self.same) == _CHANNELS:
            for total, part in zip(self.sums, self.same, strict=True):
                total += part
            self.same = []


def _predict(residuals: I64) -> I64:
    """Undo the prediction: (steps, lanes) integers, each the residual plus the rounded mean of the four before."""
    values = np.zeros((len(residuals) + 4, residuals.shape[1]), np.int64)
    # Sums of the last four, and 2 to round.
    total = np.full(residuals.shape[1], 2, np.int64)
    mean = np.empty_like(total)
    for residual, value, leaving in zip(residuals, values[4:], values, strict=False):
        np.right_shift(total, 2, mean)
        np.add(residual, mean, value)
        np.add(total, value, total)
        np.subtract(total, leaving, total)
    return values[4:]


# ------------------------------------------------------------------------------------------------ tokens


def _map(values: NDArray[np.integer], signed: bool) -> NDArray[np.unsignedinteger]:
    """Integers to unsigned ones of as many bits: 0, −1, 1, −2, … to 0, 1, 2, 3, … if signed."""
    mapped = (values << 1) ^ (values >> (8 * values.itemsize - 1)) if signed else values
    return mapped.view(f"u{values.itemsize}")


def _tokenise(mapped: NDArray[np.unsignedinteger]) -> tuple[U8, NDArray[np.bool_]]:
    """Tokens of mapped integers, and the bits beside: the lowest of all that have one, then the next."""
    tokens = mapped.astype(np.uint8)
    if int(mapped.max()) < _DIRECT:
        return tokens, np.zeros(0, bool)
    large = np.flatnonzero(mapped >= _DIRECT)
    u = mapped.ravel()[large].astype(np.int64)
    exponent = np.frexp(u.astype(np.float64))[1] - 1  # exact below 2^53
    extra = exponent - 2
    leading = u >> extra  # 4 to 7
    tokens.ravel()[large] = _DIRECT + 4 * (exponent - _DIRECT_BITS) + leading - 4
    return tokens, np.concatenate([(u[extra > b] >> b) & 1 for b in range(int(extra.max()))]).astype(bool)


def _extra_bits(large: U8) -> NDArray[np.int64]:
    """Of tokens that have some."""
    return _DIRECT_BITS - 2 + (large.astype(np.int64) - _DIRECT) // 4


# ------------------------------------------------------------------------------------------------ encode


@dataclass(frozen=True)
class Streams:
    """What one section holds.

    Attributes:
        values: (n,) integers each, n >= 1; not negative if not ``signed``.
        signed: whether they may be negative.
        predicted: store differences from the mean of the splats before.
    """

    values: Sequence[NDArray[np.integer]]
    signed: bool
    predicted: bool = False


def encode(
    chains: Sequence[Sequence[Streams]], run: Run = map, progress: Callable[[float], None] | None = None
) -> list[list[bytes] | None]:
    """Code some sections of a scene.

    Args:
        chains: sections one after another; the sizes of those before tell those of the next. All hold as many splats.
        run: in place of :func:`map`, to work with several threads.
        progress: told which part is done.

    Returns:
        The stored bytes of each chain's sections; None for a chain that holds an integer too large.
    """
    report = progress or (lambda done: None)
    drafts = [[_Draft(section) for section in chain] for chain in chains]
    streams = [(draft, s) for chain in drafts for draft in chain for s in range(len(draft.section.values))]
    if not streams:
        return [[] for _ in chains]
    layout = _Layout.of(len(streams[0][0].section.values[0]))
    too_large = set()
    made = run(lambda job: _tokens_of(job[0].section, job[1], layout), streams)
    for (draft, _), tokens in zip(streams, made, strict=True):
        if tokens is None:
            too_large.add(id(draft))
        else:
            draft.tokens.append(tokens[0])
            draft.beside.append(tokens[1])
            draft.alphabet = max(draft.alphabet, int(tokens[0].max()) + 1)
    coded = [chain for chain in drafts if too_large.isdisjoint(map(id, chain))]
    report(0.2)
    for draft, weights, cells in _contexts(coded, layout, run):
        draft.weights.append(weights)
        draft.cells.extend(cells)
    report(0.5)
    sections = [draft for chain in coded for draft in chain]
    finished = list(run(lambda draft: _finish(draft, layout), sections))
    # With few lanes a step's calls take longer than its work; with many, what they work on must fit a cache.
    few = layout.lanes.number < _MANY_LANES
    parts = [finished] if few and finished else [[each] for each in finished]
    words = [pair for part in run(rans.encode, [[tokens for tokens, _ in part] for part in parts]) for pair in part]
    for draft, (_, head), (states, rest) in zip(sections, finished, words, strict=True):
        draft.stored = b"".join([head, states.astype("<u4").tobytes(), rest])
    report(1.0)
    return [[draft.stored for draft in chain] if chain in coded else None for chain in drafts]


@dataclass(frozen=True)
class _Layout:
    """Where splats are among steps and lanes.

    Attributes:
        idle: flat indices of the lanes in the steps in which they have no splat.
        fitted: of the splats to which weights are fitted.
    """

    lanes: Lanes
    idle: I64
    fitted: I64

    @staticmethod
    def of(splats: int) -> _Layout:
        lanes = Lanes(splats)
        active = (np.arange(lanes.number) < lanes.counts[:, None]).ravel()
        return _Layout(lanes, np.flatnonzero(~active), np.flatnonzero(active)[:: max(1, splats // _FITTED)])


@dataclass(eq=False)
class _Draft:
    """A section on its way to bytes.

    Attributes:
        tokens: of each stream, (steps, lanes), as long as they are needed.
        beside: the bits beside them.
        alphabet: one more than the largest token.
        weights: of each coefficient, (channels, terms).
        cells: of each stream, (steps, lanes): expected size · alphabet + token.
    """

    section: Streams
    tokens: list[U8 | None] = field(default_factory=list)
    beside: list[NDArray[np.bool_]] = field(default_factory=list)
    alphabet: int = 1
    weights: list[NDArray[np.int16]] = field(default_factory=list)
    cells: list[U16] = field(default_factory=list)
    stored: bytes = b""


def _tokens_of(section: Streams, stream: int, layout: _Layout) -> tuple[U8, NDArray[np.bool_]] | None:
    values = layout.lanes.split(section.values[stream])
    if section.predicted:
        values = _differences(values)
        values.ravel()[layout.idle] = 0
    mapped = _map(values, section.signed)
    return None if int(mapped.max()) >> _MOST_BITS else _tokenise(mapped)


def _contexts(
    chains: list[list[_Draft]], layout: _Layout, run: Run
) -> Iterator[tuple[_Draft, NDArray[np.int16], list[U16]]]:
    """Weights and cells of every coefficient of some chains, in order."""
    jobs = [(chain, draft, s) for chain in chains for draft in chain for s in range(0, len(draft.tokens), _CHANNELS)]
    shape = (layout.lanes.steps, layout.lanes.number)
    sums = {id(chain): [np.zeros(shape, np.int32)] * _CHANNELS for chain in chains}

    def measure(part: list[tuple[list[_Draft], _Draft, int]]) -> tuple[list[list[U8]], I32, I32]:
        """Sizes and recent ones of some coefficients; of several at once, as it takes a call a step."""
        tokens = []
        for _, draft, s in part:
            tokens.append([token for token in draft.tokens[s : s + _CHANNELS] if token is not None])
            draft.tokens[s : s + _CHANNELS] = [None] * len(tokens[-1])
        sizes = np.empty((sum(map(len, tokens)), *shape), np.int32)
        of_all = [(token, draft) for (_, draft, _), own in zip(part, tokens, strict=True) for token in own]
        for size, (token, draft) in zip(sizes, of_all, strict=True):
            _SIZES[draft.section.signed].take(token, out=size, mode="clip")
        return tokens, sizes, _recent(sizes)

    def weigh(job: tuple[_Draft, list[I32], list[U8], I32, I32]) -> tuple[_Draft, NDArray[np.int16], list[U16]]:
        draft, before, tokens, sizes, recent = job
        weights = _fit(before, sizes, recent, layout.fitted)
        cells = [
            _cells([*before, *sizes[:c], recent[c]], weights[c], token, draft.alphabet)
            for c, token in enumerate(tokens)
        ]
        return draft, weights, cells

    at_once = max(_BLOCK // (_CHANNELS * shape[1]), 1)
    at_a_time = max(_WORKING_BYTES // (_COEFFICIENT_BYTES * layout.lanes.splats * at_once), 2) * at_once
    for start in range(0, len(jobs), at_a_time):
        window = jobs[start : start + at_a_time]
        parts = [window[k : k + at_once] for k in range(0, len(window), at_once)]
        work = []
        for part, (tokens, all_sizes, all_recent) in zip(parts, run(measure, parts), strict=True):
            at = 0
            for (chain, draft, _), own in zip(part, tokens, strict=True):
                sizes, recent = (array[at : at + len(own)] for array in (all_sizes, all_recent))
                at += len(own)
                before = sums[id(chain)]
                work.append((draft, before, own, sizes, recent))
                if len(own) == _CHANNELS:
                    sums[id(chain)] = [total + size for total, size in zip(before, sizes, strict=True)]
        yield from run(weigh, work)


def _finish(draft: _Draft, layout: _Layout) -> tuple[rans.Tokens, bytes]:
    """What the range coder takes of a section, and the stored bytes before its own."""
    channels = range(min(_CHANNELS, len(draft.cells)))
    models = [_fit_model(draft.cells[c::_CHANNELS], layout.idle, draft.alphabet) for c in channels]
    for cells in draft.cells:
        cells.ravel()[layout.idle] = (_LARGEST_SIZE + 1) * draft.alphabet
    description = zstandard.ZstdCompressor(level=19, write_checksum=False).compress(
        np.concatenate(draft.weights).astype(_WEIGHTS).tobytes() + b"".join(model.to_bytes() for model in models)
    )
    beside = np.packbits(np.concatenate(draft.beside), bitorder="little").tobytes()
    tokens = rans.Tokens(
        draft.cells,
        [s % _CHANNELS for s in range(len(draft.cells))],
        [model.frequencies for model in models],
        [model.classes for model in models],
    )
    return tokens, b"".join([_HEAD.pack(len(description), len(beside)), description, beside])


def _differences(values: NDArray[np.integer]) -> NDArray[np.integer]:
    """Of (steps, lanes) integers, each less the rounded mean of the four before."""
    wide: NDArray[Any] = values.astype(np.int32 if values.itemsize < 4 else np.int64)
    before = np.concatenate([np.zeros((4, values.shape[1]), wide.dtype), wide])
    before = (before[:-4] + before[1:-3] + before[2:-2] + before[3:-1] + 2) >> 2
    wide -= before
    return wide


def _recent(sizes: I32) -> I32:
    """About 8 times the mean size of a lane's last splats, before each; all are (streams, steps, lanes)."""
    recent = np.empty_like(sizes)
    recent[:, 0] = 0
    twice = sizes << 1
    part = np.empty((len(sizes), sizes.shape[2]), np.int32)
    for t in range(1, sizes.shape[1]):
        r, after = recent[:, t - 1], recent[:, t]
        np.right_shift(r, 2, part)
        np.subtract(r, part, after)
        np.add(after, twice[:, t - 1], after)
    return recent


def _fit(sums: list[I32], sizes: I32, recents: I32, fitted: I64) -> NDArray[np.int16]:
    """Least-squares weights for the sizes of a coefficient's channels.

    Args:
        sums: what is known from the coefficients before, (steps, lanes) each.
        sizes, recents: (channels, steps, lanes) sizes and recent ones.
        fitted: flat indices of what to fit to.

    Returns:
        (channels, terms) in the order of the format.
    """
    channels = len(sizes)
    terms = [*sums, *sizes, *recents]
    columns = np.zeros((-(-len(fitted) // _COLUMNS), len(terms) + 1, _COLUMNS))
    whole, rest = divmod(len(fitted), _COLUMNS)
    for k, term in enumerate(terms):
        values = term.ravel().take(fitted)
        columns[:whole, k] = values[: whole * _COLUMNS].reshape(whole, _COLUMNS)
        columns[whole:, k, :rest] = values[whole * _COLUMNS :]
    columns[:whole, -1] = 1
    columns[whole:, -1, :rest] = 1
    # Sums of products of integers, below 2^53: exact, in whatever order they are added. Few columns at a time stay in a
    # cache and do not wake the threads of a BLAS, which would stand in the way of those here.
    products = (columns @ columns.transpose(0, 2, 1)).sum(axis=0)
    weights = np.zeros((channels, _TERMS), np.int16)
    for c in range(channels):
        known = [*range(_CHANNELS + c), _CHANNELS + channels + c, -1]
        gram = products[np.ix_(known, known)]
        gram[np.diag_indices_from(gram)] *= 1 + 1e-6
        gram[np.diag_indices_from(gram)] += 1e-6 * len(fitted)
        solution = np.round(np.linalg.solve(gram, products[known, _CHANNELS + c]) * (1 << _WEIGHT_BITS))
        cut = np.clip(solution, -32768, 32767)
        weights[c, : _CHANNELS + c] = cut[:-2]
        weights[c, -2:] = cut[-2:]
    return weights


def _cells(terms: list[I32], weights: NDArray[np.int16], tokens: U8, alphabet: int) -> U16:
    """(steps, lanes) expected size · alphabet + token.

    Args:
        terms: known sizes and recent ones.
        weights: of the terms, in the order of the format.
    """
    used = [(term, np.int32(w)) for term, w in zip(terms, [*weights[: len(terms) - 1], weights[-2]], strict=True) if w]
    cells = np.empty(tokens.shape, np.uint16)
    rows = max(_BLOCK // tokens.shape[1], 1)
    for start in range(0, len(tokens), rows):
        block = slice(start, start + rows)
        expected = np.full(cells[block].shape, weights[-1], np.int32)
        for term, weight in used:
            expected += weight * term[block]
        expected >>= _WEIGHT_BITS
        np.clip(expected, 0, _LARGEST_SIZE, out=expected)
        expected *= alphabet
        expected += tokens[block]
        cells[block] = expected
    return cells


@dataclass(frozen=True)
class _Model:
    """Contexts by expected size.

    Attributes:
        classes: (256,) uint8 context of each expected size, never falling.
        frequencies: (contexts, alphabet).
    """

    classes: U8
    frequencies: I64

    def to_bytes(self) -> bytes:
        contexts = len(self.frequencies)
        thresholds = np.flatnonzero(np.diff(self.classes)).astype(np.uint8) + 1
        used = int(np.flatnonzero(self.frequencies.any(axis=0))[-1]) + 1
        planes = np.ascontiguousarray(self.frequencies[:, :used].T.astype("<u2"))
        return (
            bytes([contexts, used])
            + thresholds.astype(np.uint8).tobytes()
            + (planes & 255).astype(np.uint8).tobytes()
            + (planes >> 8).astype(np.uint8).tobytes()
        )


def _fit_model(streams: list[U16], idle: I64, alphabet: int) -> _Model:
    """Classes of expected sizes and their frequencies: fine ones first, merged while that saves bytes.

    Args:
        streams: cells.
        idle: flat indices of those that stand for no splat.
        alphabet: of the cells.
    """
    cells = (_LARGEST_SIZE + 1) * alphabet
    counts = np.zeros(cells, np.int64)
    for stream in streams:
        counts += np.bincount(stream.ravel(), minlength=cells)
        counts -= np.bincount(stream.ravel()[idle], minlength=cells)
    by_size = counts.reshape(-1, alphabet)
    used = np.flatnonzero(by_size.any(axis=1))
    ranks = np.cumsum(by_size[used].sum(axis=1))
    edges = used[np.flatnonzero(np.diff((ranks - 1) * 2 * _MOST_CONTEXTS // ranks[-1], prepend=-1))]
    starts: list[int] = [0, *edges[1:].tolist()]
    groups = list(np.add.reduceat(by_size, starts))
    costs = [_cost(g) for g in groups]
    merged = [_cost(a + b) for a, b in pairwise(groups)]
    while len(groups) > 1:
        growth = [m - a - b for m, a, b in zip(merged, costs, costs[1:], strict=False)]
        k = growth.index(min(growth))
        if growth[k] >= 0 and len(groups) <= _MOST_CONTEXTS:
            break
        groups[k : k + 2] = [groups[k] + groups[k + 1]]
        costs[k : k + 2] = [merged.pop(k)]
        del starts[k + 1]
        for pair in range(max(k - 1, 0), min(k + 1, len(merged))):
            merged[pair] = _cost(groups[pair] + groups[pair + 1])
    classes = np.zeros(_LARGEST_SIZE + 1, np.uint8)
    for start in starts[1:]:
        classes[start:] += 1
    return _Model(classes, np.array([rans.normalise(g) for g in groups]))


def _cost(counts: I64) -> float:
    """Bits of the tokens of a context and of its frequencies."""
    present = counts[counts > 0].astype(np.float64)
    return float(np.add.reduce(present * np.log2(np.add.reduce(present) / present))) + _FREQUENCY_BITS * len(present)


# ------------------------------------------------------------------------------------------------ decode


class Reader:
    """A section's streams, one after another.

    Args:
        stored: the section's bytes; nothing in them is trusted.
        splats: n.
        streams: number of streams.
        signed, predicted, history: as for :func:`encode`.
        what: for messages.

    Raises:
        DataError: damaged.
    """

    def __init__(
        self,
        stored: memoryview,
        splats: int,
        streams: int,
        signed: bool,
        predicted: bool,
        history: Sizes | None,
        what: str,
    ) -> None:
        self._lanes = Lanes(splats)
        self._streams = streams
        self._signed = signed
        self._predicted = predicted
        self._history = history or Sizes(self._lanes)
        self._what = what
        states_bytes = 4 * self._lanes.number
        if len(stored) < _HEAD.size:
            raise self._damaged("ends too early")
        described, beside = _HEAD.unpack_from(stored)
        if _HEAD.size + described + beside + states_bytes > len(stored):
            raise self._damaged("ends too early")
        start = _HEAD.size + described
        self._read_models(self._inflate(stored[_HEAD.size : start]))
        self._bits = np.unpackbits(np.frombuffer(stored[start : start + beside], np.uint8), bitorder="little").view(
            bool
        )
        self._bits_read = 0
        start += beside
        states = np.frombuffer(stored[start : start + states_bytes], "<u4").astype(np.int64)
        if (states < rans.LOWEST).any():
            raise self._damaged("holds an impossible state")
        if (len(stored) - start - states_bytes) % 2:
            raise self._damaged("ends within a word")
        self._rans = rans.Decoder(states, stored[start + states_bytes :], what)

    def _damaged(self, how: str) -> DataError:
        return DataError(f"section '{self._what}' {how}")

    def _inflate(self, description: memoryview) -> bytes:
        models = min(_CHANNELS, self._streams)
        most = 2 * _TERMS * self._streams + models * (2 + _MOST_CONTEXTS - 1 + 2 * _MOST_CONTEXTS * ALPHABET)
        try:
            if not 0 <= zstandard.get_frame_parameters(description).content_size <= most:
                raise self._damaged("describes its contexts at an impossible length")
            return zstandard.ZstdDecompressor().decompress(description, allow_extra_data=False)
        except zstandard.ZstdError as error:
            raise self._damaged(f"does not decompress: {error}") from None

    def _read_models(self, raw: bytes) -> None:
        size = 2 * _TERMS * self._streams
        impossible = self._damaged("describes impossible contexts")
        if len(raw) < size:
            raise impossible
        self._weights = np.frombuffer(raw[:size], _WEIGHTS).reshape(-1, _TERMS).astype(np.int32)
        self._models: list[tuple[I64, rans.Table]] = []  # class of a third of an expected size times TOTAL
        for _ in range(min(_CHANNELS, self._streams)):
            if len(raw) < size + 2:
                raise impossible
            contexts, used = raw[size], raw[size + 1]
            size += 2
            cells = contexts * used
            if not (1 <= contexts <= _MOST_CONTEXTS and 1 <= used <= ALPHABET) or len(raw) < (
                size + contexts - 1 + 2 * cells
            ):
                raise impossible
            thresholds = np.frombuffer(raw, np.uint8, contexts - 1, size).astype(np.int64)
            size += contexts - 1
            low, high = (np.frombuffer(raw, np.uint8, cells, size + k * cells).astype(np.int64) for k in (0, 1))
            size += 2 * cells
            frequencies = (low | high << 8).reshape(used, contexts).T
            if (np.diff(thresholds, prepend=0) < 1).any() or (frequencies.sum(axis=1) != rans.TOTAL).any():
                raise impossible
            classes = np.searchsorted(thresholds, np.arange(_LARGEST_SIZE + 1), side="right").astype(np.int64)
            table = rans.Table.of(frequencies, _WORTH[self._signed])
            self._models.append((np.repeat(classes * rans.TOTAL, rans.TRAIL_FACTOR), table))
        if len(raw) != size:
            raise impossible

    def __iter__(self) -> Iterator[Stream]:
        """Yield each stream.

        Raises:
            DataError: damaged.
        """
        lanes = self._lanes.counts
        for s in range(self._streams):
            classes, table = self._models[s % _CHANNELS]
            known = self._history.known()
            weights = self._weights[s]
            # Channels of the same coefficient that come later are not known yet: their weights do not count.
            expected = partial(_expected, known, weights[: len(known)], int(weights[-2]), int(weights[-1]))
            tokens = self._rans.stream(table, classes, expected, int(weights[-2]), _NO_TRAIL, lanes)
            self._history.add(_SIZES[self._signed].take(tokens))
            end = self._bits_read
            if int(tokens.max()) >= _DIRECT:
                end += int(_extra_bits(tokens[tokens >= _DIRECT]).sum())
            bits = self._bits[self._bits_read : end]
            if end > len(self._bits):
                raise self._damaged("ends too early")
            self._bits_read = end
            yield Stream(self._lanes, tokens, bits, self._signed, self._predicted)
        self._rans.finish()
        rest = self._bits[self._bits_read :]
        if len(rest) >= 8 or rest.any():
            raise self._damaged("holds more bits than its integers ask for")


def _expected(known: Sequence[I32], weights: I32, recent: int, constant: int, steps: slice) -> I64:
    """What :meth:`potr_cl.codec.rans.Decoder.stream` adds to the recent sizes' part of a context.

    With ρ the recent sizes, its trail is 3 ρ + 3 (⌊trail / 4⌋ is ρ − ⌊ρ / 4⌋), and so all is three times as much: 3 ·
    (the weighted sum of what is known − the weight of ρ).
    """
    total = np.full(known[0][steps].shape, constant - recent, np.int32)
    product = np.empty_like(total)
    for term, weight in zip(known, weights, strict=True):
        if weight:
            np.multiply(term[steps], weight, product)
            np.add(total, product, total)
    return np.multiply(total, rans.TRAIL_FACTOR, dtype=np.int64)


@dataclass(frozen=True)
class Stream:
    """A stream whose integers need no other's any more: that can be left to another thread.

    Attributes:
        tokens: (steps, lanes).
        bits: beside the tokens.
    """

    lanes: Lanes
    tokens: U8
    bits: NDArray[np.bool_]
    signed: bool
    predicted: bool

    @property
    def values(self) -> NDArray[np.integer]:
        """(n,) integers of any type."""
        return self.part(0, self.lanes.splats)

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one splat to another."""
        values = self._joined[start:stop]
        if self.signed and values.dtype == np.uint8:
            return ((values >> 1) ^ (0 - (values & 1)).astype(np.uint8)).view(np.int8)
        return values

    @cached_property
    def _joined(self) -> NDArray[np.integer]:
        """(n,) integers, mapped to unsigned ones as long as they are bytes."""
        tokens = self.tokens
        if not (len(self.bits) or self.predicted):
            return self.lanes.join(tokens)
        mapped = tokens.astype(np.int64)
        where = np.flatnonzero(tokens >= _DIRECT)
        large = tokens.ravel()[where]
        extra = _extra_bits(large)
        u = (4 + (large - _DIRECT) % np.int64(4)) << extra
        read = 0
        for b in range(int(extra.max(initial=0))):
            has = extra > b
            need = int(np.count_nonzero(has))
            u[has] |= self.bits[read : read + need].astype(np.int64) << b
            read += need
        mapped.ravel()[where] = u
        values = (mapped >> 1) ^ -(mapped & 1) if self.signed else mapped
        return self.lanes.join(_predict(values) if self.predicted else values)
