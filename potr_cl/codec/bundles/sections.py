"""The sections of coder BUNDLES and the order in which they are decoded: :class:`Section` takes one's bytes apart.

The sections of a file belong to two *chains*, in which the states of the range coder go on from section to section:
opacities, scales, DC and AC coefficients, degree by degree; and rotations, which no other section needs. So a chain is
read from its beginning, as far as one likes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted, read_description, write_description
from potr_cl.codec.bundles.layout import Bundles
from potr_cl.codec.bundles.ranges import Words
from potr_cl.codec.bundles.streams import LOWEST, largest_integer, streams_of
from potr_cl.codec.sections import SH, Property
from potr_cl.errors import DataError
from potr_cl.native.declarations import fits

#: Of a section's bytes: how many describe its streams.
_HEAD = struct.Struct("<I")
#: The chain of sections whose states follow each other; the first one has the states.
MAIN = (Property.OPACITY, Property.SCALE, *SH)
ROTATION = Property.ROTATION
#: All sections, in the order of decoding.
ORDER = (*MAIN, ROTATION)


class Section:
    """A section's bytes, taken apart.

    Args:
        key: its property.
        stored: the bytes; nothing in them is trusted.
        bundles: of the file.
        what: for messages.

    Raises:
        DataError: damaged.
    """

    def __init__(self, key: Property, stored: memoryview, bundles: Bundles, what: str) -> None:
        self.key, self.what = key, what
        states = int(bundles.lanes.sum()) if key in (MAIN[0], ROTATION) else 0
        number = bundles.number
        if len(stored) < _HEAD.size:
            raise self._damaged("ends too early")
        (described,) = _HEAD.unpack_from(stored)
        at = _HEAD.size + described
        if at + 4 * (states + number) > len(stored):
            raise self._damaged("ends too early")
        self.streams: list[Fitted] = read_description(stored[_HEAD.size : at], streams_of(key), what)
        self.states = np.frombuffer(stored, "<u4", states, at)
        if (self.states < LOWEST).any():
            raise self._damaged("holds an impossible state")
        at += 4 * states
        self.counts = np.frombuffer(stored, "<u4", number, at).astype(np.int64)
        at += 4 * number
        if len(stored) - at != 2 * int(self.counts.sum()):
            raise self._damaged("does not hold the words that its bundles ask for")
        self.words = np.frombuffer(stored, np.uint8, len(stored) - at, at)
        self.starts = np.cumsum(self.counts) - self.counts

    def of(self, first: int, last: int) -> Words:
        """Words of some bundles."""
        start = int(self.starts[first])
        counts = self.counts[first:last]
        words = self.words[2 * start : 2 * (start + int(counts.sum()))].view("<u2")
        return Words(words, counts, self.what)

    @property
    def fits(self) -> bool:
        """Whether the native path can take its integers; real files' are narrow enough by far."""
        return all(fits(largest_integer(fitted.alphabet - 1)) for fitted in self.streams)

    def _damaged(self, how: str) -> DataError:
        return DataError(f"section '{self.what}' {how}")


def stored_section(
    streams: Sequence[Fitted], states: NDArray[Any] | None, counts: NDArray[Any], words: NDArray[Any]
) -> bytes:
    """The stored bytes of a section.

    Args:
        streams: what it says of them.
        states: (lanes,) of all bundles, where it begins a chain.
        counts: (bundles,) words of each.
        words: of all bundles.
    """
    described = write_description(streams)
    first = b"" if states is None else states.astype("<u4").tobytes()
    return b"".join(
        [_HEAD.pack(len(described)), described, first, counts.astype("<u4").tobytes(), words.astype("<u2").tobytes()]
    )
