"""What stages tell one another, and reports: :class:`Learnt`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from potr_cl.codec.encoder import Coded
    from potr_cl.codec.quantize import HyperParameters
    from potr_cl.stages.fitting.fitted import Fitted, LeftOut
    from potr_cl.stages.held_out import PhotographChoice
    from potr_cl.stages.pruning.schedule import Pruned
    from potr_cl.stages.refitting.refit_options import Refitted
    from potr_cl.stages.unseen import Unresolved, Unseen
    from potr_cl.stages.views_between import Added
    from potr_cl.views.shares import ViewShares


@dataclass(frozen=True)
class Learnt:
    """What stages have found out; None where nobody has.

    Attributes:
        unresolved: splats that no view shows from near enough, which all stages leave alone.
        between: the views that were added.
        shown: which part of the views shows a splat, on the average, where that is known.
        unseen: splats that no view sees, or that stay though none resolves them.
        price: ΔMSE below which a splat has gone.
        shares: who of the workers elsewhere does which views, with what these see.
        pruned: the order in which splats went.
        fitted: the fit, or why there is none.
        chosen: the parameters that a fit chose coefficients with.
        compacted: whether colours are sparse already.
        refitted: the re-fit of the colours.
        photographs: the choice between re-fits to photographs.
        coded: the file.
    """

    unresolved: Unresolved | None = None
    between: Added | None = None
    shown: float = 1.0
    unseen: Unseen | Unresolved | None = None
    price: float | None = None
    shares: ViewShares | None = None
    pruned: Pruned | None = None
    fitted: Fitted | LeftOut | None = None
    chosen: HyperParameters | None = None
    compacted: bool = False
    refitted: Refitted | None = None
    photographs: PhotographChoice | None = None
    coded: Coded | None = None
