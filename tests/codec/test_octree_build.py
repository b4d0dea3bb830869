"""Octrees that the compiled library builds: levels at a turn, and nothing beyond their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.native import octree as native_octree
from potr_cl.codec.native.library import VARIABLE, native
from potr_cl.errors import DataError
from potr_cl.host.threads import thread_pool
from potr_cl.model import order

pytestmark = pytest.mark.skipif(
    native() is None, reason="the compiled library is not there: python -m tools.make.native, or pip install -e ."
)


def test_levels_at_a_turn_are_numpys(monkeypatch):
    """Where a level depends on the last digits of a logarithm, the library leaves it to NumPy."""
    means = np.zeros((400, 3), np.float32)
    means[:200] = np.random.default_rng(0).random((200, 3))
    means[0], means[1] = 0, 1
    half = np.sqrt(3) / 2
    turn = half / np.exp2(np.arange(1, 9) - 1e-6)
    tolerance = np.concatenate([np.nextafter(turn, 0), turn, np.nextafter(turn, 1), turn * (1 + 1e-9)] * 13)[:400]
    levels = []
    for value in ("0", "1"):
        monkeypatch.setenv(VARIABLE, value)
        levels.append(octree.build(means, tolerance, absolute=True)[0].leaf_levels)
    assert np.array_equal(*levels)
    assert set(native_octree.wanted(native(), turn, half, 20)) == {-1}
    assert -1 not in native_octree.wanted(native(), turn * (1 + 1e-9), half, 20)


def test_what_does_not_fit_is_refused_before_c_sees_it():
    words, numbers, wanted = np.zeros((1, 4), np.uint64), np.arange(4), np.zeros(4, np.int8)
    for arguments in (
        (words, 22, numbers, wanted),
        (words, 3, numbers + 1, wanted),
        (words, 3, numbers[:3], wanted),
        (words, 3, numbers, wanted + np.int8(4)),
        (words, 3, numbers, wanted - np.int8(1)),
        (words.astype(np.int64), 3, numbers, wanted),
    ):
        with pytest.raises(TypeError):
            native_octree.streams(native(), *arguments)
    with pytest.raises(TypeError):
        native_octree.bounds(native(), np.zeros((3, 3), np.float32), np.ones(2))


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-7], ids=["some share leaves", "one word", "two words"])
def test_the_same_octree(monkeypatch, tolerance):
    rng = np.random.default_rng(5)
    means = (rng.normal(size=(40_000, 3)) ** 3).astype(np.float32)
    means[:300] = means[300]
    wanted, wanted_order = octree.build(means, tolerance, absolute=True)
    monkeypatch.setattr(order, "_LARGE", 1000)
    monkeypatch.setattr(order, "_RANGE", 1024)
    monkeypatch.setattr(native_octree, "_AT_A_TIME", 3000)
    with thread_pool(3) as pool:
        tree, its_order = octree.build(means, tolerance, absolute=True, run=pool.map)
    assert np.array_equal(wanted_order, its_order)
    assert (tree.origin, tree.side, tree.depth) == (wanted.origin, wanted.side, wanted.depth)
    for name in ("occupancy", "several", "multiplicities", "leaf_levels", "tails"):
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name


def test_centres_beyond_single_precision_are_refused_as_a_decoder_does():
    means = np.float32([[3.4e38, 3.3e38, 0], [-3.4e38, 3.3e38, 0], [0, 3.3e38, 0]])
    begun = octree.begin(means, 1e39, absolute=True)
    with pytest.raises(DataError, match="single precision"):
        octree.parse(begun.streams(), 3)
    with pytest.raises(DataError, match="single precision"):
        begun.decoded(map)
