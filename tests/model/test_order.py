"""Stable orders of many numbers, found by threads."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.host.threads import thread_pool
from potr_cl.model import order
from potr_cl.model.order import BITS, ascending, morton_codes, morton_order


@pytest.fixture(autouse=True)
def _small_ranges(monkeypatch):
    """So that a few thousand numbers are many."""
    monkeypatch.setattr(order, "_LARGE", 1000)
    monkeypatch.setattr(order, "_RANGE", 128)
    monkeypatch.setattr(order, "_DEALT", 700)
    monkeypatch.setattr(order, "_ROWS", 300)


@pytest.mark.parametrize("kind", ["all equal", "few values", "large", "sorted", "normal"])
@pytest.mark.parametrize("count", [0, 999, 1000, 5021])
def test_it_is_the_stable_order(kind, count):
    rng = np.random.default_rng(3)
    score = {
        "all equal": np.full(count, 7, np.uint64),
        "few values": rng.integers(0, 5, count).astype(np.uint64),
        "large": rng.integers(0, 1 << 64, count, dtype=np.uint64),
        "sorted": np.arange(count, dtype=np.uint64),
        "normal": rng.normal(size=count),
    }[kind]
    wanted = np.argsort(score, kind="stable")
    assert np.array_equal(ascending(score), wanted)
    with thread_pool(3) as pool:
        assert np.array_equal(ascending(score, pool.map), wanted)


def test_morton_codes_have_the_bits_of_three_coordinates_in_turn():
    rng = np.random.default_rng(4)
    means = rng.normal(size=(2000, 3)).astype(np.float32)
    means[5], means[6] = 1e30, -1e30
    codes = morton_codes(means)
    low, high = np.percentile(means.astype(np.float64), (2, 98), axis=0)
    side = 2 * (high - low).max()
    cells = (means - ((low + high) / 2 - side / 2)) * ((1 << BITS) / side)
    cells = np.clip(cells, 0, (1 << BITS) - 1).astype(np.uint64)
    bits = [cells[:, axis] >> np.uint64(bit) & np.uint64(1) for bit in range(BITS) for axis in range(3)]
    assert np.array_equal(codes, sum(bit << np.uint64(at) for at, bit in enumerate(bits)))
    assert np.array_equal(morton_order(means), np.argsort(codes, kind="stable"))
