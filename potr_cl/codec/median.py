"""The median of many numbers: :func:`median`, the same as NumPy's, in a fraction of its time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Numbers that a sample has; fewer are left to NumPy.
_SAMPLE = 1 << 14
#: Of the sample, to either side of its middle: six standard deviations of where the median of all lies in it.
_MARGIN = 3 * 128


def median(values: NDArray[np.float64]) -> float | None:
    """The median of (n,) float64, none of which is not a number; None of none.

    A sample says roughly where it is; only what lies there is looked at closely.
    """
    n = len(values)
    if n == 0:
        return None
    if n > 4 * _SAMPLE:
        sample = np.sort(values[:: n // _SAMPLE])
        middle = len(sample) // 2
        low, high = sample[middle - _MARGIN], sample[middle + _MARGIN]
        near = values[(values >= low) & (values <= high)]
        below = np.count_nonzero(values < low)
        first, last = (n - 1) // 2 - below, n // 2 - below
        if first >= 0 and last < len(near):
            near.partition((first, last))
            return float((near[first] + near[last]) / 2) if first != last else float(near[first])
    return float(np.median(values))
