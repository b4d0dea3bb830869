"""Coefficients rounded in turn, against the definition."""

from __future__ import annotations

import numpy as np

from potr_cl.outputs.feedback import DAMPING, rounded_in_turn


def test_the_nearest_plane_of_each_splat():
    rng = np.random.default_rng(0)
    count, coefficients = 5000, 9
    sh = rng.normal(0, 0.3, (count, coefficients, 3)).astype(np.float32)
    seen = rng.normal(size=(count, 20, coefficients)) * rng.lognormal(0, 2, (count, 1, 1))
    seen[::50] = 0  # of no view
    blocks = np.einsum("nva,nvb->nab", seen, seen).astype(np.float32)
    rows, columns = np.triu_indices(coefficients)

    def quantise(coefficient, wanted, splats):
        assert wanted.shape == (3, len(sh[splats]))
        return np.rint(wanted * 8) / np.float32(8)

    found = rounded_in_turn(sh, np.ascontiguousarray(blocks[:, rows, columns].T), quantise, threads=2)
    size = np.trace(blocks, axis1=1, axis2=2).astype(np.float64) / coefficients
    for n in [*range(0, count, 37), 0, 50, 100]:
        metric = np.eye(coefficients)
        if size[n] > 1e-30:
            metric = blocks[n].astype(np.float64) + DAMPING * size[n] * metric
        upper = np.linalg.cholesky(metric).T
        error = np.zeros((coefficients, 3))
        for m in range(coefficients - 1, 0, -1):
            wanted = sh[n, m] + upper[m, m + 1 :] @ error[m + 1 :] / upper[m, m]
            if (np.abs(wanted * 8 % 1 - 0.5) < 1e-3).any():  # a toss-up
                break
            assert np.array_equal(found[n, m], np.rint(wanted * 8) / 8), (n, m)
            error[m] = sh[n, m] - found[n, m]
        else:
            assert np.allclose(found[n, 0], sh[n, 0] + upper[0, 1:] @ error[1:] / upper[0, 0], atol=1e-4)
    assert np.array_equal(found[::50, 1:], np.rint(sh[::50, 1:] * 8) / 8)
