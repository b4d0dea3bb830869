"""What a file's sections are: the properties that they hold, the streams of each property, and a table entry.

A *stream* is a sequence of integers; most hold one integer a splat. Coders CONTEXT and BUNDLES store several streams in
one section, every other coder one.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Property(enum.IntEnum):
    """What a section holds."""

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


class Coder(enum.IntEnum):
    """How a section's integers are stored."""

    RAW = 0
    ZSTD = 1
    DEFLATE = 2
    CONTEXT = 3
    BUNDLES = 4

    @property
    def of_streams(self) -> bool:
        """Whether it stores several streams in a section, as integers and not as bytes."""
        return self in (Coder.CONTEXT, Coder.BUNDLES)


_STREAMS = {
    Property.METADATA: 1,
    Property.OCCUPANCY: 1,
    Property.SEVERAL: 1,
    Property.MULTIPLICITY: 1,
    Property.TAIL_LENGTH: 1,
    Property.TAIL: 1,
    Property.STEPS: 1,
    Property.SCALE: 3,
    Property.ROTATION: 3,
    Property.OPACITY: 1,
    Property.SH: 48,
}
_SIGNED = {Property.ROTATION, Property.SH}
_PER_SPLAT = {Property.SCALE, Property.ROTATION, Property.OPACITY, Property.SH}
_BYTES = {
    Property.METADATA,
    Property.OCCUPANCY,
    Property.SEVERAL,
    Property.TAIL_LENGTH,
    Property.TAIL,
    Property.STEPS,
}


@dataclass(frozen=True)
class Section:
    """One entry of the section table.

    Attributes:
        kind: what it holds.
        index: of its first stream within the property: the axis of a scale or rotation; 3 · coefficient + channel of
            SH; else 0.
        coder: how it is stored.
        crc: CRC-32 of the stored bytes.
        streams: number of streams in it; more than one for coders of streams only.
        integers: number of integers in it, those of all streams together; bytes where the property is one of bytes.
        planes: bytes an integer before the coder; 0 for coders of streams, whose integers are never bytes.
        stored_bytes: its size in the file.
        offset: of the stored bytes in the file.
    """

    kind: Property
    index: int
    coder: Coder
    crc: int
    streams: int
    integers: int
    planes: int
    stored_bytes: int
    offset: int = 0

    @property
    def raw_bytes(self) -> int | None:
        """Size before the coder; None for coders of streams, where there is no such thing."""
        return None if self.coder.of_streams else self.planes * self.integers

    @property
    def indices(self) -> range:
        """Of its streams within the property."""
        return range(self.index, self.index + self.streams)

    @property
    def name(self) -> str:
        """For messages and tables."""
        return self.kind.name.lower() + (f" {self.index}" if _STREAMS[self.kind] > 1 else "")


def stream_count(prop: Property) -> int:
    """The most streams that a property can have."""
    return _STREAMS[prop]


def is_signed(prop: Property) -> bool:
    """Whether a property's integers can be negative, and so are zig-zag mapped."""
    return prop in _SIGNED


def is_per_splat(prop: Property) -> bool:
    """Whether a property's streams hold one integer a splat."""
    return prop in _PER_SPLAT


def is_bytes(prop: Property) -> bool:
    """Whether a property's integers are bytes whose number means something, zeros included."""
    return prop in _BYTES


def is_predicted(prop: Property, index: int) -> bool:
    """Whether coders of streams store a property's differences from the splats before."""
    return prop == Property.SH and index == 0


def context_groups(prop: Property, degree: int) -> list[tuple[int, int]]:
    """The sections of coders of streams that a property can have: index and number of streams of each."""
    if prop == Property.SH:
        return [(3 * band**2, 3 * (2 * band + 1)) for band in range(degree + 1)]
    return [(0, _STREAMS[prop])] if prop in _PER_SPLAT else []
