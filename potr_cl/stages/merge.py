"""The stage "merge": splats that are left take over what removed ones near them show.

Few splats that stay as they are leave gaps, and where views show little of a scene, nothing tells pruning that splats
are missed there. A splat that grows to what it and its removed neighbours were together closes such gaps. Where many
splats lie on top of each other it is worse. So a splat is merged where most of what views show of it and its neighbours
was that of removed ones, or where views show little; and all stay as they were where pictures become much worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from potr_cl.host.threads import thread_pool
from potr_cl.stages.fitting.fit import Sight, held_out_error
from potr_cl.stages.merging.merged import merged
from potr_cl.stages.stage import Stage, State, Workbench, option
from potr_cl.views.targets import targets_of

#: Pictures may become worse by that factor (1.5 dB).
_WORSE = 10**0.15


@dataclass(frozen=True)
class Merge(Stage):
    """Merge removed splats of the source into those that are left.

    Coarser levels of detail do: what they have lost shows from where nobody has looked, and a fit takes back what
    merging costs in views that were given.
    """

    name = "merge"
    title = ""

    on: bool = option(False)

    def run(self, state: State, bench: Workbench) -> State:
        """The state with merged splats; as it was where pictures become much worse, and where nobody can tell."""
        importance = state.results.importance
        none_held_out = len(state.views) - state.added < 2
        if importance is None or none_held_out or state.results.unresolved is not None:
            return state
        if len(state.scene) == len(state.source):
            return state
        bench.progress("merge", 0.0)
        whole = bench.drawable(state.source)
        with thread_pool(bench.threads) as pool:
            scene = merged(bench.opened, state.source, state.survivors, importance, pool.map, state.scene, whole)
        bench.progress("merge", 0.5)
        looked_at = bench.opened, whole, state.views, bench.background, state.visibility
        with targets_of(*looked_at) as targets:
            sight = Sight(state.views, targets, state.added, bench.background)
            errors = [held_out_error(bench.opened, each, sight) for each in (state.scene, scene)]
        bench.progress("merge", 1.0)
        return replace(state, scene=scene, geometry=None) if errors[1] < _WORSE * errors[0] else state
