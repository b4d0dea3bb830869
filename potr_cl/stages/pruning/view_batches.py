"""Views of a large scene that the memory has no room for, made again together: :class:`Batch`, :func:`dealt_out`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.stages.pruning.launcher import SetKernels
from potr_cl.stages.pruning.prepared_views import PreparedSet
from potr_cl.views.visibility import Visibility

#: Bytes that these views take while they are there: of each one's splats, and of those of all together.
_OWN, _TOGETHER = 70, 56
#: How many they are at most, and how many times as many splats as one of them (on the average) they see together at
#: most.
_MOST, _SPREAD = 16, 4.0


@dataclass
class Batch:
    """Views that are made again together.

    Attributes:
        numbers: of them among all views.
        wanted: (G,) the groups of which they may draw splats.
        targets: their pictures before any removal, one after the other; None: they are made again too.
        known: whether the targets are there.
    """

    numbers: list[int]
    wanted: NDArray[np.bool_]
    targets: cl.Buffer | None = None
    known: bool = False


@dataclass(frozen=True)
class Ready:
    """A batch's views, ready to be swept.

    Attributes:
        prepared: their lists and sums.
        numbers: of the splats that they were prepared with, in the device's memory, and splats: how many these are.
        kernels: with all arguments bound; the target is yet to be stored.
    """

    prepared: PreparedSet
    numbers: cl.Buffer
    splats: int
    kernels: SetKernels


def dealt_out(others: Sequence[int], sights: Visibility, targets: NDArray[np.int64], passing: int) -> list[Batch]:
    """Views in batches of neighbours, each of which takes no more bytes than may pass, if that can be.

    Args:
        others: numbers of the views, in an order in which neighbours see much of the same.
        sights: what each of all views may draw.
        targets: (all views,) bytes of their pictures.
        passing: bytes that a batch may take while it is there.
    """
    totals, counts = sights.totals, sights.groups.counts
    batches: list[Batch] = []
    for number in others:
        wanted = sights.seen[number]
        if batches:
            numbers = [*batches[-1].numbers, number]
            together = batches[-1].wanted | wanted
            seen, own = len(numbers) * int(counts[together].sum()), int(totals[numbers].sum())
            nbytes = _TOGETHER * seen + _OWN * own + int(targets[numbers].sum())
            if len(numbers) <= _MOST and nbytes <= passing and seen <= _SPREAD * own:
                batches[-1] = Batch(numbers, together)
                continue
        batches.append(Batch([number], wanted))
    return batches
