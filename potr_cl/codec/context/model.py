"""A section's model, as both directions have it: expected sizes of tokens, contexts by them, frequencies in a context.

Streams come in threes, the *channels*: those of an SH coefficient, or the axes. Each channel has frequencies of its
own; each stream has weights of its own, which make an expected size of the sizes that are known.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec import rans
from potr_cl.codec.context.lanes import Lanes
from potr_cl.codec.context.tokens import ALPHABET
from potr_cl.codec.native.library import native
from potr_cl.errors import DataError

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

#: Streams that belong together, and so the most models of a section.
CHANNELS = 3
#: Weights a stream: the sums of three channels, two channels of the same coefficient, recent ones, constant.
TERMS = 7
#: Expected sizes are from 0 to this.
LARGEST_SIZE = 255
#: A channel has at most so many contexts.
MOST_CONTEXTS = 32

#: Of a section's bytes: how many describe its model, and how many hold the bits beside tokens.
HEAD = struct.Struct("<II")
_WEIGHTS = np.dtype("<i2")


class Sizes:
    """Sums of the sizes of all streams so far, by channel: what later streams' contexts are made of.

    Args:
        lanes: of the splats.
    """

    def __init__(self, lanes: Lanes) -> None:
        shape = (lanes.steps, lanes.number)
        # The sums of 15 coefficients' sizes fit 16 bits, which the native path takes; NumPy is faster with 32.
        dtype: type[np.signedinteger] = np.int32 if native() is None else np.int16
        self._sums = [np.zeros(shape, dtype) for _ in range(CHANNELS)]
        self._same = [np.empty(shape, dtype) for _ in range(CHANNELS)]
        self._channels = 0

    def known(self) -> list[Any]:
        """The terms of the next stream's expectation, in the order of their weights, but recent ones and constant."""
        return [*self._sums, *self._same[: self._channels]]

    @property
    def next(self) -> NDArray[Any]:
        """(steps, lanes): where the next stream's sizes go, before :meth:`added`."""
        return self._same[self._channels]

    def added(self) -> None:
        """Take in the next stream, whose sizes stand in :attr:`next`."""
        self._channels += 1
        if self._channels == CHANNELS:
            for total, part in zip(self._sums, self._same, strict=True):
                total += part
            self._channels = 0


@dataclass(frozen=True)
class Model:
    """Contexts by expected size.

    Attributes:
        classes: (256,) uint8 context of each expected size, never falling.
        frequencies: (contexts, tokens), every row adding up to :data:`potr_cl.codec.rans.TOTAL`.
    """

    classes: U8
    frequencies: I64


def write_description(weights: NDArray[np.int16], models: Sequence[Model]) -> bytes:
    """The stored description of a section: (streams, TERMS) weights and a model for each channel."""
    raw = weights.astype(_WEIGHTS).tobytes() + b"".join(map(model_bytes, models))
    return zstandard.ZstdCompressor(level=19, write_checksum=False).compress(raw)


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


def read_description(stored: memoryview, streams: int, what: str) -> tuple[I32, list[Model]]:
    """Weights and models of a section of some streams; nothing in the bytes is trusted.

    Args:
        stored: as of :func:`write_description`.
        streams: number of streams.
        what: the section, for messages.

    Raises:
        DataError: damaged.
    """
    channels = min(CHANNELS, streams)
    most = 2 * TERMS * streams + channels * (2 + MOST_CONTEXTS - 1 + 2 * MOST_CONTEXTS * ALPHABET)
    raw = inflate(stored, most, what)
    read = 2 * TERMS * streams
    if len(raw) < read:
        raise _impossible(what)
    weights = np.frombuffer(raw[:read], _WEIGHTS).reshape(-1, TERMS).astype(np.int32)
    return weights, read_models(raw, read, [ALPHABET] * channels, what)


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
        if not rising or (frequencies.sum(axis=1) != rans.TOTAL).any():
            raise _impossible(what)
        widths = [b - a for a, b in pairwise((0, *thresholds, LARGEST_SIZE + 1))]
        classes = np.repeat(np.arange(contexts, dtype=np.uint8), widths)
        models.append(Model(classes, frequencies))
    if len(raw) != read:
        raise _impossible(what)
    return models


def inflate(stored: memoryview, most: int, what: str) -> bytes:
    """A stored description of at most ``most`` bytes.

    Raises:
        DataError: damaged.
    """
    try:
        if not 0 <= zstandard.get_frame_parameters(stored).content_size <= most:
            raise DataError(f"section '{what}' describes its contexts at an impossible length")
        return zstandard.ZstdDecompressor().decompress(stored, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise DataError(f"section '{what}' does not decompress: {error}") from None


def _impossible(what: str) -> DataError:
    return DataError(f"section '{what}' describes impossible contexts")
