"""What a splat may cost in scenes of which a view shows a part (:func:`priced`).

Errors are means over all views. Where each view shows the whole scene, a splat that makes every picture a little worse
counts as much as one that makes one picture much worse. Where each view shows a part, in a city or in a flat of many
rooms, no splat can make more than a few pictures worse. With the same threshold the more would go, the larger the scene
is, and each picture would be matched the worse. So the threshold is a part of that for a scene that is seen whole.
"""

from __future__ import annotations

from dataclasses import replace

from potr_cl.codec.quantize import HyperParameters
from potr_cl.stages.stage import State

#: Which part of the views shows a splat, on the average, in a scene that is seen whole: an object hides half of itself,
#: and a captured one is seen from near and from afar.
_WHOLE = 0.25


def priced(parameters: HyperParameters, state: State) -> HyperParameters:
    """What q gives, with the thresholds on the mean squared error as they are right for a state's views.

    Args:
        parameters: of a scene that is seen whole.
        state: knows which part of the views shows a splat, if anyone has found out.
    """
    part = min(state.learnt.shown / _WHOLE, 1.0)
    return replace(parameters, delta_mse_max=part * parameters.delta_mse_max, drop=part * parameters.drop)
