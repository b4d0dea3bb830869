"""Integers to byte planes and back, as every coder but the context coder stores them (docs/format.md, "Integers")."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.library import native


def pack_integers(values: NDArray[np.integer], signed: bool) -> tuple[bytes, int]:
    """Integers to byte planes, lowest byte first; zig-zag mapped (0, −1, 1, −2, …) if signed.

    Returns:
        The planes one after another, and their number: the fewest that hold the largest integer, 0 if all are 0.
    """
    wide = values.astype(np.int64)
    mapped = ((wide << 1) ^ (wide >> 63)).view(np.uint64) if signed else wide.view(np.uint64)
    planes = (int(mapped.max(initial=0)).bit_length() + 7) // 8
    columns = mapped.astype("<u8", copy=False).view(np.uint8).reshape(-1, 8)
    return b"".join(columns[:, p].tobytes() for p in range(planes)), planes


def unpack_integers(raw: NDArray[np.uint8], planes: int, signed: bool, start: int, stop: int) -> NDArray[np.integer]:
    """Integers ``start`` to ``stop`` of byte planes (planes x count,), in the narrowest type that holds as many."""
    count = len(raw) // planes if planes else 0
    if planes == 0:
        return np.zeros(stop - start, np.int8)
    if planes == 1:
        mapped: NDArray[np.unsignedinteger] = raw[start:stop]
    else:
        dtype = np.uint16 if planes == 2 else np.uint32 if planes <= 4 else np.uint64
        mapped = raw[(planes - 1) * count + start : (planes - 1) * count + stop].astype(dtype)
        for p in reversed(range(planes - 1)):
            mapped <<= dtype(8)
            mapped |= raw[p * count + start : p * count + stop]
    if not signed:
        return mapped
    half = mapped >> mapped.dtype.type(1)
    sign = mapped & mapped.dtype.type(1)
    # 0 − 1 wraps round to all ones, as it should.
    np.subtract(mapped.dtype.type(0), sign, out=sign)
    half ^= sign
    return half.view(half.dtype.str.replace("u", "i"))


class IntegerStream(Protocol):
    """The integers of a stream, one a splat."""

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one splat to another."""

    @property
    def joined(self) -> NDArray[Any]:
        """All of them: uint8, mapped to unsigned, where they are that small; else 32 or 64 bits each."""


@dataclass(frozen=True)
class PlaneStream:
    """Integers of byte planes, as long as nobody needs them.

    Attributes:
        raw: (planes · count,) uint8; of no planes if all integers are 0.
        planes: number of planes.
        signed: whether the integers were mapped.
        count: number of integers.
    """

    raw: NDArray[np.uint8]
    planes: int
    signed: bool
    count: int

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one place to another."""
        return unpack_integers(self.raw, self.planes, self.signed, start, stop)

    @cached_property
    def joined(self) -> NDArray[Any]:
        """All of them: uint8, mapped to unsigned, where they are that small; else 32 or 64 bits each."""
        if self.planes == 0:
            return np.zeros(self.count, np.uint8)
        if self.planes == 1:
            return self.raw
        functions = native()
        if functions is not None:
            return functions.join_planes(self.raw, self.planes, self.signed)
        return self.part(0, self.count).astype(np.int64 if self.signed else np.uint64)
