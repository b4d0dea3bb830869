"""Arrays as C takes them: where their numbers are (:func:`address`), and of which kind integers are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: What integers of each kind are stored as; those of 64 bits may be unsigned.
KINDS: dict[str, type[np.generic]] = {"narrow": np.uint8, "medium": np.int32, "wide": np.int64}


def address(array: NDArray[Any], dtype: type[np.generic], number: int, writable: bool = False) -> int:
    """Where an array's numbers are, once it is sure that they are as many, of that type, and one after another.

    Raises:
        TypeError: they are not, or cannot be written to.
    """
    if array.dtype != dtype or array.size != number or not array.flags.c_contiguous or not array.flags.aligned:
        raise TypeError(f"the native path takes {number} of {np.dtype(dtype)}, not {array.size} of {array.dtype}")
    if writable and not array.flags.writeable:
        raise TypeError("the native path cannot write to a read-only array")
    where: int = array.__array_interface__["data"][0]  # what array.ctypes.data says, in a fraction of its time
    return where


def kind_of(levels: NDArray[Any]) -> str:
    """The kind of integers, by their size."""
    return {1: "narrow", 4: "medium", 8: "wide"}[levels.itemsize]


def addresses(kind: str, levels: Sequence[NDArray[Any]], number: int) -> list[int]:
    """Where levels of one kind are; int64 and uint64 are the same to C, where sums wrap round."""
    dtype = KINDS[kind]
    return [address(level.view(dtype) if kind == "wide" else level, dtype, number) for level in levels]
