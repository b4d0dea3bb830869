"""Octrees that the compiled library builds: levels at a turn, and nothing beyond their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.native.library import VARIABLE, native

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
    functions = native().octree_build
    assert set(functions.wanted(turn, half, 20)) == {-1}
    assert -1 not in functions.wanted(turn * (1 + 1e-9), half, 20)


def test_what_does_not_fit_is_refused_before_c_sees_it():
    building = native().octree_build
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
            building.streams(*arguments)
    with pytest.raises(TypeError):
        building.bounds(np.zeros((3, 3), np.float32), np.ones(2))
