"""Octree: every centre within its tolerance, the order a permutation, damaged streams refused, as C builds it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec import octree
from potr_cl.codec.native import octree as native_octree
from potr_cl.errors import DataError
from potr_cl.host.threads import thread_pool
from potr_cl.model import order as morton
from potr_cl.native.library import VARIABLE, native

FIELDS = ("occupancy", "several", "multiplicities", "leaf_levels", "tails")
NEEDS_LIBRARY = pytest.mark.skipif(native() is None, reason="the compiled library is not there")


def roundtrip(means, tolerance, absolute=False):
    """Build, parse, and check what must hold for every scene."""
    means = np.asarray(means, np.float32)
    streams, order = octree.build(means, tolerance, absolute)
    parsed = octree.parse(streams, len(means))
    assert sorted(order) == list(range(len(means)))
    source = means[order].astype(np.float64)
    # The format cannot beat what float32 holds: one rounding in the limit, one in the result.
    rounding = np.abs(source).max(axis=1) * 2.0**-23
    limit = np.maximum(tolerance[order] if np.ndim(tolerance) else tolerance, rounding)
    distance = np.linalg.norm(parsed.astype(np.float64) - source, axis=1)
    assert (distance <= limit + rounding).all()


RNG = np.random.default_rng(7)
SHELL = RNG.normal(size=(500, 3))
SHELL /= np.linalg.norm(SHELL, axis=1, keepdims=True)
ADVERSARIAL = {
    "one splat": (RNG.normal(size=(1, 3)), 1e-3),
    "two far apart": ([[-1, 0, 0], [1, 0, 0]], 1e-6),
    "two in one tolerance": ([[0, 0, 0], [1e-5, 0, 0]], 1e-3),
    "all coincident": (np.full((50, 3), 3.7), 1e-4),
    "groups of coincident": (np.repeat(RNG.normal(size=(20, 3)), 3, axis=0), 1e-4),
    "on a line": (RNG.normal(size=(300, 1)) * [1, 0, 0], 1e-5),
    "on a diagonal": (RNG.normal(size=(300, 1)) * [1, 1, 1], 1e-5),
    "on a plane": (RNG.normal(size=(300, 3)) * [1, 1, 0], 1e-5),
    "on a grid of cell corners": (np.stack(np.meshgrid(*[np.arange(8)] * 3), -1).reshape(-1, 3), 1e-3),
    "coordinates of 1e6": (RNG.normal(size=(300, 3)) * 1e6, 1e-5),
    "far from the origin": (RNG.normal(size=(300, 3)) + 1e6, 1e-6),
    "clusters 1e-6 apart": (np.repeat(RNG.normal(size=(30, 3)), 10, 0) + RNG.normal(size=(300, 3)) * 1e-6, 1e-4),
    "a cluster of 1e-6 and one at 1e6": (np.vstack([RNG.normal(size=(200, 3)) * 1e-6, [[1e6] * 3]]), 5e-8),
    "24 levels": (np.vstack([RNG.uniform(0, 2.0**-22, size=(200, 3)), [[1, 1, 1]]]), 2.0**-25),
    "a tolerance for each splat": (RNG.normal(size=(2000, 3)), RNG.uniform(1e-5, 1e-1, size=2000)),
    "denormal extent": (RNG.uniform(0, 1e-38, size=(20, 3)), 1e-9),
    "largest floats": (RNG.uniform(-1, 1, size=(20, 3)) * 1e37, 1.0),
    "a shell": (SHELL, 1e-4),
    "a chain of halvings": (np.stack([2.0 ** -np.arange(40.0)] * 3, 1), 1e-13),
}


@pytest.mark.parametrize("name", ADVERSARIAL)
def test_adversarial(name):
    roundtrip(*ADVERSARIAL[name])
    roundtrip(*ADVERSARIAL[name], absolute=True)


def test_no_tree_is_deeper_than_float64_tells_levels_apart():
    """1e12 against 1e-9 asks for 71 levels."""
    means = np.vstack([RNG.uniform(0, 1e-6, size=(50, 3)), [[1e12, 0, 0]]]).astype(np.float32)
    streams, order = octree.build(means, 1e-9)
    assert streams.depth == octree.DEEPEST_LEVEL
    assert np.abs(octree.parse(streams, len(means)) - means[order]).max() <= 1e12 * 2.0**-23


COORDINATE = st.one_of(
    st.floats(-1e6, 1e6, width=32), st.sampled_from([0.0, 1.0, -1.0, 1e6, -1e6, 1e-6, 2.0**-24, 0.5])
)


@settings(max_examples=60)
@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 40), st.just(3)), elements=COORDINATE),
    st.floats(1e-7, 1e3),
)
def test_any_scene(means, tolerance):
    roundtrip(means, tolerance)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_streams_are_refused_alike_or_parse_to_the_right_count(data, monkeypatch):
    means = np.vstack([SHELL[:30], np.zeros((3, 3))]).astype(np.float32)
    streams, _ = octree.build(means, 1e-3, absolute=data.draw(st.booleans()))
    field = data.draw(st.sampled_from([*FIELDS, "depth"]))
    if field == "depth":
        damaged = data.draw(st.integers(0, 52))
    else:
        damaged = getattr(streams, field).copy()
        how = data.draw(st.sampled_from(["change", "cut", "extend"]))
        if how == "change" and len(damaged):
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
        elif how == "cut":
            damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
        else:
            damaged = np.append(damaged, np.array(data.draw(st.integers(0, 255)), damaged.dtype))
    hostile, found = dataclasses.replace(streams, **{field: damaged}), []
    for way in "01" if native() else "0":
        monkeypatch.setenv(VARIABLE, way)
        try:
            parsed = octree.parse(hostile, len(means))
            assert parsed.shape == (len(means), 3)
            assert np.isfinite(parsed).all()
            found.append(parsed.tobytes())
        except DataError as error:
            found.append(str(error))
    monkeypatch.delenv(VARIABLE)
    assert found[0] == found[-1]


def test_a_multiplicity_that_lies_takes_no_memory():
    streams, _ = octree.build(np.zeros((5, 3), np.float32), 1e-3)
    hostile = dataclasses.replace(streams, multiplicities=np.array([2**63], np.uint64))
    with pytest.raises(DataError, match="the header says 5"):
        octree.parse(hostile, 5)


@pytest.mark.parametrize("different", [1, 50, 10**6])
def test_splats_of_one_cell_keep_their_order(different):
    """Whatever the sort does with equal keys: in the file they follow each other as in the scene."""
    rng = np.random.default_rng(different)
    places = rng.uniform(-1, 1, (different, 3)).astype(np.float32)
    rows = rng.integers(0, different, 20_000)
    streams, order = octree.build(places[rows], 0.01)
    means = octree.parse(streams, len(rows))
    assert np.array_equal(np.sort(order), np.arange(len(rows)))
    same_leaf = (means[1:] == means[:-1]).all(axis=1)
    same_place = (rows[order][1:] == rows[order][:-1]) & same_leaf
    assert (np.diff(order)[same_place] > 0).all()
    assert same_place.any()


@NEEDS_LIBRARY
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


@NEEDS_LIBRARY
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


@NEEDS_LIBRARY
def test_trees_and_tails_of_other_sizes_are_refused():
    functions, nothing = native(), np.zeros(0, np.uint8)
    tree = native_octree.tree(functions, nothing, nothing, 3, False)
    assert tree is not None
    with pytest.raises(TypeError, match="another number of splats"):
        native_octree.Walk(functions, tree, np.zeros(1, np.uint8), np.zeros(0, np.uint64), 2, 1)
    with pytest.raises(TypeError, match="takes 1 of uint8"):
        native_octree.Walk(functions, tree, np.zeros(2, np.uint8), np.zeros(0, np.uint64), 1, 1)
    walk = native_octree.Walk(functions, tree, np.full(1, 3, np.uint8), np.zeros(0, np.uint64), 1, 1)
    with pytest.raises(TypeError, match="before their tails"):
        walk.centres(0, np.zeros(4), np.zeros(3))
    with pytest.raises(TypeError, match="tails of another size"):
        walk.check_tails(np.zeros(9, np.uint8))
    walk.leaves(0)
    with pytest.raises(TypeError, match="tails of another size"):
        walk.check_tails(np.zeros(8, np.uint8))
    with pytest.raises(TypeError, match="part that is not there"):
        walk.leaves(1)


@pytest.mark.parametrize(
    "tolerance", [1e-1, 1e-3, 1e-7, 1e-12], ids=["some share leaves", "one word", "two words", "cells beyond 32 bits"]
)
def test_the_same_octree_by_threads(monkeypatch, tolerance):
    """However many share out its splats, and its leaves in whatever order."""
    rng = np.random.default_rng(5)
    means = (rng.normal(size=(20_000, 3)) ** 3).astype(np.float32)
    means[:300] = means[300]
    wanted, wanted_order = octree.build(means, tolerance, absolute=True)
    assert (wanted.depth > 32) == (tolerance < 1e-10)
    monkeypatch.setattr(morton, "_LARGE", 1000)
    monkeypatch.setattr(morton, "_RANGE", 1024)
    monkeypatch.setattr(native_octree, "_AT_A_TIME", 3000)
    with thread_pool(3) as pool:
        tree, its_order = octree.build(means, tolerance, absolute=True, run=pool.map)
        walked = [octree.parse(tree, len(means), pool.map, parts) for parts in (1, 3, 40)]
    walked += [octree.parse(tree, len(means), lambda work, items: [*map(work, items[::-1])], parts) for parts in (2, 7)]
    assert np.array_equal(wanted_order, its_order)
    assert (tree.origin, tree.side, tree.depth) == (wanted.origin, wanted.side, wanted.depth)
    for name in FIELDS:
        assert np.array_equal(getattr(tree, name), getattr(wanted, name)), name
    monkeypatch.setenv(VARIABLE, "0")
    centres = octree.parse(tree, len(means))
    for each in walked:
        assert np.array_equal(each, centres)


def test_centres_beyond_single_precision_are_refused_as_a_decoder_does():
    means = np.float32([[3.4e38, 3.3e38, 0], [-3.4e38, 3.3e38, 0], [0, 3.3e38, 0]])
    begun = octree.begin(means, 1e39, absolute=True)
    with pytest.raises(DataError, match="single precision"):
        octree.parse(begun.streams(), 3)
    with pytest.raises(DataError, match="single precision"):
        begun.decoded(map)
