"""What a file can hold of a scene's colours, where each splat has steps of its own: :class:`ColourGrid`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.blocks import AnyGeometry
from potr_cl.codec.steps.rule import factors


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

    @staticmethod
    def of(geometry: AnyGeometry) -> ColourGrid:
        """That of a .potr file."""
        dc, ac = geometry.colour_classes()
        steps = np.empty((2, len(geometry.order)), np.float32)
        steps[0, geometry.order] = 1 / factors(geometry.parameters.sf_dc, dc)
        steps[1, geometry.order] = 1 / factors(geometry.parameters.sf_sh, ac)
        return ColourGrid(steps[0], steps[1], geometry.order)
