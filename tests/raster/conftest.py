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


@pytest.fixture(scope="module", params=[kernels for kernels in KERNELS if "gpu" in str(kernels)])
def gpu(request: pytest.FixtureRequest) -> Iterator[Device]:
    """The same with GPUs' kernels alone, which take several views at a time."""
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a rasterizer did not give all its memory back"
