"""Arrays as C takes them: where their numbers are (:func:`address`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
