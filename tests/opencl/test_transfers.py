"""Arrays on their way: to a device and back, at once or in pieces, from one device to another, in few bits."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl import ferry, relay, sending
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.narrow import Narrowed, Narrowing
from potr_cl.opencl.relay import Lent, Relay
from potr_cl.opencl.sending import Sending
from potr_cl.raster import scene_buffers
from potr_cl.raster.scene_buffers import uploaded
from tests.devices import FAMILIES, KERNELS, open_device
from tests.reference.scenes import random_scene

# Between the host and a device ----------------------------------------------------------------------------------------


@pytest.fixture(params=[False, True], ids=["at once", "in pieces"])
def carrier(request, monkeypatch):
    """A device with memory of its own, as it says, whose arrays go in many pieces; or one with the host's."""
    device = open_device("gpu")
    if request.param:
        monkeypatch.setattr(ferry, "LEAST", 0)
        monkeypatch.setattr(ferry, "PAYS", 0)
        monkeypatch.setattr(ferry, "PIECE", 400)
        device = Device(dataclasses.replace(device.info, kind="gpu", integrated=False), family="gpu")
    yield device
    assert device.allocated == 0


def some(*shape: int):
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def test_rows_of_numbers(carrier):
    """Some behind others, and a gap between."""
    first, second = some(3001), some(7)
    with Memory(carrier) as memory, Ferry(carrier) as own:
        buffer = memory.upload(np.zeros(4000, np.float32), "numbers")
        own.to_device(buffer, [Cargo(first), Cargo(second, 4 * 3500)])
        wanted = np.zeros(4000, np.float32)
        wanted[:3001], wanted[3500:3507] = first, second
        assert np.array_equal(carrier.download(buffer, (4000,), np.float32), wanted)
        one, other = np.empty(3000, np.float32), np.empty(8, np.float32)
        own.to_host([Cargo(one, 4), Cargo(other, 4 * 3500)], buffer)
    assert np.array_equal(one, wanted[1:3001])
    assert np.array_equal(other, wanted[3500:3508])


@pytest.mark.parametrize("width", [10, 130], ids="{} columns".format)
@pytest.mark.parametrize("pitch", [0, 150])
def test_columns_of_a_matrix(carrier, width, pitch):
    """Also where a row is more than a piece."""
    matrix, columns = some(37, 200), range(40, 40 + width)
    with Memory(carrier) as memory, Ferry(carrier) as own:
        buffer = memory.upload(np.zeros((37, 150), np.float32), "a matrix")
        own.to_device(buffer, [Cargo(matrix, columns=columns)], pitch=4 * pitch)
        shape = (37, pitch or width)
        found = carrier.download(buffer, shape, np.float32)[:, :width]
        assert np.array_equal(found, matrix[:, 40 : 40 + width])
        back = matrix.copy()
        back[:, 40 : 40 + width] = -1
        own.to_host([Cargo(back, columns=columns)], buffer, pitch=4 * pitch)
    assert np.array_equal(back, matrix)


def test_what_was_sent_may_change(carrier):
    """As soon as it is on its way."""
    sent = some(5000)
    wanted = sent.copy()
    with Memory(carrier) as memory, Ferry(carrier) as own:
        buffer = memory.allocate(sent.nbytes, "numbers")
        own.to_device(buffer, [Cargo(sent)])
        sent[:] = 0
        assert np.array_equal(carrier.download(buffer, (5000,), np.float32), wanted)


@pytest.mark.parametrize("carrier", [True], indirect=True, ids=["in pieces"])
@pytest.mark.parametrize("to_device", [True, False], ids=["to the device", "to the host"])
def test_a_device_that_fails(carrier, monkeypatch, to_device):
    """Whoever copies is told in the project's words; what is closed afterwards is closed."""
    failed = cl.RuntimeError("clWaitForEvents failed: EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")
    copy = Mock(wait=Mock(side_effect=failed))  # comes to nothing
    cargo = [Cargo(some(5000))]
    with Memory(carrier) as memory:
        buffer = memory.upload(cargo[0].values, "numbers")
        with Ferry(carrier) as own:
            monkeypatch.setattr(cl, "enqueue_copy", lambda *args, **kwargs: copy)
            with pytest.raises(DeviceError, match="failed while computing"):
                own.to_device(buffer, cargo) if to_device else own.to_host(cargo, buffer)


# Large arrays, sent piece by piece ------------------------------------------------------------------------------------


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


# What one device lends, another one has -------------------------------------------------------------------------------


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


# Integers in the bits that they need ----------------------------------------------------------------------------------


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
