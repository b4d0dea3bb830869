"""What a section says of its streams: the numbers that tell contexts, and the frequencies of tokens in each.

:class:`Fitted` is that of one stream; :func:`write_description` and :func:`read_description` are the two directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.bundles.model import (
    KNOWN_RECENT,
    KNOWN_TOKENS,
    MOST_CONTEXTS,
    Model,
    inflate,
    known_model,
    model_bytes,
    read_models,
)
from potr_cl.codec.bundles.streams import Stream
from potr_cl.errors import DataError

I64 = NDArray[np.int64]

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
