"""What the tests of the re-fit share."""

from __future__ import annotations

import pytest

from tests.devices import KERNELS, open_device
from tests.reference.refit_cases import Case
from tests.reference.scenes import ring_of_cameras, visible_scene


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    device = open_device(request.param)
    yield device
    assert device.allocated == 0, "a re-fit did not give all its memory back"


@pytest.fixture
def case(device):
    with Case(device, visible_scene(40), visible_scene(60, 2, seed=7), ring_of_cameras(4, size=40)) as case:
        yield case
