"""How many views between the training views a scene needs (:func:`needed`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Views that should show each part of a scene: twice the 16 coefficients that a colour channel of a splat has. With
#: fewer, many colours fit what the views show, and the one that is chosen need not fit what lies between them.
_ENOUGH = 32
#: The part of the scene that may be shown by fewer.
_PART = 0.25
#: Fewer than this for each training view bring too little.
_LEAST = 0.25
_MOST, _MOST_ON_CPU = 5.0, 2.0
#: An added view takes as much time as a training view. So that an encode takes at most 1.6 times as long, added views
#: are a part of the training views, and some more where an encode does much besides looking at views, as on GPUs.
_SHARE = 0.45
#: Where fewer views than this show parts of the scene, what lies between is matched many decibels worse than they are.
#: There a GPU may take up to 2.2 times as long.
_FEW, _SHARE_OF_FEW = 10, 1.0
_BESIDES, _BESIDES_ON_CPU = 45, 4


def needed(shown_by: float, views: int, slow: bool) -> float:
    """How many to add for each training view.

    Args:
        shown_by: how many training views show the scene where few do, as :func:`views_where_few` finds it.
        views: the number of training views.
        slow: whether a CPU has to look at them.
    """
    few = shown_by < _FEW and not slow
    each = min(_ENOUGH / max(shown_by, 1.0) - 1, most_needed(views, slow, few))
    return each if each >= _LEAST else 0.0


def views_where_few(views_of_parts: NDArray[np.int64]) -> float:
    """How many views at most show the quarter of a scene that the fewest show.

    Args:
        views_of_parts: (K,) how many training views show each part of the scene
            (:meth:`potr_cl.model.given_views.GivenViews.views_of_parts`), at least one.
    """
    return float(np.quantile(views_of_parts, _PART))


def most_needed(views: int, slow: bool, few: bool = False) -> float:
    """How many are added for each of so many training views at most; ``few``: whether few of them show some part."""
    most, besides = (_MOST_ON_CPU, _BESIDES_ON_CPU) if slow else (_MOST, _BESIDES)
    return min(most, (_SHARE_OF_FEW if few else _SHARE) + besides / views)
