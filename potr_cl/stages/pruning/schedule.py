"""The pruning controller: which splats go in which iteration (paper section "Iterative pruning"). Pure numpy.

It knows removal effects and importances as numbers only; :mod:`potr_cl.stages.pruning.removal` measures them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.order import ascending, least

#: The effect of what must stay.
BEYOND = 1e30
#: Candidates that are looked at to guess how far an iteration's budget reaches.
_SAMPLE = 2048

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]


class EffectsMeasurer(Protocol):
    """What the controller asks of whoever measures the effects."""

    def measure(self) -> tuple[F64, F64]:
        """ΔMSE_k and I_k of all N splats (of removed ones: anything)."""

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""


@dataclass(frozen=True)
class PruningOptions:
    """How to prune.

    Attributes:
        delta_mse_max: ΔMSE_MAX: splats whose removal costs less are candidates. Ignored where ``count`` is given.
        iterations: rounds in which effects are measured anew.
        a: the mapping function's curvature: how much a negative ΔMSE is preferred to a small one.
        count: if given, the number of splats to keep, exactly.
        decay: splats are ranked by an exponential moving average of their measurements, each counting this many times
            as much as the next one; 0: by the newest alone, as in the paper. Splats that make up for the same error all
            look removable at once; with the newest effects all of them go, and the error turns round.

    Raises:
        UsageError: a value is out of range.
    """

    delta_mse_max: float
    iterations: int = 48
    a: float = 10.0
    count: int | None = None
    decay: float = 0.8

    def __post_init__(self) -> None:
        if not self.delta_mse_max >= 0:
            raise UsageError(f"ΔMSE_MAX is {self.delta_mse_max:g}, it must be 0 or more")
        if self.iterations < 1:
            raise UsageError(f"{self.iterations} pruning iterations: at least 1 is needed")
        if not 0 < self.a < np.inf:
            raise UsageError(f"the mapping's a is {self.a:g}, it must be positive")
        if self.count is not None and self.count < 1:
            raise UsageError(f"{self.count} splats to keep: at least 1 is needed")
        if not 0 <= self.decay <= 1:
            raise UsageError(f"the moving average's decay (--damping) is {self.decay:g}, it must lie between 0 and 1")


@dataclass(frozen=True)
class Iteration:
    """One round of pruning.

    Attributes:
        left: splats after it.
        importance: I_k of the splats that went, summed.
        effect: their ΔMSE_k, summed: by how much the mean squared error should have grown.
        largest_effect: the largest ΔMSE_k among them.
    """

    left: int
    importance: float
    effect: float
    largest_effect: float


@dataclass(frozen=True)
class Course:
    """How a pruning run of N splats went.

    Attributes:
        score: (N,) float64, in which order the splats of an iteration went, and those that are left would.
        history: what is known of the rounds that removed splats.
    """

    score: NDArray[np.float64]
    history: tuple[Iteration, ...] = ()


@dataclass(frozen=True)
class Pruned:
    """What a pruning run did.

    Attributes:
        kept: number of splats that were kept.
        iteration_of: (N,) int32, the iteration (from 0) in which each splat went; -1 for the kept ones.
        iterations: rounds that were run: fewer than asked for when nothing was left to decide.
        importance: (N,) float32, I_k of each splat before any went.
        course: gives how it went, once that has been found.
    """

    kept: int
    iteration_of: NDArray[np.int32]
    iterations: int
    importance: NDArray[np.float32]
    course: Callable[[], Course]

    @property
    def order(self) -> Indices:
        """(N,) all splats: first the removed ones as they went, then the kept ones by ascending (smoothed) ΔMSE."""
        last = np.where(self.iteration_of < 0, self.iterations, self.iteration_of)
        return np.lexsort((self.course().score, last))

    @property
    def history(self) -> tuple[Iteration, ...]:
        """What is known of the rounds that removed splats."""
        return self.course().history

    @property
    def survivors(self) -> Indices:
        """Indices of the kept splats, ascending."""
        return np.flatnonzero(self.iteration_of < 0)


class Smoothed:
    """Effects of which each splat's is the weighted mean of all its measurements.

    Args:
        decay: how much a measurement counts against the next one, see :class:`PruningOptions`.
    """

    def __init__(self, decay: float) -> None:
        self._decay, self._weight = decay, 0.0
        self._mean: F64 = np.zeros(0)

    def with_(self, newest: F64) -> F64:
        """The mean with one measurement more, (N,)."""
        self._weight = self._decay * self._weight + 1
        if len(self._mean):
            change = newest - self._mean
            change /= self._weight
            change += self._mean
            self._mean = change
        else:
            self._mean = newest
        return self._mean


def mapping(x: F64, a: float) -> F64:
    """m(x) = x for x >= 0, (sqrt(1 - 2 a x) - 1) / a for x < 0 (paper, "The mapping function")."""
    mapped = x.copy()
    below = np.flatnonzero(x < 0)
    mapped[below] = (np.sqrt(1 - 2 * a * x[below]) - 1) / a
    return mapped


def choose(delta_mse: F64, importance: F64, alive: Indices, remaining: int, options: PruningOptions) -> Indices:
    """The splats to remove in one iteration, in the order of removal.

    Splats that no view sees go at once whatever the budget: their removal changes nothing, and keeping them in the
    lists costs time.

    Args:
        delta_mse, importance: (N,) of all splats.
        alive: indices of the splats that are left, ascending.
        remaining: iterations left, this one included.
    """
    effect, weight = delta_mse.take(alive), importance.take(alive)
    if options.count is None:
        wanted = effect < options.delta_mse_max
        limit = options.delta_mse_max
    else:
        wanted = least(effect, max(len(alive) - options.count, 0))
        limit = float(effect[wanted].max()) if wanted.any() else 0.0
    idle = np.flatnonzero(weight == 0)
    unseen = idle[wanted[idle] & (effect[idle] == 0)]
    wanted[unseen] = False
    candidates = np.flatnonzero(wanted)

    with np.errstate(divide="ignore", over="ignore"):
        score = mapping(effect[candidates] / limit, options.a) if limit > 0 else effect[candidates]
    if remaining > 1 and len(candidates):
        candidates = candidates[_cheapest(score, weight[candidates], remaining)]
    else:
        candidates = candidates[ascending(score)]
    gone: Indices = alive[np.concatenate([unseen, candidates])]
    return gone


def _cheapest(score: F64, weight: F64, remaining: int) -> Indices:
    """The splats of least score, in its order, up to and including the one with which they reach a share of all weight.

    Few splats go in one iteration. So only those below some score are sorted; a sample tells which score is enough.
    """
    budget = weight.sum() / remaining
    step = max(len(score) // _SAMPLE, 1)
    order = np.argsort(score[::step])
    spent = np.cumsum(weight[::step][order])
    for margin in (1.25, 2.5):
        place = int(np.searchsorted(spent, margin * spent[-1] / remaining))
        if place < len(order):
            some = np.flatnonzero(score <= score[::step][order[place]])
            if weight[some].sum() > budget:
                break
    else:
        some = np.arange(len(score))
    some = some[ascending(score[some])]
    return some[: int(np.searchsorted(np.cumsum(weight[some]), budget)) + 1]


def prune(
    effects: EffectsMeasurer,
    splats: int,
    options: PruningOptions,
    progress: Callable[[int, int], None] | None = None,
    after_iteration: Callable[[int], None] | None = None,
    spared: NDArray[np.bool_] | None = None,
) -> Pruned:
    """Run the schedule.

    Args:
        effects: measures and removes.
        splats: N.
        options: thresholds and iterations.
        progress: called with the iterations done and the number of splats left.
        spared: (N,) splats that stay, whatever their effect, unless there are too many of them; None: none.
    """
    alive = np.arange(splats, dtype=np.int64)
    iteration_of = np.full(splats, -1, np.int32)
    score = np.empty(splats)
    history: list[Iteration] = []
    done = 0
    delta_mse = np.zeros(splats)
    smoothed = Smoothed(options.decay)
    for iteration in range(options.iterations):
        newest, importance = effects.measure()
        if iteration == 0:
            at_first = importance.astype(np.float32)
        delta_mse = smoothed.with_(newest)
        if spared is not None:
            delta_mse = np.where(spared, BEYOND, delta_mse)
        gone = choose(delta_mse, importance, alive, options.iterations - iteration, options)
        if len(gone) >= len(alive) and options.count is None:
            gone = gone[: len(alive) - 1]  # an empty scene is no scene
        done = iteration + 1
        if len(gone) == 0:
            break  # no candidate is left, and measuring again would find the same
        iteration_of[gone] = iteration
        score[gone] = np.arange(len(gone))
        effects.remove(gone)  # first: the device is busy with it during the rest
        alive = alive[iteration_of[alive] < 0]
        effect = newest[gone]
        history.append(Iteration(len(alive), float(importance[gone].sum()), float(effect.sum()), float(effect.max())))
        if progress is not None:
            progress(done, len(alive))
        if after_iteration is not None:
            after_iteration(iteration)
    score[alive] = delta_mse[alive]
    course = Course(score, tuple(history))
    return Pruned(len(alive), iteration_of, done, at_first, lambda: course)
