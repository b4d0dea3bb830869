"""Integers arrive as they were, in the bits that they need."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.opencl.memory import Memory
from potr_cl.opencl.narrow import Narrowed, Narrowing
from tests.devices import KERNELS, open_device


def integers(count, seed):
    """Runs of all widths, with the least and the greatest of each."""
    rng = np.random.default_rng(seed)
    bits = np.repeat(rng.integers(0, 64, -(-count // 64)), 64)[:count]
    values = np.array([int(rng.integers(-(1 << b), 1 << b)) if b < 63 else int(rng.integers(-(2**63), 2**63 - 1))
                       for b in bits.tolist()], np.int64)  # fmt: skip
    values[:: max(count // 7, 1)] = np.resize([0, -1, 127, -128, 128, 2**63 - 1, -(2**63), 2**31, -(2**39) - 1],
                                              len(values[:: max(count // 7, 1)]))  # fmt: skip
    values[64:128] = 0
    return values


@pytest.mark.parametrize("kernels", KERNELS)
def test_integers_arrive_as_they_were(kernels):
    for count in [1, 63, 64, 65, 128, 2000]:
        values = integers(count, count)
        device = open_device(kernels)
        with Memory(device) as memory, Narrowing(device) as there, Narrowing(device) as here:
            narrowed = there.download(memory.upload(np.concatenate([[7, 8, 9], values]), "a test"), (count,), 3)
            assert np.array_equal(narrowed.widened(), values)
            assert narrowed.nbytes <= (128 + 1) * -(-count // 16)
            arrived = memory.upload(np.full(count + 2, 5), "a test")
            here.upload(arrived, narrowed)
            assert np.array_equal(device.download(arrived, (count + 2,), np.int64), [*values, 5, 5])
        assert device.allocated == 0


@pytest.mark.parametrize("kernels", KERNELS)
def test_columns_go_beside_each_other(kernels):
    """Those of a column are about as long; those of columns are not."""
    for rows, columns in [(1, 100), (17, 41), (36, 192)]:
        rng = np.random.default_rng(rows)
        long = rng.integers(1, 60, columns)
        values = (rng.standard_normal((rows, columns)) * 2.0**long).astype(np.int64)
        device = open_device(kernels)
        with Memory(device) as memory, Narrowing(device) as there, Narrowing(device) as here:
            lying = memory.upload(np.concatenate([[7, 8, 9], values.ravel()]), "a test")
            plain = there.download(lying, (rows, columns), 3).nbytes
            narrowed = there.download(lying, (rows, columns), 3, turned=True)
            assert np.array_equal(narrowed.widened(), values)
            arrived = memory.upload(np.full(rows * columns + 2, 5), "a test")
            here.upload(arrived, narrowed)
            assert np.array_equal(device.download(arrived, (rows * columns + 2,), np.int64), [*values.ravel(), 5, 5])
            if rows > 16:
                assert narrowed.nbytes < 0.85 * plain


@pytest.mark.parametrize("count", [0, 1, 200])
def test_integers_of_the_host(count):
    values = integers(2 * max(count, 1), 5)[: 2 * count].reshape(2, count)
    device = open_device("cpu")
    with Narrowing(device) as there, Narrowing(device) as here:
        assert np.array_equal(here.widened(there.narrowed(values)), values)
    assert device.allocated == 0


def test_small_integers_need_few_bits():
    device = open_device("gpu")
    values = np.random.default_rng(1).integers(-(2**18), 2**18, (20, 640))
    with Memory(device) as memory, Narrowing(device) as narrowing:
        narrowed = narrowing.download(memory.upload(values, "a test"), (20, 640))
        assert narrowed.nbytes <= (19 / 64 + 1 / 128) * values.nbytes
        assert np.array_equal(narrowed.widened(), values)
        assert narrowing.download(memory.upload(values, "a test"), (0, 2)).nbytes == 0


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": (65,)},
        {"shape": (64,), "turned": True},
        {"widths": np.array([65, 0, 0, 0], np.uint8), "data": np.zeros(65, np.uint16)},
        {"widths": np.array([2, 2, 2, 2, 0], np.uint8)},
        {"widths": np.zeros(0, np.uint8)},
        {"data": np.zeros(7, np.uint16)},
    ],
    ids=["more", "no table", "too wide", "more runs", "no run", "too short"],
)
def test_what_does_not_fit_is_refused(changes):
    good = Narrowed((64,), np.array([2, 2, 2, 2], np.uint8), np.zeros(8, np.uint16))
    assert not good.widened().any()
    with pytest.raises(ValueError, match="are not"):
        dataclasses.replace(good, **changes).starts()
