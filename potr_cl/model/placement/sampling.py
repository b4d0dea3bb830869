"""Points spread evenly in a cube and on a sphere, the same ones every time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def low_discrepancy(count: int, dimensions: int) -> F64:
    """(count, dimensions) evenly spread in the unit cube: the additive recurrence on the generalised golden ratio.

    M. Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return (0.5 + np.outer(np.arange(1, count + 1), ratio ** -np.arange(1.0, dimensions + 1))) % 1


def on_sphere(square: F64) -> F64:
    """(n, 2) in the unit square to (n, 3) unit vectors, areas kept."""
    z = 2 * square[:, 0] - 1
    turn = 2 * np.pi * square[:, 1]
    side = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)
