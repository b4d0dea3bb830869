"""The plain coder of splats' integers: a section a property, its streams one after another, then zstd; and the values
of a block of it (:class:`PlainValues`).

As short as it can be: what the paper does, and for readers that have a zstd library and nothing else. docs/format.md,
"Plain streams", is the normative description.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, dequantizer
from potr_cl.codec.bundles.layout import BUNDLE, Bundles, Levels
from potr_cl.codec.container import MOST_PLANES, Block, CodedSection, EntropyCoder
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.sections import SH, Property
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.errors import DataError
from potr_cl.host.threads import Run, thread_pool

if TYPE_CHECKING:
    from potr_cl.codec.dequantizer import Activation, BundleTaker

U8 = NDArray[np.uint8]
Integers = NDArray[np.integer]


def pack(streams: Sequence[Integers], signed: bool) -> bytes:
    """The content of a section: bytes an integer of each stream, then each one's integers, lowest bytes first.

    Args:
        streams: (n,) each, below 2^56 once they are mapped to unsigned.
        signed: whether they may be negative, and so are zig-zag mapped: 0, −1, 1, −2, …
    """
    widths, planes = bytearray(), []
    for stream in streams:
        wide = stream.astype(np.int64)
        mapped = ((wide << 1) ^ (wide >> 63)).view(np.uint64) if signed else wide.view(np.uint64)
        widths.append((int(mapped.max(initial=0)).bit_length() + 7) // 8)
        columns = mapped.astype("<u8", copy=False).view(np.uint8).reshape(-1, 8)
        planes += [columns[:, p].tobytes() for p in range(widths[-1])]
    return bytes(widths) + b"".join(planes)


def unpack(planes: U8, signed: bool, start: int, stop: int) -> Integers:
    """Integers ``start`` to ``stop`` of byte planes (planes, n), in a narrow type that holds as many."""
    if not len(planes):
        return np.zeros(stop - start, np.int8)
    dtype = np.uint8 if len(planes) == 1 else np.uint16 if len(planes) == 2 else np.uint64
    mapped: NDArray[np.unsignedinteger] = planes[-1, start:stop].astype(dtype)
    for plane in planes[-2::-1]:
        mapped <<= dtype(8)
        mapped |= plane[start:stop]
    if not signed:
        return mapped.view(np.int64) if dtype is np.uint64 else mapped
    sign = dtype(0) - (mapped & dtype(1))  # wraps round to all ones, as it should
    return ((mapped >> dtype(1)) ^ sign).view(f"i{mapped.itemsize}")


def encode(
    values: Mapping[Property, Sequence[Integers]], coder: EntropyCoder, run: Run = map
) -> list[CodedSection] | None:
    """The sections of a block's integers; none of those that are all 0, but for opacity. None: one is too large.

    Args:
        values: of each property, (n,) each; DC's as they are.
        coder: its level of zstd counts.
        run: in place of :func:`map`, to work with several threads.
    """

    def section(prop: Property, streams: Sequence[Integers]) -> CodedSection | None:
        if prop is Property.SH0:
            streams = [stream - np.append(0, stream[:-1]) for stream in (own.astype(np.int64) for own in streams)]
        raw = pack(streams, prop.signed)
        return None if max(raw[: len(streams)]) > MOST_PLANES else coder.section(prop, raw)

    kept = [
        (prop, streams) for prop, streams in values.items() if prop is Property.OPACITY or any(map(np.any, streams))
    ]
    coded = list(run(lambda item: section(*item), kept))
    return coded if all(coded) else None


#: Bundles that a thread works on at a time, and threads that do: integers may be wide, and take memory.
_AT_A_TIME, _MOST_THREADS = 3, 2


@dataclass(frozen=True)
class PlainValues:
    """A block's splats but for their centres; attributes as of :class:`potr_cl.codec.block_values.BlockValues`."""

    block: Block
    data: bytes | memoryview
    open_steps: Callable[[], ColourSteps | None]
    activation: Activation | None = None

    def fill(self, arrays: ValueArrays, threads: int = 1, beside: Callable[[], None] | None = None) -> None:
        """As :meth:`potr_cl.codec.block_values.BlockValues.fill`."""
        with thread_pool(min(threads, _MOST_THREADS)) as pool:
            other = None if beside is None else pool.submit(beside)
            self._open(arrays)
            list(pool.map(lambda bundles: self._fill(bundles, arrays), self._parts))
            if other is not None:
                other.result()

    def pack(
        self, destination: BundleTaker, sh_count: int, threads: int, means: Callable[[], NDArray[np.float32]]
    ) -> None:
        """As :meth:`potr_cl.codec.block_values.BlockValues.pack`."""
        destination.expect_bundles()
        destination.take_means(means())
        for bundles in self._parts:

            def filled(arrays: ValueArrays, bundles: range = bundles) -> None:
                self._open(arrays)
                self._fill(bundles, arrays)

            dequantizer.pack(destination, self.block, sh_count, bundles, filled)

    @property
    def _parts(self) -> list[range]:
        number = Bundles(self.block.splats).number
        return [range(first, min(first + _AT_A_TIME, number)) for first in range(0, number, _AT_A_TIME)]

    @cached_property
    def _steps(self) -> ColourSteps | None:
        return self.open_steps()

    @cached_property
    def _planes(self) -> dict[Property, list[U8]]:
        """Of each property that was opened, the planes of each stream."""
        return {}

    @cached_property
    def _dc(self) -> list[NDArray[np.int64]]:
        """(n,) Y, Co, Cg: sums of what is stored."""
        return [
            np.cumsum(unpack(planes, True, 0, self.block.splats), dtype=np.int64)
            for planes in self._planes[Property.SH0]
        ]

    def _open(self, arrays: ValueArrays) -> None:
        """Unpack what some arrays are made of. Raises DataError if damaged."""
        degrees = SH[: 0 if arrays.sh is None else round(len(arrays.sh) ** 0.5)]
        rotations = arrays.quaternions is not None
        scales = rotations or arrays.log_scales is not None or bool(degrees and self._steps is not None)
        shapes = [*([Property.SCALE] if scales else []), *([Property.ROTATION] if rotations else [])]
        for prop in (Property.OPACITY, *shapes, *degrees):
            self._planes[prop] = self._planes.get(prop) or self._streams(prop)
        if degrees:
            _ = self._dc

    def _streams(self, prop: Property) -> list[U8]:
        section, splats = self.block.find(prop), self.block.splats
        if section is None:
            return [np.empty((0, splats), np.uint8)] * prop.streams
        raw = container.read_section(self.data, section)
        widths = raw[: prop.streams].astype(np.int64)
        if (
            len(widths) < prop.streams
            or int(widths.max()) > MOST_PLANES
            or len(raw) != prop.streams + splats * int(widths.sum())
        ):
            raise DataError(f"section '{prop.title}' does not hold an integer of each splat")
        parts = np.split(raw[prop.streams :], np.cumsum(widths)[:-1] * splats)
        return [part.reshape(-1, splats) for part in parts]

    def _fill(self, bundles: range, arrays: ValueArrays) -> None:
        start, stop = bundles.start * BUNDLE, min(bundles.stop * BUNDLE, self.block.splats)

        def some(prop: Property) -> list[Integers]:
            return [unpack(planes, prop.signed, start, stop) for planes in self._planes.get(prop, [])]

        levels = Levels(start, stop, some(Property.OPACITY)[0], predicted=False)
        levels.scales, levels.rotations = some(Property.SCALE) or None, some(Property.ROTATION) or None
        if Property.SH0 in self._planes:
            levels.dc = [channel[start:stop] for channel in self._dc]
        rest = [stream for prop in SH[1:] for stream in some(prop)]
        levels.dense = [rest[m : m + 3] for m in range(0, len(rest), 3)]
        dequantizer.fill(arrays, self.block, levels, self._steps if arrays.sh is not None else None, self.activation)
