"""Octrees that are built by several threads: the same streams and the same order."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.native import octree_build
from potr_cl.host.threads import thread_pool
from potr_cl.model import order


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-7], ids=["some share leaves", "one word", "two words"])
def test_the_same_octree(monkeypatch, tolerance):
    rng = np.random.default_rng(5)
    means = (rng.normal(size=(40_000, 3)) ** 3).astype(np.float32)
    means[:300] = means[300]
    wanted, wanted_order = octree.build(means, tolerance, absolute=True)
    monkeypatch.setattr(order, "_LARGE", 1000)
    monkeypatch.setattr(order, "_RANGE", 1024)
    monkeypatch.setattr(octree_build, "_AT_A_TIME", 3000)
    with thread_pool(3) as pool:
        tree, its_order = octree.build(means, tolerance, absolute=True, run=pool.map)
    assert np.array_equal(wanted_order, its_order)
    assert (tree.origin, tree.side, tree.depth) == (wanted.origin, wanted.side, wanted.depth)
    for name in ("occupancy", "several", "multiplicities", "tail_lengths", "tails"):
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name


@pytest.mark.parametrize("absolute", [True, False])
def test_the_order_is_there_before_the_streams(absolute):
    means = np.random.default_rng(8).normal(size=(5000, 3)).astype(np.float32)
    wanted, wanted_order = octree.build(means, 1e-3, absolute)
    its_order, finish = octree.begin(means, 1e-3, absolute)
    assert np.array_equal(wanted_order, its_order)
    tree = finish()
    for name in ("occupancy", "several", "multiplicities", "tail_lengths", "tails"):
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name
