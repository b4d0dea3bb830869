"""What a file can hold of a scene's colours, where each splat has steps of its own: :class:`ColourGrid`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ColourGrid:
    """Coefficients of Y, Co and Cg that are whole multiples of the splats' steps.

    Attributes:
        constant: (N,) float32, steps of the constant coefficients, in the order of the scene.
        others: (N,) float32, of all other coefficients.
        order: (N,) int64, the number in the scene of each splat of the file, in which neighbours follow each other.
    """

    constant: NDArray[np.float32]
    others: NDArray[np.float32]
    order: NDArray[np.int64]
