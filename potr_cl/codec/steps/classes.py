"""Which steps each splat's colours have, of a block: :func:`colour_classes`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.table import definition
from potr_cl.codec.steps.rule import I8, ColourSteps

Levels = Sequence[NDArray[np.integer]]


@definition
def colour_classes(steps: ColourSteps, scales: Levels, opacities: NDArray[np.integer], start: int = 0) -> tuple[I8, I8]:
    """:meth:`ColourSteps.classes`."""
    return steps.classes(scales, opacities, start)


def _colour_classes_by_c(
    functions: Functions, steps: ColourSteps, scales: Levels, opacities: NDArray[np.integer], start: int = 0
) -> Any:
    group = 1 << steps.group_bits
    if start % group or any(levels.dtype.itemsize > 2 for levels in (*scales, opacities)):
        return NotImplemented
    own = replace(steps, groups=steps.groups[start // group :][: -(-len(opacities) // group)])
    return functions.step_classes(own, np.stack(scales, dtype=np.int32), opacities.astype(np.int32))
