"""The natural logarithm of a decoder: :func:`natural_logarithm`, with the same bits on every processor.

NumPy's own has different bits where a processor has other vector instructions. Here are additions, multiplications and
divisions of float64 alone, each in an array operation of its own, so that none is fused with another: IEEE 754 leaves
them no choice. The result is the true logarithm, rounded to the nearest float32, as docs/format.md asks: that was
compared for all numbers from 2^-33 to 2^76, and a file can hold no others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: The float64 nearest to the logarithm of 2, and the one nearest to the root of 1/2.
_LN2, _ROOT_HALF = 0.6931471805599453, 0.7071067811865476
#: artanh t = t (1 + t²/3 + t⁴/5 + …): enough terms for float64 where |t| < 0.172.
_SERIES = [1 / (2 * k + 1) for k in range(11)]
#: The only number whose logarithm float64 cannot tell from the middle between two of float32, and that logarithm.
_HARD = np.float32(float.fromhex("0x1.bacb4ap+25")), np.float32(float.fromhex("0x1.1e0696p+4"))


def natural_logarithm(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Natural logarithms, (n,) float32, of float32 numbers from 2^-33 to 2^76, each the nearest there is."""
    mantissa, exponent = np.frexp(values.astype(np.float64))
    low = mantissa < _ROOT_HALF
    mantissa = np.where(low, mantissa + mantissa, mantissa)
    exponent = (exponent - low).astype(np.float64)
    t = (mantissa - 1) / (mantissa + 1)
    square = t * t
    total = np.full_like(t, _SERIES[-1])
    for coefficient in _SERIES[-2::-1]:
        total *= square
        total += coefficient
    total *= t
    total += total
    exponent *= _LN2
    exponent += total
    logarithms = exponent.astype(np.float32)
    logarithms[values == _HARD[0]] = _HARD[1]
    return logarithms
