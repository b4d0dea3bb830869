"""Octrees that are built by several threads: the same streams and the same order."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.native import octree_build
from potr_cl.errors import DataError
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
    for name in ("occupancy", "several", "multiplicities", "leaf_levels", "tails"):
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name


@pytest.mark.parametrize("absolute", [True, False])
@pytest.mark.parametrize("tolerance", [1e9, 1e-1, 1e-3, 1e-7, 1e-12])
@pytest.mark.parametrize("spread", [0.0, 1.0, 1e20])
def test_what_is_begun_ends_as_what_is_built(absolute, tolerance, spread):
    """The streams, and the centres that a decoder finds in them: bit for bit, shared leaves and two words included."""
    rng = np.random.default_rng(8)
    means = (spread * rng.normal(size=(5000, 3)) ** 3).astype(np.float32)
    means[:40] = means[40]
    wanted, wanted_order = octree.build(means, tolerance, absolute)
    begun = octree.begin(means, tolerance, absolute)
    assert np.array_equal(wanted_order, begun.order)
    with thread_pool(3) as pool:
        centres = begun.decoded(pool.map)
    tree = begun.streams()
    assert begun.depth == tree.depth
    for name in ("occupancy", "several", "multiplicities", "leaf_levels", "tails"):
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name
    assert np.array_equal(centres, octree.parse(tree, len(means)))


def test_centres_beyond_single_precision_are_refused_as_a_decoder_does():
    means = np.float32([[3.4e38, 3.3e38, 0], [-3.4e38, 3.3e38, 0], [0, 3.3e38, 0]])
    begun = octree.begin(means, 1e39, absolute=True)
    with pytest.raises(DataError, match="single precision"):
        octree.parse(begun.streams(), 3)
    with pytest.raises(DataError, match="single precision"):
        begun.decoded(map)
