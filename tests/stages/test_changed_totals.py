"""What has changed in a worker's totals arrives in those of the master, on its device as on the host."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.memory import Memory
from potr_cl.stages.pruning.buffers import SplatState
from potr_cl.stages.pruning.exchange import AddedChanges, ChangedTotals
from tests.devices import KERNELS, open_device


def states_of(alive):
    return np.where(alive, SplatState.ALIVE, SplatState.REMOVED).astype(np.uint8)


def changes(totals, before, alive):
    """A bit for each splat whose totals have changed, and by how much they have."""
    changed = (totals != before).any(axis=1) & alive
    bits = np.packbits(np.append(changed, np.zeros(-len(totals) % 64, bool)), bitorder="little")
    return bits.view("<u8"), totals[changed] - before[changed]


@pytest.mark.parametrize("kernels", KERNELS)
def test_changes_add_up_to_the_totals(kernels):
    """Round by round, some splats going on the way; and the host finds the same as the device."""
    worker, master = (open_device(kernels) for _ in range(2))
    for splats, numbered in [(1, False), (63, True), (64, False), (64, True), (1000, False), (1000, True)]:
        rng = np.random.default_rng(splats)
        numbers = np.sort(rng.permutation(2 * splats)[:splats]) if numbered else np.arange(splats)
        alive, totals, said = np.ones(splats, bool), np.zeros((splats, 2), np.int64), np.zeros((splats, 2), np.int64)
        with Memory(worker) as there, Memory(master) as here, AddedChanges(master) as added:
            states = there.upload(states_of(alive), "a test")
            sums = here.upload(np.zeros((2 * splats, 2), np.int64), "a test")
            own = here.upload(numbers.astype(np.uint32), "a test") if numbered else None
            with ChangedTotals(worker, splats, states) as changed:
                for _ in range(4):
                    some = rng.random(splats) < 0.3
                    totals[some] = rng.integers(-(2**62), 2**62, (int(some.sum()), 2))
                    alive[1:] &= rng.random(splats - 1) < 0.9
                    with Memory(worker) as more:
                        worker.queue.finish()
                        on_device = more.upload(totals, "a test")
                        write(worker, states, states_of(alive))
                        masks, found = changed.take(on_device)
                    expected = changes(totals, said, alive)
                    assert np.array_equal(masks, expected[0])
                    assert np.array_equal(found.widened(), expected[1])
                    said[alive] = totals[alive]
                    added.add(sums, (masks, found), splats, own)
                    result = master.download(sums, (2 * splats, 2), np.int64)
                    assert np.array_equal(result[numbers][alive], totals[alive])
                    assert not np.delete(result, numbers, axis=0).any()
        assert worker.allocated == master.allocated == 0


def write(device, buffer, array):
    cl.enqueue_copy(device.queue, buffer, array, is_blocking=True)


def test_changes_that_do_not_fit_their_bits_are_refused():
    device = open_device("gpu")
    with Memory(device) as memory, AddedChanges(device) as added:
        sums = memory.upload(np.zeros((64, 2), np.int64), "a test")
        with pytest.raises(ValueError, match="do not fit"):
            added.add(sums, (np.array([7], np.uint64), np.ones((2, 2), np.int64)), 64)


@pytest.mark.parametrize("words", [1, 3])
def test_bits_of_other_splats_are_refused(words):
    device = open_device("gpu")
    with Memory(device) as memory, AddedChanges(device) as added:
        sums = memory.upload(np.zeros((128, 2), np.int64), "a test")
        masks = np.zeros(words, np.uint64)
        masks[0] = 1
        with pytest.raises(ValueError, match="128 splats"):
            added.add(sums, (masks, np.ones((1, 2), np.int64)), 128)


def test_without_room_nothing_stays_on_the_device(monkeypatch):
    device, splats = open_device("gpu"), 6400
    with Memory(device) as memory:
        states = memory.upload(states_of(np.ones(splats, bool)), "a test")
        before = device.allocated
        # The bits and the runs have room, the totals have not.
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, memory=before + 16 * splats))
        with pytest.raises(DeviceMemoryError):
            ChangedTotals(device, splats, states)
        assert device.allocated == before
