"""What goes from one device to another arrives there: changed totals, totals of what is left, vectors."""

from __future__ import annotations

import dataclasses
import itertools
from contextlib import ExitStack

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.relay import Relay
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.pruning.buffers import SplatState
from potr_cl.stages.pruning.exchange import AddedChanges, AlivePacking, ChangedTotals
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.exchange import Exchange, SparseVector
from potr_cl.stages.refitting.sliced_arrays import Layout
from tests.devices import KERNELS, shared_device


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
    worker, master = (shared_device(kernels, number) for number in range(2))
    for splats, numbered in [(1, False), (63, True), (64, False), (1000, True)]:
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
    device = shared_device("gpu")
    with Memory(device) as memory, AddedChanges(device) as added:
        sums = memory.upload(np.zeros((64, 2), np.int64), "a test")
        with pytest.raises(ValueError, match="do not fit"):
            added.add(sums, (np.array([7], np.uint64), np.ones((2, 2), np.int64)), 64)


@pytest.mark.parametrize("words", [1, 3])
def test_bits_of_other_splats_are_refused(words):
    device = shared_device("gpu")
    with Memory(device) as memory, AddedChanges(device) as added:
        sums = memory.upload(np.zeros((128, 2), np.int64), "a test")
        masks = np.zeros(words, np.uint64)
        masks[0] = 1
        with pytest.raises(ValueError, match="128 splats"):
            added.add(sums, (masks, np.ones((1, 2), np.int64)), 128)


def test_without_room_nothing_stays_on_the_device(monkeypatch):
    device, splats = shared_device("gpu"), 6400
    with Memory(device) as memory:
        states = memory.upload(states_of(np.ones(splats, bool)), "a test")
        before = device.allocated
        # The bits and the runs have room, the totals have not.
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, memory=before + 16 * splats))
        with pytest.raises(DeviceMemoryError):
            ChangedTotals(device, splats, states)
        assert device.allocated == before


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("splats", [1, 64, 1000])
def test_totals_of_what_is_left_arrive(kernels, splats):
    lender, borrower = (shared_device(kernels, number) for number in range(2))
    rng = np.random.default_rng(splats)
    totals = rng.integers(-(2**62), 2**62, (splats, 2))
    states = rng.choice([SplatState.REMOVED, SplatState.ALIVE, SplatState.JUST_REMOVED], splats).astype(np.uint8)
    states[0] = SplatState.ALIVE
    alive = states == SplatState.ALIVE
    with Memory(lender) as there, Memory(borrower) as here, Relay(borrower) as relay:
        sides = [
            AlivePacking(device, splats, memory.upload(states, "a test"))
            for device, memory in ((lender, there), (borrower, here))
        ]
        its = there.upload(totals, "a test")
        with sides[0] as from_there, sides[1] as to_here:
            whole = from_there.lend(its)
            assert whole.nbytes == 16 * splats
            assert not to_here.are_packed(whole)
            for side in (from_there, to_here):
                side.note()
            lent = from_there.lend(its)
            assert lent.nbytes == 16 * alive.sum()
            assert to_here.are_packed(lent) == (not alive.all())
            arrived = here.allocate(16 * splats, "a test")
            relay.fetch(arrived, lent)
            own = here.upload(np.full((splats, 2), 7, np.int64), "a test")
            to_here.unpack(arrived, own, add=True)
            assert np.array_equal(borrower.download(own, (splats, 2), np.int64), 7 + totals * alive[:, None])
            to_here.unpack(arrived, own, add=False)
            assert np.array_equal(borrower.download(own, (splats, 2), np.int64), totals * alive[:, None])
    assert lender.allocated == borrower.allocated == 0


@pytest.mark.parametrize("kernels", KERNELS)
def test_vectors_arrive_as_they_were(kernels):
    """To the last bit, and what is 0 does not travel."""
    device, splats = shared_device(kernels), 201
    for sh_count, part in itertools.product([1, 4, 16], [0.0, 0.1, 1.0]):
        rng = np.random.default_rng(sh_count)
        columns = rng.standard_normal((3 * sh_count, splats)).astype(np.float32)
        columns[rng.random(columns.shape) >= part] = 0
        columns[0, :4] = [-0.0, np.nan, np.inf, 1e-42]
        layout = Layout(splats, stride_of(splats), sh_count, 1)
        with ExitStack() as stack:
            here, there = (stack.enter_context(Coefficients(device, layout)) for _ in range(2))
            x, y = here.vector(), there.vector()
            for coefficients, vector in ((here, x), (there, y)):
                coefficients.zero(vector)
            here.write(x, columns)
            there.write(y, np.full_like(columns, 7))
            taking, giving = (stack.enter_context(Exchange(each)) for each in (here, there))
            sent = taking.send_vector(x)
            if part < 1:
                assert isinstance(sent, SparseVector)
                assert sent.nbytes == 8 * splats + 4 * np.count_nonzero(columns.view(np.uint32))
            assert sent.nbytes <= columns.nbytes
            giving.take_vector(y, sent)
            found = device.download(y, (layout.columns, layout.stride), np.float32)
            assert np.array_equal(found[:, :splats].view(np.uint32), columns.view(np.uint32))
            if isinstance(sent, SparseVector):
                with pytest.raises(ValueError, match="coefficients, where there should be"):
                    giving.take_vector(y, dataclasses.replace(sent, values=sent.values[1:]))
        assert device.allocated == 0
