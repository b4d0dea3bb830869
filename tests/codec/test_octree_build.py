"""Octrees that the compiled library builds: the same bits as NumPy's, and nothing beyond their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.codec import octree
from potr_cl.codec.native.library import VARIABLE, native

pytestmark = pytest.mark.skipif(
    native() is None, reason="the compiled library is not there: python -m tools.make.native, or pip install -e ."
)


def clusters(rng: np.random.Generator, n: int) -> np.ndarray:
    means = np.concatenate([rng.normal(size=(n, 3)), rng.normal(size=(n // 3, 3)) / 50]).astype(np.float32)
    return rng.permutation(np.concatenate([means, means[: n // 10], means[: n // 20]]))


def line(rng: np.random.Generator, n: int) -> np.ndarray:
    means = np.zeros((n, 3), np.float32)
    means[:, 1] = rng.integers(0, 50, n)
    return means


SCENES = {
    "clusters": lambda rng: clusters(rng, 3000),
    "many in one place": lambda rng: rng.integers(0, 4, (500, 3)).astype(np.float32),
    "a line": lambda rng: line(rng, 300),
    "one place": lambda rng: np.full((7, 3), 3.5, np.float32),
    "one splat": lambda rng: np.ones((1, 3), np.float32),
    "far apart": lambda rng: np.concatenate([clusters(rng, 100) * 1e-6, [[1e6, 0, -1e6]]]).astype(np.float32),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("finest", [3.0, 1e-2, 1e-5, 1e-9, 1e-13])
@pytest.mark.parametrize("alike", [True, False])
def test_same_streams(scene, finest, alike, monkeypatch):
    """Trees of no level, and of so many that a splat's octants take one, two or three words; powers of two as well."""
    rng = np.random.default_rng(len(scene))
    means = SCENES[scene](rng)
    tolerance = finest if alike else finest * np.exp2(rng.integers(0, 12, len(means)) / 2)
    found = []
    for value in ("0", "1"):
        monkeypatch.setenv(VARIABLE, value)
        found.append((*octree.build(means, tolerance, absolute=True), octree.leaf_order(means, tolerance)))
    (ours, our_order, our_leaves), (theirs, their_order, their_leaves) = found
    assert np.array_equal(our_order, their_order)
    assert np.array_equal(our_leaves, their_leaves)
    assert np.array_equal(our_order, our_leaves)
    assert our_order.dtype == their_order.dtype
    assert (ours.origin, ours.side, ours.depth) == (theirs.origin, theirs.side, theirs.depth)
    for name in ("occupancy", "several", "multiplicities", "leaf_levels", "tails"):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert a.dtype == b.dtype
        assert np.array_equal(a, b), name
    decoded = octree.parse(theirs, len(means))
    assert np.abs(decoded - means[their_order]).max() <= np.max(tolerance) + 2**-22 * np.abs(means).max()


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
