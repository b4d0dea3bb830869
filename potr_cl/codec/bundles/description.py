"""What a section says of its streams: the numbers that tell contexts, and the frequencies of tokens in each.

:class:`Fitted` is that of one stream, with its :class:`Model`; :func:`write_description` and :func:`read_description`
are the two directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.bundles import streams
from potr_cl.codec.bundles.streams import Stream, token_floors
from potr_cl.errors import DataError

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

#: Expected sizes are from 0 to this.
LARGEST_SIZE = 255
#: A stream has at most so many contexts.
MOST_CONTEXTS = 32

#: Of what decoders know: the weight of the recent sizes, and the most tokens, those of integers below 2^29; expected
#: sizes of a context; 64 times what the first two contexts have for c; the largest integer that counts.
KNOWN_RECENT, KNOWN_TOKENS = 28, 216
_KNOWN_SIZES, _KNOWN_ROOTS, _FARTHEST = 8, (4096, 5793), 1 << 20


@dataclass(frozen=True)
class Model:
    """Contexts by expected size.

    Attributes:
        classes: (256,) uint8 context of each expected size, never falling.
        frequencies: (contexts, tokens), every row adding up to :data:`potr_cl.codec.bundles.streams.TOTAL`.
    """

    classes: U8
    frequencies: I64


@lru_cache(maxsize=8)
def known_model(tokens: int) -> Model:
    """The model of so many tokens that decoders know: its contexts are for 8 expected sizes each.

    In context k the integers at x and above have the part c² / (c + 16 x)² of all, with c growing by the root of 2 from
    context to context, and each token a frequency of 1 besides.
    """
    starts = np.minimum(token_floors(), _FARTHEST)[:tokens]
    classes = np.arange(LARGEST_SIZE + 1) // _KNOWN_SIZES
    frequencies = np.empty((MOST_CONTEXTS, tokens), np.int64)
    for k, row in enumerate(frequencies):
        c = (_KNOWN_ROOTS[k % 2] << k // 2) >> 6
        reach = (c + 16 * starts) ** 2
        below = (streams.TOTAL - tokens) * (reach - c * c) // reach + np.arange(tokens)
        row[:] = np.diff(below, append=streams.TOTAL)
    return Model(classes.astype(np.uint8), frequencies)


def model_bytes(model: Model) -> bytes:
    """A model as descriptions hold it."""
    thresholds = np.flatnonzero(np.diff(model.classes)).astype(np.uint8) + 1
    used = int(np.flatnonzero(model.frequencies.any(axis=0))[-1]) + 1
    planes = np.ascontiguousarray(model.frequencies[:, :used].T.astype("<u2"))
    return (
        bytes([len(model.frequencies), used])
        + thresholds.astype(np.uint8).tobytes()
        + (planes & 255).astype(np.uint8).tobytes()
        + (planes >> 8).astype(np.uint8).tobytes()
    )


def read_models(raw: bytes, read: int, most_tokens: Sequence[int], what: str) -> list[Model]:
    """The models that fill some bytes to their end; nothing in them is trusted.

    Args:
        raw: the bytes.
        read: how many of them are read already.
        most_tokens: of each model, at most 255.
        what: the section, for messages.

    Raises:
        DataError: damaged.
    """
    models = []
    for most in most_tokens:
        if len(raw) < read + 2:
            raise _impossible(what)
        contexts, used = raw[read], raw[read + 1]
        read += 2
        cells = contexts * used
        if not (1 <= contexts <= MOST_CONTEXTS and 1 <= used <= most) or len(raw) < read + contexts - 1 + 2 * cells:
            raise _impossible(what)
        thresholds = raw[read : read + contexts - 1]
        read += contexts - 1
        planes = np.frombuffer(raw, np.uint8, 2 * cells, read).astype(np.int64)
        read += 2 * cells
        frequencies = (planes[:cells] + (planes[cells:] << 8)).reshape(used, contexts).T
        rising = all(a < b for a, b in pairwise(b"\0" + thresholds))
        if not rising or (frequencies.sum(axis=1) != streams.TOTAL).any():
            raise _impossible(what)
        widths = [b - a for a, b in pairwise((0, *thresholds, LARGEST_SIZE + 1))]
        classes = np.repeat(np.arange(contexts, dtype=np.uint8), widths)
        models.append(Model(classes, frequencies))
    if len(raw) != read:
        raise _impossible(what)
    return models


def inflate(stored: memoryview, most: int, what: str) -> bytes:
    """A stored description of at most ``most`` bytes. Raises DataError if damaged."""
    try:
        if not 0 <= zstandard.get_frame_parameters(stored).content_size <= most:
            raise DataError(f"section '{what}' describes its contexts at an impossible length")
        return zstandard.ZstdDecompressor().decompress(stored, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise DataError(f"section '{what}' does not decompress: {error}") from None


def _impossible(what: str) -> DataError:
    return DataError(f"section '{what}' describes impossible contexts")


_WEIGHTS = np.dtype("<i2")


@dataclass(frozen=True)
class Fitted:
    """A stream, and what was fitted to a scene.

    Attributes:
        stream: which it is.
        numbers: (stream.weights,) int64 weights of the terms, of the recent sizes, constant, biases of coefficients.
        model: contexts by expected size.
        known: whether all decoders know it: it is not stored.
    """

    stream: Stream
    numbers: I64
    model: Model
    known: bool = False

    @staticmethod
    @lru_cache(maxsize=64)
    def without(stream: Stream) -> Fitted:
        """What a stream has of which nothing is stored."""
        numbers = np.zeros(stream.weights, np.int64)
        numbers[len(stream.terms)] = KNOWN_RECENT
        return Fitted(stream, numbers, known_model(min(stream.most_tokens, KNOWN_TOKENS)), known=True)

    @property
    def terms(self) -> I64:
        return self.numbers[: len(self.stream.terms)]

    @property
    def recent(self) -> int:
        return int(self.numbers[len(self.stream.terms)])

    @property
    def constant(self) -> int:
        return int(self.numbers[len(self.stream.terms) + 1])

    @property
    def biases(self) -> I64:
        """One for each coefficient of the section, if the stream has them."""
        return self.numbers[len(self.stream.terms) + 2 :]

    @property
    def classes(self) -> NDArray[np.uint8]:
        return self.model.classes

    @property
    def frequencies(self) -> I64:
        return self.model.frequencies

    @property
    def alphabet(self) -> int:
        """Tokens that there are frequencies of."""
        return int(self.model.frequencies.shape[1])


def write_description(streams: Sequence[Fitted]) -> bytes:
    """The stored description of a section; none where nothing needs to be stored."""
    if all(fitted.known for fitted in streams):
        return b""
    numbers = b"".join(fitted.numbers.astype(_WEIGHTS).tobytes() for fitted in streams)
    raw = numbers + b"".join(model_bytes(fitted.model) for fitted in streams)
    return zstandard.ZstdCompressor(level=19, write_checksum=False).compress(raw)


def read_description(stored: memoryview, streams: Sequence[Stream], what: str) -> list[Fitted]:
    """What a section says of its streams; nothing in the bytes is trusted.

    Args:
        stored: as of :func:`write_description`.
        streams: of the section.
        what: the section, for messages.

    Raises:
        DataError: damaged.
    """
    if not len(stored):
        return [Fitted.without(stream) for stream in streams]
    weights = sum(stream.weights for stream in streams)
    tokens = [stream.most_tokens for stream in streams]
    most = 2 * weights + sum(2 + MOST_CONTEXTS - 1 + 2 * MOST_CONTEXTS * number for number in tokens)
    raw = inflate(stored, most, what)
    if len(raw) < 2 * weights:
        raise DataError(f"section '{what}' describes impossible contexts")
    numbers = np.frombuffer(raw[: 2 * weights], _WEIGHTS).astype(np.int64)
    models = read_models(raw, 2 * weights, tokens, what)
    ends = np.cumsum([stream.weights for stream in streams])
    return [
        Fitted(stream, part, model)
        for stream, part, model in zip(streams, np.split(numbers, ends[:-1]), models, strict=True)
    ]
