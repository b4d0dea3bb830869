"""The stage "merge": splats that are left take over what removed ones near them show (:func:`merged`).

Few splats that stay as they are leave gaps, and where views show little of a scene, nothing tells pruning that splats
are missed there. A splat that grows to what it and its removed neighbours were together closes such gaps. Where many
splats lie on top of each other it is worse. So a splat is merged where most of what views show of it and its neighbours
was that of removed ones, or where views show little; and all stay as they were where pictures become much worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run, thread_pool
from potr_cl.model.order import ascending, morton_codes
from potr_cl.model.scene import Scene, opacities_of
from potr_cl.model.spherical_harmonics import quaternions_of, rotation_matrices
from potr_cl.stages.fitting.fit import Sight, held_out_error
from potr_cl.stages.pruning.helpers import measurement
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import Stage, State, Workbench, option
from potr_cl.views.targets import targets_of

_Indices = NDArray[np.int64]
_F64 = NDArray[np.float64]

#: Neighbours of a removed splat that may take it over, on either side of it along a curve; and by how much the second
#: curve is turned, in radians: what is far apart on one is mostly near on the other.
_NEAR, _TURNED = 4, 0.7
#: What a squared difference of constant coefficients counts against a squared distance in parts of the splats' sizes.
_COLOUR = 3.0
#: A splat is merged if its removed neighbours make up this part of what views show of the group; or if views show less
#: than that part of what they usually show of as much matter. Pictures may become worse by that factor (1.5 dB).
_MISSED, _HARDLY_SHOWN, _WORSE = 0.7, 0.05, 10**0.15
#: What a splat counts that no view shows, as a part of one of the same size and opacity that is shown as usual.
_UNSEEN = 0.1
#: The most that many faint splats become together.
_OPACITY = 0.995
#: Logarithms of scales are taken as no larger, and no smaller than minus this.
_LARGEST = 40.0
#: The least opacity that is drawn: what is fainter is no matter. And how far from a splat one may be that it takes
#: over, in parts of both's sizes.
_DRAWN, _FAR = 1 / 255, 30.0
#: Splats that a thread works on at a time.
_BLOCK = 1 << 15


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
        none_held_out = len(state.views) - state.added < 2
        if len(state.scene) == len(state.source) or none_held_out or state.results.unresolved is not None:
            return state
        bench.progress("merge", 0.0)
        whole = replace(state, scene=state.source, survivors=np.arange(len(state.source)), cut=None)
        with measurement(whole, bench, SweepOptions(memory=bench.memory), state.visibility) as removal:
            _, importance = removal.measure()
        with thread_pool(bench.threads) as pool:
            scene = merged(state.source, state.survivors, importance, pool.map, state.scene)
        bench.progress("merge", 0.5)
        looked_at = bench.opened, bench.drawable(state.source), state.views, bench.background, state.visibility
        with targets_of(*looked_at) as targets:
            sight = Sight(state.views, targets, state.added, bench.background)
            errors = [held_out_error(bench.opened, each, sight) for each in (state.scene, scene)]
        bench.progress("merge", 1.0)
        return replace(state, scene=scene, geometry=None) if errors[1] < _WORSE * errors[0] else state


def merged(scene: Scene, left: _Indices, importance: _F64, run: Run = map, become: Scene | None = None) -> Scene:
    """Splats that are left, each with what it and the removed ones nearest to it were together.

    Of each group the centre, the covariance, and the coefficients are the weighted means; the opacity is such that it
    covers as much as before. Only those are merged that the module's text names.

    Args:
        scene: N splats.
        left: (n,) numbers of those that are left, ascending.
        importance: (N,) what pictures show of each, in any unit.
        run: in place of :func:`map`, to work with several threads.
        become: the splats that are left as they are by now, which those stay that are not merged; None: as they were.
    """
    group = _groups(scene, left, run)
    members = ascending(group, run)
    counts = np.bincount(group, minlength=len(left) + 1)[:-1]
    starts = np.cumsum(counts) - counts
    covered = np.empty(len(scene))

    def cover(start: int) -> None:
        some = slice(start, start + _BLOCK)
        opacities = opacities_of(scene.opacity_logits[some])
        covered[some] = np.where(opacities < _DRAWN, 0, opacities * _area(scene.log_scales[some]))

    list(run(cover, range(0, len(scene), _BLOCK)))
    usual = importance.sum() / max(float(covered.sum()), 1e-300) or 1.0
    shown = np.bincount(group, importance, len(left) + 1)[:-1]
    wanted = shown - importance[left] > _MISSED * shown
    wanted |= shown < _HARDLY_SHOWN * usual * np.bincount(group, covered, len(left) + 1)[:-1]
    wanted &= counts > 1
    found = scene.subset(left) if become is None else become.subset(np.arange(len(become)))

    def merge(some: slice) -> None:
        several = some.start + np.flatnonzero(wanted[some])
        if not len(several):
            return
        ends = np.cumsum(counts[several])
        firsts = ends - counts[several]
        own = members[np.repeat(starts[several] - firsts, counts[several]) + np.arange(ends[-1])]
        weights = importance[own] + _UNSEEN * usual * covered[own]
        weights /= np.repeat(np.maximum(np.add.reduceat(weights, firsts), 1e-300), counts[several])

        def mean(values: NDArray[np.floating]) -> _F64:
            return np.add.reduceat(weights.reshape(-1, *[1] * (values.ndim - 1)) * values, firsts)

        centres = scene.means[own].astype(np.float64)
        middle = mean(centres)
        off = centres - np.repeat(middle, counts[several], axis=0)
        quaternions = scene.quaternions[own].astype(np.float64)
        axes = rotation_matrices(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
        axes *= np.exp(_bounded(scene.log_scales[own]))[:, None]
        variances, turned = np.linalg.eigh(mean(axes @ axes.transpose(0, 2, 1) + off[:, :, None] * off[:, None]))
        turned[np.linalg.det(turned) < 0, :, 0] *= -1
        found.means[several] = middle
        found.log_scales[several] = 0.5 * np.log(np.maximum(variances, 1e-30))
        found.quaternions[several] = quaternions_of(turned)
        found.sh[several] = mean(scene.sh[own])
        opacity = np.add.reduceat(covered[own], firsts) / _area(found.log_scales[several])
        opacity = np.clip(opacity, 1 / 255, _OPACITY)
        found.opacity_logits[several] = np.log(opacity / (1 - opacity))

    # So many members at a time, however few splats are left.
    ends = np.searchsorted(np.cumsum(counts), np.arange(_BLOCK, counts.sum(), _BLOCK))
    cuts = np.unique([0, *ends, len(left)]).tolist()
    list(run(merge, map(slice, cuts[:-1], cuts[1:])))
    return found


def _groups(scene: Scene, left: _Indices, run: Run) -> _Indices:
    """(N,) for each splat the place in ``left`` of the one that takes it over, or its own there; n if none does.

    The best of the neighbours along two Morton curves, one of which is turned, by distance, size and colour.
    """
    group = np.full(len(scene), -1, np.int64)
    group[left] = np.arange(len(left))
    gone = np.flatnonzero(group < 0)
    least = np.full(len(gone), np.inf)
    sizes = np.empty(len(scene), np.float32)

    def measure(start: int) -> None:
        some = slice(start, start + _BLOCK)
        sizes[some] = np.exp(2 * _bounded(scene.log_scales[some])).mean(axis=1)

    list(run(measure, range(0, len(scene), _BLOCK)))
    cos, sin = np.cos(_TURNED), np.sin(_TURNED)
    turned = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    for means in (scene.means, scene.means @ turned.astype(np.float32)):
        codes = morton_codes(means, run)
        order = left[ascending(codes[left], run)]
        places = np.searchsorted(codes[order], codes[gone])

        def look(start: int, order: _Indices = order, places: _Indices = places) -> None:
            some = slice(start, start + _BLOCK)
            own, place = gone[some], places[some]
            for step in range(-_NEAR, _NEAR):
                other = order[np.clip(place + step, 0, len(order) - 1)]
                apart = np.square(scene.means[own].astype(np.float64) - scene.means[other]).sum(axis=1)
                cost = apart / (sizes[own] + sizes[other])
                cost[cost > _FAR**2] = np.inf
                cost += _COLOUR * np.square(scene.sh[own, 0].astype(np.float64) - scene.sh[other, 0]).sum(axis=1)
                better = cost < least[some]
                least[some][better] = cost[better]
                group[own[better]] = group[other[better]]

        list(run(look, range(0, len(gone), _BLOCK)))
    group[group < 0] = len(left)
    return group


def _area(log_scales: NDArray[np.floating]) -> _F64:
    """(n,) of ellipsoids where they are seen as large as can be, but for a factor."""
    found: _F64 = np.exp(np.sort(_bounded(log_scales), axis=1)[:, 1:].sum(axis=1))
    return found


def _bounded(log_scales: NDArray[np.floating]) -> _F64:
    """Scales whose squares are numbers; all that matter to a scene are far within."""
    return np.clip(log_scales.astype(np.float64), -_LARGEST, _LARGEST)
