"""Context coder: streams of one integer a splat to bytes, each integer's code fitted to how large it should be.

An integer becomes a token (small ones by themselves, large ones by their magnitude, with the low bits stored as they
are) and tokens are coded by :mod:`potr_cl.rans` with the frequencies of a context. The context is the size to expect, a
weighted sum of the sizes that are known already: of the streams before at the same splat, and of the same stream at the
splats before. Weights, classes and frequencies are fitted to the scene and stored. docs/format.md, "Context coder", is
the normative description.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl import rans
from potr_cl.errors import DataError

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
#: Expected sizes are from 0 to this.
_LARGEST_SIZE = 255
_MOST_CONTEXTS = 32
#: Weights are in units of 2 to the power of minus this.
_WEIGHT_BITS = 8
#: Splats to which an encoder fits the weights.
_FITTED = 1 << 16
#: Bits that storing one frequency costs, about.
_FREQUENCY_BITS = 7

_HEAD = struct.Struct("<II")
_WEIGHTS = np.dtype("<i2")
#: Weights a stream: the sums of three channels, two channels of the same coefficient, recent ones, constant.
_TERMS = 7

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


def _size_table(signed: bool) -> I32:
    """(ALPHABET,) 16 log2(1 + magnitude) of the least integer of each token, rounded."""
    token = np.arange(ALPHABET)
    above = np.maximum(token - _DIRECT, 0)
    mapped = np.where(token < _DIRECT, token, (4 + above % 4) << (_DIRECT_BITS - 2 + above // 4))
    magnitude = (mapped + 1) // 2 if signed else mapped
    sizes: I32 = np.floor(16 * np.log2(1.0 + magnitude) + 0.5).astype(np.int32)
    return sizes


_SIZES = {signed: _size_table(signed) for signed in (False, True)}


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

    def split(self, values: I64) -> I64:
        """(n,) to (steps, lanes), missing ones 0."""
        padded = np.zeros(self.number * self.steps, values.dtype)
        padded[: len(values)] = values
        return np.ascontiguousarray(padded.reshape(self.number, self.steps).T)

    def join(self, laid: NDArray[np.integer]) -> NDArray[np.integer]:
        """(steps, lanes) to (n,)."""
        return np.ascontiguousarray(laid.T).reshape(-1)[: self.splats]


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


def _recent(sizes: I32) -> I32:
    """(steps, lanes) about 8 times the mean size of a lane's last splats, before each."""
    recent = np.empty_like(sizes)
    r = np.zeros(sizes.shape[1], np.int32)
    for now, size in zip(recent, sizes, strict=True):
        now[:] = r
        r += 2 * size - (r >> 2)
    return recent


def _expected(known: Sequence[I32], weights: I32) -> I32:
    """The weighted sum of what is known without the recent ones, not yet shifted and cut."""
    total = np.full(known[0].shape, weights[-1], np.int32)
    for weight, term in zip(weights, known, strict=False):
        if weight:
            total += weight * term
    return total


def _predict(residuals: I64) -> I64:
    """Undo the prediction: (steps, lanes) integers, each the residual plus the rounded mean of the four before."""
    values = np.zeros((len(residuals) + 4, residuals.shape[1]), np.int64)
    for t, residual in enumerate(residuals):
        values[t + 4] = residual + _mean(values[t : t + 4])
    return values[4:]


def _mean(last: I64) -> I64:
    total: I64 = last.sum(axis=0)
    return (total + 2) >> 2


# ------------------------------------------------------------------------------------------------ tokens


def _tokenise(mapped: NDArray[np.uint64]) -> tuple[U8, NDArray[np.uint8]]:
    """Tokens of mapped integers, and how many low bits of each are stored beside."""
    exponent = np.frexp(np.maximum(mapped, 1).astype(np.float64))[1] - 1  # exact below 2^53
    extra = np.where(mapped < _DIRECT, 0, exponent - 2)
    leading = (mapped >> extra.astype(np.uint64)).astype(np.int64)  # 4 to 7
    token = np.where(mapped < _DIRECT, mapped.astype(np.int64), _DIRECT + 4 * (exponent - _DIRECT_BITS) + leading - 4)
    return token.astype(np.uint8), extra.astype(np.uint8)


def _extra_bits(tokens: U8) -> NDArray[np.int64]:
    return np.where(tokens < _DIRECT, 0, _DIRECT_BITS - 2 + (tokens.astype(np.int64) - _DIRECT) // 4)


def _zigzag(values: I64) -> NDArray[np.uint64]:
    return ((values << 1) ^ (values >> 63)).view(np.uint64)


# ------------------------------------------------------------------------------------------------ encode


def encode(
    streams: Sequence[NDArray[np.integer]], signed: bool, predicted: bool, history: Sizes | None
) -> bytes | None:
    """Code some streams.

    Args:
        streams: (n,) integers each, n >= 1; not negative if not ``signed``.
        signed: whether they may be negative.
        predicted: store differences from the mean of the splats before.
        history: streams of earlier sections that may tell sizes; these are added.

    Returns:
        The stored bytes; None if an integer is too large.
    """
    lanes = Lanes(len(streams[0]))
    history = history or Sizes(lanes)
    table = _SIZES[signed]
    tokens: list[U8] = []
    expectations: list[U8] = []
    weights = np.zeros((len(streams), _TERMS), _WEIGHTS)
    extra = []
    active = np.arange(lanes.number) < lanes.counts[:, None]
    for s, stream in enumerate(streams):
        values = lanes.split(stream.astype(np.int64))
        if predicted:
            before = np.concatenate([np.zeros((4, lanes.number), np.int64), values])
            values = values - ((before[:-4] + before[1:-3] + before[2:-2] + before[3:-1] + 2) >> 2)
            values *= active
        mapped = _zigzag(values) if signed else values.view(np.uint64)
        if int(mapped.max()) >> _MOST_BITS:
            return None
        token, bits = _tokenise(mapped)
        extra.append(_pack_extra(mapped, bits))
        sizes = table[token]
        recent = _recent(sizes)
        known = history.known()
        weights[s] = _fit([*known, recent], sizes, active, s % _CHANNELS)
        w = weights[s].astype(np.int32)
        expected = (_expected(known, w) + w[-2] * recent) >> _WEIGHT_BITS
        expectations.append(np.clip(expected, 0, _LARGEST_SIZE).astype(np.uint8))
        tokens.append(token)
        history.add(sizes)

    models = [
        _fit_model(tokens[c::_CHANNELS], expectations[c::_CHANNELS], active)
        for c in range(min(_CHANNELS, len(streams)))
    ]
    encoder = rans.Encoder(lanes.number)
    for s in range(len(streams) - 1, -1, -1):
        model = models[s % _CHANNELS]
        index = model.classes[expectations[s]].astype(np.int64) * ALPHABET + tokens[s]
        frequencies = model.frequencies.ravel()
        starts = (np.cumsum(model.frequencies, axis=1) - model.frequencies).ravel()
        for t in range(lanes.steps - 1, -1, -1):
            row = index[t, : lanes.counts[t]]
            encoder.step(frequencies[row], starts[row])
    description = zstandard.ZstdCompressor(level=19, write_checksum=False).compress(
        weights.tobytes() + b"".join(model.to_bytes() for model in models)
    )
    bits_beside = np.packbits(np.concatenate(extra), bitorder="little").tobytes()
    return b"".join(
        [
            _HEAD.pack(len(description), len(bits_beside)),
            description,
            bits_beside,
            encoder.states.astype("<u4").tobytes(),
            encoder.words(),
        ]
    )


def _pack_extra(mapped: NDArray[np.uint64], bits: U8) -> NDArray[np.bool_]:
    """The low bits stored beside the tokens: lowest bit of all that have one, then the next."""
    planes = [((mapped[bits > b] >> np.uint64(b)) & np.uint64(1)).astype(bool) for b in range(int(bits.max(initial=0)))]
    return np.concatenate([np.zeros(0, bool), *planes])


def _fit(terms: list[I32], sizes: I32, active: NDArray[np.bool_], channel: int) -> NDArray[np.int16]:
    """Least-squares weights of the terms (the last: recent ones) for the size, in the order of the format."""
    where = np.flatnonzero(active)
    where = where[:: max(1, len(where) // _FITTED)]
    columns = np.stack([term.ravel()[where] for term in terms] + [np.ones(len(where), np.int32)]).astype(np.float64)
    target = sizes.ravel()[where].astype(np.float64)
    gram = columns @ columns.T
    gram[np.diag_indices_from(gram)] *= 1 + 1e-6
    gram[np.diag_indices_from(gram)] += 1e-6 * len(where)
    solution = np.round(np.linalg.solve(gram, columns @ target) * (1 << _WEIGHT_BITS))
    weights = np.zeros(_TERMS, np.int16)
    fitted = np.clip(solution, -32768, 32767).astype(np.int16)
    weights[: _CHANNELS + channel] = fitted[: _CHANNELS + channel]
    weights[-2:] = fitted[-2:]
    return weights


@dataclass(frozen=True)
class _Model:
    """Contexts by expected size.

    Attributes:
        classes: (256,) uint8 context of each expected size, never falling.
        frequencies: (contexts, ALPHABET).
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


def _fit_model(tokens: list[U8], expectations: list[U8], active: NDArray[np.bool_]) -> _Model:
    """Classes of expected sizes and their frequencies: fine ones first, merged while that saves bytes."""
    counts = np.zeros((_LARGEST_SIZE + 1) * ALPHABET, np.int64)
    for token, expected in zip(tokens, expectations, strict=True):
        index = expected[active].astype(np.int64) * ALPHABET + token[active]
        counts += np.bincount(index, minlength=len(counts))
    by_size = counts.reshape(-1, ALPHABET)
    used = np.flatnonzero(by_size.any(axis=1))
    ranks = np.cumsum(by_size[used].sum(axis=1))
    edges = used[np.flatnonzero(np.diff((ranks - 1) * 2 * _MOST_CONTEXTS // ranks[-1], prepend=-1))]
    starts: list[int] = [0, *edges[1:].tolist()]
    groups = [by_size[a:b].sum(axis=0) for a, b in pairwise([*starts, len(by_size)])]
    costs = [_cost(g) for g in groups]
    while len(groups) > 1:
        merged = [_cost(a + b) for a, b in pairwise(groups)]
        growth = [m - a - b for m, a, b in zip(merged, costs, costs[1:], strict=False)]
        k = int(np.argmin(growth))
        if growth[k] >= 0 and len(groups) <= _MOST_CONTEXTS:
            break
        groups[k : k + 2] = [groups[k] + groups[k + 1]]
        costs[k : k + 2] = [merged[k]]
        del starts[k + 1]
    classes = np.zeros(_LARGEST_SIZE + 1, np.uint8)
    for start in starts[1:]:
        classes[start:] += 1
    return _Model(classes, np.array([rans.normalise(g) for g in groups]))


def _cost(counts: I64) -> float:
    """Bits of the tokens of a context and of its frequencies."""
    present = counts[counts > 0].astype(np.float64)
    return float(np.sum(present * np.log2(present.sum() / present))) + _FREQUENCY_BITS * len(present)


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
        self._models: list[tuple[I64, I64]] = []  # class of an expected size times TOTAL, decoding table
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
            self._models.append((classes * rans.TOTAL, rans.decoding_table(frequencies)))
        if len(raw) != size:
            raise impossible

    def __iter__(self) -> Iterator[NDArray[np.integer]]:
        """Yield each stream's (n,) integers.

        Raises:
            DataError: damaged.
        """
        lanes = self._lanes
        counts = lanes.counts.tolist()
        sizes_of = _SIZES[self._signed]
        for s in range(self._streams):
            classes, table = self._models[s % _CHANNELS]
            weights = self._weights[s]
            known = self._history.known()
            # Channels of the same coefficient that come later are not known yet: their weights do not count.
            expected = _expected(known, np.r_[weights[: len(known)], weights[-1:]])
            tokens = np.zeros(expected.shape, np.uint8)
            if weights[-2]:
                self._decode_recent(tokens, expected, weights[-2], counts, classes, table, sizes_of)
            else:
                expected >>= _WEIGHT_BITS
                for token, size, count in zip(tokens, expected, counts, strict=True):
                    self._rans.step(table, classes.take(size[:count], mode="clip"), token[:count])
            self._history.add(sizes_of[tokens])
            yield self._values(tokens)
        self._rans.finish()
        rest = self._bits[self._bits_read :]
        if len(rest) >= 8 or rest.any():
            raise self._damaged("holds more bits than its integers ask for")

    def _decode_recent(
        self,
        tokens: U8,
        expected: I32,
        weight: np.int32,
        counts: list[int],
        classes: I64,
        table: I64,
        sizes_of: I32,
    ) -> None:
        recent = np.zeros(tokens.shape[1], np.int32)
        twice = 2 * sizes_of
        for token, known, count in zip(tokens, expected, counts, strict=True):
            r = recent[:count]
            size = r * weight
            size += known[:count]
            size >>= _WEIGHT_BITS
            # What is below 0 or above the last size is taken as these.
            self._rans.step(table, classes.take(size, mode="clip"), token[:count])
            r -= r >> 2
            r += twice.take(token[:count], mode="clip")

    def _values(self, tokens: U8) -> NDArray[np.integer]:
        top = int(tokens.max())
        values: NDArray[np.integer]
        if top < _DIRECT and not self._predicted:
            small = tokens
            values = ((small >> 1) ^ (0 - (small & 1)).astype(np.uint8)).view(np.int8) if self._signed else small
            return self._lanes.join(values)
        above = np.maximum(tokens.astype(np.int64) - _DIRECT, 0)
        extra = _extra_bits(tokens)
        mapped = np.where(tokens < _DIRECT, tokens, (4 + above % 4) << extra)
        for b in range(int(extra.max())):
            has = extra > b
            need = int(np.count_nonzero(has))
            bits = self._bits[self._bits_read : self._bits_read + need]
            if len(bits) < need:
                raise self._damaged("ends too early")
            self._bits_read += need
            mapped[has] |= bits.astype(np.int64) << b
        values = (mapped >> 1) ^ -(mapped & 1) if self._signed else mapped
        if self._predicted:
            values = _predict(values.astype(np.int64))
        return self._lanes.join(values)
