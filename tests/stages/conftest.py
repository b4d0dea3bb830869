"""Devices that tests of stages share, and a scene to re-fit."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from potr_cl.model.camera import resized, train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from tests.cases.ridges import COMPACTING, compacting_device
from tests.devices import FAMILIES, KERNELS, shared_device
from tests.reference.refit_cases import Case
from tests.reference.scenes import ring_of_cameras, visible_scene


def _watched(device: Device) -> Iterator[Device]:
    yield device
    assert device.allocated == 0, "not all memory was given back"


@pytest.fixture(scope="module", params=KERNELS)
def device(request):
    """Each family, on each runtime."""
    yield from _watched(shared_device(request.param))


@pytest.fixture(scope="module", params=FAMILIES)
def family_device(request):
    """Each family."""
    yield from _watched(shared_device(request.param))


@pytest.fixture(scope="module", params=[kernels for kernels in KERNELS if "gpu" in str(kernels)])
def gpu(request):
    """Kernels for GPUs, on each runtime."""
    yield from _watched(shared_device(request.param))


@pytest.fixture(scope="module")
def usual_device():
    """The device that is taken by default, as it is."""
    yield from _watched(shared_device(choose_device().family))


@pytest.fixture(scope="module", params=COMPACTING)
def compacting(request):
    """Devices that the compaction runs on."""
    with compacting_device(request.param) as device:
        yield device


@pytest.fixture(scope="session")
def small_views(plush_excerpt_cameras):
    """The training views of the excerpt, in pictures of 120 x 90."""
    return [resized(camera, 120, 90) for camera in train_views(plush_excerpt_cameras)]


@pytest.fixture
def case(device):
    with Case(device, visible_scene(20), visible_scene(60, 2, seed=7), ring_of_cameras(3, size=40)) as case:
        yield case
