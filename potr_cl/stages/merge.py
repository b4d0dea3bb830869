"""The stage "merge": splats that are left take over what removed ones near them show (:func:`merged`).

Few splats that stay as they are leave gaps, and where views show little of a scene, nothing tells pruning that splats
are missed there. A splat that grows to what it and its removed neighbours were together closes such gaps. Where many
splats lie on top of each other it is worse. So a splat is merged where most of what views show of it and its neighbours
was that of removed ones, or where views show little; and all stay as they were where pictures become much worse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run, thread_pool
from potr_cl.model.order import morton_order, over_ranges
from potr_cl.model.scene import Scene, opacities_of
from potr_cl.model.spherical_harmonics import quaternions_of, rotation_matrices
from potr_cl.stages.fitting.fit import Sight, held_out_error
from potr_cl.stages.stage import Stage, State, Workbench, option
from potr_cl.views.targets import targets_of

_Indices = NDArray[np.int64]
_F64 = NDArray[np.float64]
_F32 = NDArray[np.float32]

#: Neighbours of a removed splat that may take it over, on either side of it along a curve.
_NEAR = 4
#: By which the second curve is turned, about two axes: what is far apart on one is mostly near on the other.
_COS, _SIN = math.cos(0.7), math.sin(0.7)
_TURN = np.array([[_COS, -_SIN, 0], [_COS * _SIN, _COS * _COS, -_SIN], [_SIN * _SIN, _SIN * _COS, _COS]], np.float32)
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
        importance = state.results.importance
        none_held_out = len(state.views) - state.added < 2
        if importance is None or none_held_out or state.results.unresolved is not None:
            return state
        if len(state.scene) == len(state.source):
            return state
        bench.progress("merge", 0.0)
        with thread_pool(bench.threads) as pool:
            scene = merged(state.source, state.survivors, importance, pool.map, state.scene)
        bench.progress("merge", 0.5)
        looked_at = bench.opened, bench.drawable(state.source), state.views, bench.background, state.visibility
        with targets_of(*looked_at) as targets:
            sight = Sight(state.views, targets, state.added, bench.background)
            errors = [held_out_error(bench.opened, each, sight) for each in (state.scene, scene)]
        bench.progress("merge", 1.0)
        return replace(state, scene=scene, geometry=None) if errors[1] < _WORSE * errors[0] else state


def merged(scene: Scene, left: _Indices, importance: _F32, run: Run = map, become: Scene | None = None) -> Scene:
    """Splats that are left, each with what it and the removed ones nearest to it were together.

    Of each group the centre, the covariance, and the coefficients are the weighted means; the opacity is such that it
    covers as much as before. Only those are merged that the module's text names.

    Args:
        scene: N splats.
        left: (n,) numbers of those that are left, ascending.
        importance: (N,) float32, what pictures show of each, in any unit.
        run: in place of :func:`map`, to work with several threads.
        become: the splats that are left as they are by now, which those stay that are not merged; None: as they were.
    """
    group = _groups(scene, left, run)
    covered = np.empty(len(scene), np.float32)

    def cover(some: slice) -> None:
        opacities = opacities_of(scene.opacity_logits[some])
        covered[some] = np.where(opacities < _DRAWN, 0, opacities * _area(scene.log_scales[some]))

    def in_groups(members: _Indices, _: int) -> None:
        members[:] = members[np.argsort(group[members], kind="stable")]

    _in_blocks(run, cover, len(scene))
    members = over_ranges(group, in_groups, run)
    counts = np.bincount(group, minlength=len(left) + 1)[:-1]
    starts = np.cumsum(counts) - counts
    usual = float(importance.sum(dtype=np.float64)) / max(float(covered.sum(dtype=np.float64)), 1e-300) or 1.0
    found = scene.subset(left) if become is None else become.subset(np.arange(len(become)))
    coefficients = scene.sh.reshape(len(scene), -1)

    def merge(several: _Indices) -> None:
        """Groups of the same size, by their places among those that are left."""
        own = members.take(starts[several, None] + np.arange(counts[several[0]]))
        shows, covers = (values.take(own).astype(np.float64) for values in (importance, covered))
        shown, cover = shows.sum(axis=1), covers.sum(axis=1)
        wanted = shown - importance[left[several]] > _MISSED * shown
        wanted |= shown < _HARDLY_SHOWN * usual * cover
        several, own, cover = several[wanted], own[wanted], cover[wanted]
        weights = shows[wanted] + _UNSEEN * usual * covers[wanted]
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)

        def mean(values: NDArray[np.floating]) -> NDArray[np.floating]:
            """Of (groups, members, k) values."""
            found: NDArray[np.floating] = np.einsum("gm,gmk->gk", weights.astype(values.dtype), values)
            return found

        centres = scene.means.take(own, axis=0).astype(np.float64)
        middle = mean(centres)
        off = centres - middle[:, None]
        quaternions = scene.quaternions.take(own.ravel(), axis=0).astype(np.float64)
        axes = rotation_matrices(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
        axes *= np.exp(_bounded(scene.log_scales.take(own.ravel(), axis=0)))[:, None]
        # Not by BLAS, whose calls for so small matrices wait for each other's threads.
        covariances = np.einsum("nij,nkj->nik", axes, axes).reshape(*own.shape, 9)
        covariances += (off[..., None] * off[..., None, :]).reshape(covariances.shape)
        variances, turned = np.linalg.eigh(mean(covariances).reshape(-1, 3, 3))
        first, second, third = turned.transpose(2, 0, 1)
        turned[(np.cross(first, second) * third).sum(axis=1) < 0, :, 0] *= -1
        found.means[several] = middle
        found.log_scales[several] = 0.5 * np.log(np.maximum(variances, 1e-30))
        found.quaternions[several] = quaternions_of(turned)
        found.sh[several] = mean(coefficients.take(own, axis=0)).reshape(-1, *scene.sh.shape[1:])
        opacity = np.clip(cover / _area(found.log_scales[several]), 1 / 255, _OPACITY)
        found.opacity_logits[several] = np.log(opacity / (1 - opacity))

    blocks = list[_Indices]()
    for size in np.unique(counts[counts > 1]).tolist():
        groups = np.flatnonzero(counts == size)
        blocks += np.array_split(groups, min(-(-len(groups) * size // _BLOCK), len(groups)))  # so many members each
    list(run(merge, blocks))
    return found


def _groups(scene: Scene, left: _Indices, run: Run) -> NDArray[np.int32]:
    """(N,) for each splat the place in ``left`` of the one that takes it over, or its own there; n if none does.

    The best of the neighbours along two Morton curves, one of which is turned, by distance, size and colour.
    """
    group = np.full(len(scene), len(left), np.int32)
    group[left] = np.arange(len(left), dtype=np.int32)
    is_left = group < len(left)
    # By splat: what neighbours are compared by, in one place of memory.
    looks = np.empty((len(scene), 8), np.float32)
    turned = np.empty((len(scene), 3), np.float32)

    def note(some: slice) -> None:
        looks[some, :3] = scene.means[some]
        looks[some, 3:6] = scene.sh[some, 0]
        x, y, z = np.exp(2 * _bounded(scene.log_scales[some])).T
        looks[some, 6] = (x + y + z) / 3
        np.einsum("ij,jk->ik", looks[some, :3], _TURN, out=turned[some])

    _in_blocks(run, note, len(scene))
    least = np.full(len(scene), np.inf, np.float32)
    for means in (looks[:, :3], turned):
        order = morton_order(means, run)
        stays = is_left[order]
        curve, gone = order[stays], order[~stays]
        places = np.cumsum(stays, dtype=np.int64)[~stays]

        def look(some: slice, curve: _Indices = curve, gone: _Indices = gone, places: _Indices = places) -> None:
            own, place = gone[some], places[some]
            first = max(int(place[0]) - _NEAR, 0)
            near = curve[first : int(place[-1]) + _NEAR]
            others = np.ascontiguousarray(looks.take(near, axis=0).T)
            mine = np.ascontiguousarray(looks.take(own, axis=0).T)
            steps = place - first + np.arange(-_NEAR, _NEAR)[:, None]

            def squares(coordinates: range) -> NDArray[np.float32]:
                found = np.zeros(steps.shape, np.float32)
                for each in coordinates:
                    apart = others[each].take(steps, mode="clip")
                    apart -= mine[each]
                    apart *= apart
                    found += apart
                return found

            with np.errstate(over="ignore"):
                cost = squares(range(3))
                cost /= others[6].take(steps, mode="clip") + mine[6]
                cost[cost > _FAR**2] = np.inf
                cost += _COLOUR * squares(range(3, 6))
            best = cost.argmin(axis=0), np.arange(len(own))
            better = cost[best] < least[own]
            least[own[better]] = cost[best][better]
            group[own[better]] = group[near.take(steps[best][better], mode="clip")]

        _in_blocks(run, look, len(gone))
    return group


def _in_blocks(run: Run, work: Callable[[slice], None], count: int) -> None:
    list(run(work, (slice(start, start + _BLOCK) for start in range(0, count, _BLOCK))))


def _area(log_scales: NDArray[np.floating]) -> _F64:
    """(n,) of ellipsoids where they are seen as large as can be, but for a factor."""
    x, y, z = _bounded(log_scales).T
    found: _F64 = np.exp(x + y + z - np.minimum(np.minimum(x, y), z))
    return found


def _bounded(log_scales: NDArray[np.floating]) -> _F64:
    """Scales whose squares are numbers; all that matter to a scene are far within."""
    return np.clip(log_scales.astype(np.float64), -_LARGEST, _LARGEST)
