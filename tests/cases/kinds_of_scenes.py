"""Rules, filters and SH degrees that derivatives of pictures are tried with: :data:`KINDS_OF_SCENES`."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from potr_cl.raster.rules import GSPLAT, INRIA

#: Each degree once, each rule and each filter with another one: in the quick subset.
_QUICK = [(INRIA, False, 0), (GSPLAT, False, 1), (INRIA, True, 2), (GSPLAT, True, 3)]

#: (rules, antialiased, degree), all of them.
KINDS_OF_SCENES: list[Any] = [
    pytest.param(
        *kind,
        id=f"{name}-{'antialiased' if kind[1] else 'classic'}-{kind[2]}",
        marks=() if kind in _QUICK else pytest.mark.slow,
    )
    for (name, rules), antialiased, degree in itertools.product(
        [("inria", INRIA), ("gsplat", GSPLAT)], [False, True], range(4)
    )
    for kind in [(rules, antialiased, degree)]
]
