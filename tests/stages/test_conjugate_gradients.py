"""Conjugate gradients on a small system written out in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.stages.refitting.solver import ConjugateGradients, System


class ArrayVectors:
    """Vectors that are arrays; new ones hold what no step may look at."""

    def __init__(self, size):
        self.size = size

    def vector(self, rank):
        return np.full(self.size, np.nan)

    def zero(self, x):
        x[:] = 0

    def combine(self, a, y, b, x):
        y[:] = a * y + b * x

    def dot(self, x, y):
        return float(x @ y)


def system_of(matrix):
    """H is a matrix, preconditioned by its diagonal."""

    def precondition(residual, result):
        result[:] = residual / np.abs(np.diag(matrix))

    def product(direction, result):
        result[:] = matrix @ direction

    return System(product, precondition)


def least_squares(seed=0, rows=20, size=8):
    """H, b and |target|² of min |A x - target|²."""
    rng = np.random.default_rng(seed)
    a, target = rng.normal(size=(rows, size)) * 10.0 ** rng.uniform(-1, 1, size), rng.normal(size=rows)
    return a.T @ a, a.T @ target, float(target @ target)


def descend(matrix, b, constant, steps, gain=0.0):
    """The solution, the steps, and what was told."""
    x, told = np.zeros(len(b)), []
    gradients = ConjugateGradients(ArrayVectors(len(b)))
    done = gradients.descend(system_of(matrix), x, b.copy(), constant, steps, gain, told.append)
    return x, done, told


def test_as_many_steps_as_there_are_unknowns_solve_it():
    matrix, b, constant = least_squares()
    x, done, told = descend(matrix, b, constant, 8)
    assert np.allclose(x, np.linalg.solve(matrix, b), rtol=1e-6)
    assert done == 8
    assert told == list(range(1, 9))


def test_it_ends_where_the_residual_is_gone():
    matrix, b, constant = least_squares()
    assert descend(matrix, b, constant, 50)[1] < 15
    assert descend(matrix, np.zeros(8), constant, 50)[1] == 0


def test_each_step_takes_the_objective_down_and_a_small_gain_ends_it():
    matrix, b, constant = least_squares()
    objectives = [constant]
    for steps in range(1, 8):
        x = descend(matrix, b, constant, steps)[0]
        objectives.append(x @ matrix @ x - 2 * b @ x + constant)
    assert np.all(np.diff(objectives) < 0)
    gains = -np.diff(objectives) / objectives[1:]
    gain = float(np.sqrt(gains.max() * gains.min()))
    first_small = int(np.argmax(gains < gain)) + 1
    assert descend(matrix, b, constant, 50, gain)[1] == first_small < 8


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_a_matrix_that_is_not_positive_or_finite_moves_nothing(bad):
    x, done, _ = descend(np.diag(np.full(3, bad)), np.ones(3), 1.0, 10)
    assert done == 0
    assert not x.any()
