"""What tests of the rasterizer share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from potr_cl.opencl.device import Device
from tests.devices import KERNELS, open_device


@pytest.fixture(scope="module", params=KERNELS)
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    """A device of each family, whose memory is given back in the end."""
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a rasterizer did not give all its memory back"
