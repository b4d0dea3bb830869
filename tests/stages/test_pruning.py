"""The pruning controller, with removal effects made up: budget, order, exact counts, nothing left to decide."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.stages.pruning.schedule import PruningOptions, choose, mapping, prune


class Additive:
    """Effects that do not depend on what else is gone: the pruning approximation holds exactly."""

    def __init__(self, delta_mse, importance):
        self.delta_mse = np.asarray(delta_mse, float)
        self.importance = np.asarray(importance, float)
        self.removed: list[np.ndarray] = []
        self.measured = 0

    def measure(self):
        self.measured += 1
        return self.delta_mse.copy(), self.importance.copy()

    def remove(self, splats):
        self.removed.append(np.array(splats))


RNG = np.random.default_rng(5)
EFFECTS = RNG.normal(0.5, 1, 400)
IMPORTANCES = RNG.exponential(size=400)


def test_mapping_is_the_papers():
    assert mapping(np.array([0.0, 0.3, 7.0]), 10).tolist() == [0, 0.3, 7]
    assert mapping(np.array([-1.0]), 10)[0] == pytest.approx((np.sqrt(21) - 1) / 10)
    # Orders negative effects after those near 0 but before those of their own size.
    assert 0 < mapping(np.array([-0.5]), 10)[0] < 0.5


def test_budget_and_order_by_hand():
    effect = np.array([0.1, -0.4, 0.2, 5.0, 0.05, 0.9])
    weight = np.array([1.0, 1.0, 1.0, 9.0, 1.0, 4.0])
    options = PruningOptions(1.0, 4)
    # Candidates are all but the fourth: importance 8, budget 2; m: 0.1, 0.2, 0.2, -, 0.05, 0.9.
    gone = choose(effect, weight, np.arange(6), 4, options)
    assert gone.tolist() == [4, 0]
    assert choose(effect, weight, np.arange(6), 1, options).tolist()[:2] == [4, 0]
    assert sorted(choose(effect, weight, np.arange(6), 1, options)) == [0, 1, 2, 4, 5]


@given(hnp.arrays(float, st.integers(1, 60), elements=st.floats(-1, 2)), st.integers(1, 10), st.data())
def test_budget_is_reached_and_not_passed_by_more_than_one_splat(effect, remaining, data):
    weight = data.draw(hnp.arrays(float, len(effect), elements=st.floats(1e-3, 10)))
    options = PruningOptions(0.7, 10)
    gone = choose(effect, weight, np.arange(len(effect)), remaining, options)
    candidates = effect < 0.7
    assert candidates[gone].all()
    if remaining == 1:
        assert len(gone) == candidates.sum()
    elif len(gone):
        budget = weight[candidates].sum() / remaining
        # Sums of floats in another order differ in the last digits.
        assert weight[gone].sum() >= budget * (1 - 1e-12)
        assert weight[gone[:-1]].sum() <= budget * (1 + 1e-12)
        score = mapping(effect / 0.7, 10)
        rest = np.setdiff1d(np.flatnonzero(candidates), gone)
        assert len(rest) == 0 or score[gone].max() <= score[rest].min()


def test_removes_all_candidates_and_nothing_else():
    effects = Additive(EFFECTS, IMPORTANCES)
    pruned = prune(effects, 400, PruningOptions(0.4, 7))
    assert pruned.survivors.tolist() == np.flatnonzero(EFFECTS >= 0.4).tolist()
    assert effects.measured == 7
    assert sorted(pruned.order) == list(range(400))
    assert (pruned.iteration_of[pruned.survivors] == -1).all()
    assert np.concatenate(effects.removed).tolist() == pruned.order[: 400 - pruned.kept].tolist()
    assert np.array_equal(pruned.importance, np.float32(IMPORTANCES))
    # Every iteration takes about the same share of the importance.
    shares = [IMPORTANCES[gone].sum() for gone in effects.removed]
    assert max(shares) < 1.4 * min(shares)
    assert [entry.left for entry in pruned.history] == (400 - np.cumsum([len(g) for g in effects.removed])).tolist()
    for gone, entry in zip(effects.removed, pruned.history, strict=True):
        assert entry.effect == pytest.approx(EFFECTS[gone].sum())
        assert entry.importance == pytest.approx(IMPORTANCES[gone].sum())
        assert entry.largest_effect == EFFECTS[gone].max()


@pytest.mark.parametrize(("decay", "order"), [(0.0, [0, 2, 1]), (0.5, [0, 2, 1]), (0.8, [0, 1, 2]), (1.0, [0, 1, 2])])
def test_decay_is_a_weighted_mean_of_the_measurements(decay, order):
    class Moving(Additive):
        def measure(self):
            super().measure()
            return np.array([0.0, 2.0, 5.0] if self.measured == 1 else [9.0, 6.0, 4.4]), self.importance

    # The first splat uses up the first iteration's budget. Means of the others with 0.5: 7 / 1.5 and 6.9 / 1.5.
    effects = Moving(np.zeros(3), [100.0, 1.0, 1.0])
    assert prune(effects, 3, PruningOptions(1, 2, count=1, decay=decay)).order.tolist()[:2] == order[:2]


@pytest.mark.parametrize(("count", "iterations"), [(1, 6), (57, 1), (57, 6), (399, 6), (400, 6), (1000, 1)])
def test_exact_counts(count, iterations):
    pruned = prune(Additive(EFFECTS, IMPORTANCES), 400, PruningOptions(0.0, iterations, count=count))
    assert pruned.kept == min(count, 400)
    assert sorted(pruned.order) == list(range(400))
    # Additive effects: the survivors are those with the largest.
    assert pruned.survivors.tolist() == np.sort(np.argsort(EFFECTS, kind="stable")[-pruned.kept :]).tolist()


def test_unseen_splats_go_at_once():
    effect, weight = np.array([-0.3, 0.0, 0.2, 0.0]), np.array([1.0, 0.0, 1.0, 0.0])
    gone = choose(effect, weight, np.arange(4), 48, PruningOptions(1.0))
    assert sorted(gone[:2]) == [1, 3]


def test_stops_when_nothing_is_left_to_decide():
    effects = Additive(np.full(50, 2.0), np.ones(50))
    pruned = prune(effects, 50, PruningOptions(1.0, 48))
    assert (pruned.kept, effects.measured) == (50, 1)


@pytest.mark.parametrize(
    ("effect", "limit", "kept"),
    [
        # All alike and all of them candidates: one is left.
        (np.zeros(20), 1.0, [19]), (np.full(20, -1.0), 1.0, [19]), (np.full(20, 0.5), 1.0, [19]),
        (np.linspace(0, 1, 10), 0.0, list(range(10))), (np.linspace(0, 1, 10), 1e300, [9]),
        (np.linspace(0, 1, 10), np.inf, [9]), (np.array([-0.5, 0.1, -0.1, 0.2]), 0.0, [1, 3]),
    ],
)  # fmt: skip
def test_what_is_left_by_limits_that_are_nothing_or_huge(effect, limit, kept):
    survivors = prune(Additive(effect, np.ones(len(effect))), len(effect), PruningOptions(limit, 3)).survivors
    assert survivors.tolist() == kept


def test_ties_fall_by_number():
    gone = choose(np.zeros(9), np.ones(9), np.arange(9), 3, PruningOptions(1.0))
    assert gone.tolist() == [0, 1, 2]
