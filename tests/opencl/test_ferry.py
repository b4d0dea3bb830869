"""Arrays on their way between the host and a device's memory, at once or piece by piece."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl import ferry
from potr_cl.opencl.device import Device
from potr_cl.opencl.ferry import Cargo, Ferry
from potr_cl.opencl.memory import Memory
from tests.devices import open_device


@pytest.fixture(params=[False, True], ids=["at once", "in pieces"])
def device(request, monkeypatch):
    """A device with memory of its own, as it says, whose arrays go in many pieces; or one with the host's."""
    device = open_device("gpu")
    if request.param:
        monkeypatch.setattr(ferry, "LEAST", 0)
        monkeypatch.setattr(ferry, "PIECE", 400)
        device = Device(dataclasses.replace(device.info, kind="gpu", integrated=False), family="gpu")
    yield device
    assert device.allocated == 0


def values(*shape: int):
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def test_rows_of_numbers(device):
    """Some behind others, and a gap between."""
    first, second = values(3001), values(7)
    with Memory(device) as memory, Ferry(device) as own:
        buffer = memory.upload(np.zeros(4000, np.float32), "numbers")
        own.to_device(buffer, [Cargo(first), Cargo(second, 4 * 3500)])
        wanted = np.zeros(4000, np.float32)
        wanted[:3001], wanted[3500:3507] = first, second
        assert np.array_equal(device.download(buffer, (4000,), np.float32), wanted)
        one, other = np.empty(3000, np.float32), np.empty(8, np.float32)
        own.to_host([Cargo(one, 4), Cargo(other, 4 * 3500)], buffer)
    assert np.array_equal(one, wanted[1:3001])
    assert np.array_equal(other, wanted[3500:3508])


@pytest.mark.parametrize("width", [10, 130], ids="{} columns".format)
@pytest.mark.parametrize("pitch", [0, 150])
def test_columns_of_a_matrix(device, width, pitch):
    """Also where a row is more than a piece."""
    matrix, columns = values(37, 200), range(40, 40 + width)
    with Memory(device) as memory, Ferry(device) as own:
        buffer = memory.upload(np.zeros((37, 150), np.float32), "a matrix")
        own.to_device(buffer, [Cargo(matrix, columns=columns)], pitch=4 * pitch)
        shape = (37, pitch or width)
        found = device.download(buffer, shape, np.float32)[:, :width]
        assert np.array_equal(found, matrix[:, 40 : 40 + width])
        back = matrix.copy()
        back[:, 40 : 40 + width] = -1
        own.to_host([Cargo(back, columns=columns)], buffer, pitch=4 * pitch)
    assert np.array_equal(back, matrix)


def test_what_was_sent_may_change(device):
    """As soon as it is on its way."""
    sent = values(5000)
    wanted = sent.copy()
    with Memory(device) as memory, Ferry(device) as own:
        buffer = memory.allocate(sent.nbytes, "numbers")
        own.to_device(buffer, [Cargo(sent)])
        sent[:] = 0
        assert np.array_equal(device.download(buffer, (5000,), np.float32), wanted)


@pytest.mark.parametrize("device", [True], indirect=True, ids=["in pieces"])
@pytest.mark.parametrize("to_device", [True, False], ids=["to the device", "to the host"])
def test_a_device_that_fails(device, monkeypatch, to_device):
    """Whoever copies is told in the project's words; what is closed afterwards is closed."""
    failed = cl.RuntimeError("clWaitForEvents failed: EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST")
    copy = Mock(wait=Mock(side_effect=failed))  # comes to nothing
    cargo = [Cargo(values(5000))]
    with Memory(device) as memory:
        buffer = memory.upload(cargo[0].values, "numbers")
        with Ferry(device) as own:
            monkeypatch.setattr(cl, "enqueue_copy", lambda *args, **kwargs: copy)
            with pytest.raises(DeviceError, match="failed while computing"):
                own.to_device(buffer, cargo) if to_device else own.to_host(cargo, buffer)
