"""Numbers in order: :func:`ascending`. Pure NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def ascending(score: NDArray[Any]) -> NDArray[np.int64]:
    """Stable argsort: by score, ties by number. The unstable sort is ten times as fast, and ties are few."""
    order = np.argsort(score)
    ordered = score[order]
    same = ordered[1:] == ordered[:-1]
    if same.any():
        tied = np.zeros(len(order), bool)
        tied[1:] = same
        tied[:-1] |= same
        members = order[tied]
        order[tied] = members[np.lexsort((members, score[members]))]
    return order
