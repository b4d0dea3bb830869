"""What one device lends, another one has: whole, in parts, and no sooner than it is there."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from potr_cl.opencl import relay
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.relay import Lent, Relay
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=KERNELS)
def devices(request):
    devices = [open_device(request.param) for _ in range(2)]
    yield devices
    assert [device.allocated for device in devices] == [0, 0]


@pytest.fixture(params=["apart", "the same"])
def between(request, devices):
    """Who lends, and who is lent to."""
    return devices if request.param == "apart" else [devices[0]] * 2


def test_all_arrives(between, monkeypatch):
    """And a part of it."""
    lender, borrower = between
    monkeypatch.setattr(relay, "_SLICE", 4096)  # many slices, and a last one that is shorter
    for count in [1, 4096, 4097, 20_003]:
        values = np.random.default_rng(count).integers(0, 2**32, count, np.uint32)
        with Memory(lender) as there, Memory(borrower) as here, Relay(borrower) as relayed:
            lent = Lent(lender, there.upload(0 * values, "a test"), values.nbytes)
            lent.lend(there.upload(values, "a test"))  # another buffer in its place
            target = here.upload(np.zeros(count + 1, np.uint32), "a test")
            for _ in range(2):  # the second time through memory that is there already
                relayed.fetch(target, lent)
                found = borrower.download(target, (count + 1,), np.uint32)
                assert np.array_equal(found, [*values, 0])
            if count > 10_000:
                relayed.fetch(target, lent, 4 * 1000, 4 * 3000)
                found = borrower.download(target, (count,), np.uint32)
                assert np.array_equal(found, np.concatenate([values[1000:4000], values[3000:]]))


def test_it_is_lent_as_it_is_after_what_was_enqueued(between):
    """Nobody waits between a kernel and a loan: what is read is what the kernel leaves."""
    lender, borrower = between
    count = 1 << 16
    with Memory(lender) as there, Memory(borrower) as here, Relay(borrower) as relayed:
        totals, ones = (there.upload(np.full(count, value, np.int64), "a test") for value in (0, 1))
        target = here.allocate(8 * count, "a test")
        add = lender.kernel("prune/add_totals.cl", "add_totals").bind(totals=totals, more=ones, count=count)
        for rounds in range(1, 6):
            for _ in range(20):
                add.launch((count,), (64,))
            relayed.fetch(target, Lent(lender, totals, 8 * count))
            assert (borrower.download(target, (count,), np.int64) == 20 * rounds).all()


def test_devices_are_forgotten_with_what_their_relays_left(devices):
    """The memory of closed relays is kept for the next ones of the device, and no longer than that."""
    borrower = open_device("gpu")
    lender = devices[0]
    with Memory(lender) as there:
        lent = Lent(lender, there.upload(np.arange(1000), "a test"), 8000)
        for _ in range(3):
            with Memory(borrower) as here, Relay(borrower) as relayed:
                target = here.allocate(8000, "a test")
                relayed.fetch(target, lent)
                assert np.array_equal(borrower.download(target, (1000,), np.int64), np.arange(1000))
    gone = weakref.ref(borrower)
    del borrower, here, relayed, target
    gc.collect()
    assert gone() is None
