"""Totals of the splats that are left go from one device to another, and to their places there."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.opencl.memory import Memory
from potr_cl.opencl.relay import Relay
from potr_cl.stages.pruning.buffers import SplatState
from potr_cl.stages.pruning.exchange import AlivePacking
from tests.devices import KERNELS, open_device


@pytest.mark.parametrize("kernels", KERNELS)
@pytest.mark.parametrize("splats", [1, 63, 64, 1000])
def test_what_is_left_arrives(kernels, splats):
    lender, borrower = (open_device(kernels) for _ in range(2))
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
