"""Large arrays that are sent to a device piece by piece."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.opencl import sending
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.sending import Sending
from potr_cl.raster import scene_buffers
from potr_cl.raster.scene_buffers import uploaded
from tests.devices import FAMILIES, open_device
from tests.reference.scenes import random_scene


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0


def test_every_piece_arrives_in_its_turn(device):
    rng = np.random.default_rng(1)
    arrays = [rng.normal(size=(rng.integers(1, 500), 7)) for _ in range(40)]
    arrays[5] = arrays[5].astype(np.float32)[::2]
    with Sending(device, "rows") as sender:
        for array, buffer in zip(arrays, sender.pieces(arrays), strict=True):
            assert np.array_equal(device.download(buffer, array.shape, np.float32), array.astype(np.float32))


def test_work_that_is_enqueued_sees_its_own_piece(device):
    """Nobody waits between one piece and the next."""
    arrays = [np.full(1000, number, np.float32) for number in range(50)]
    add = device.kernel("prune/add_totals.cl", "add_totals")  # of 64-bit integers, whatever these floats are as such
    with Memory(device) as memory, Sending(device, "rows") as sender:
        sums = memory.upload(np.zeros(500, np.int64), "sums")
        for buffer in sender.pieces(arrays):
            add.bind(totals=sums, more=buffer, count=500).launch((512,))
        wanted = sum(array.view(np.int64).astype(object) for array in arrays)
        found = device.download(sums, (500,), np.int64)
    assert [int(each) for each in found] == [(int(each) + 2**63) % 2**64 - 2**63 for each in wanted]


def test_a_scene_that_is_sent_in_pieces_is_the_same(device, monkeypatch):
    scene = random_scene(5000, 2, seed=3)
    sent = []

    class Noting(Sending):
        def pieces(self, arrays):
            sent.append(len(arrays))
            return super().pieces(arrays)

    with uploaded(device, scene) as wanted:
        monkeypatch.setattr(sending, "LEAST", 1000)
        monkeypatch.setattr(sending, "PIECE", 50_000)
        monkeypatch.setattr(sending, "Sending", Noting)
        monkeypatch.setattr(scene_buffers, "_ACTIVATED", 700)
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", integrated=False))
        with uploaded(device, scene) as got:
            assert max(sent) > 8
            for name, columns in (("means", 3), ("scales", 3), ("quaternions", 4), ("log2_opacities", 1), ("sh", 27)):
                one, other = (
                    device.download(getattr(each, name), (columns, each.stride), np.float32) for each in (wanted, got)
                )
                assert np.array_equal(one, other), name
