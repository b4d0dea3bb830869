"""Large scenes on devices whose memory is the host's: views get less room, as the host's arrays need some."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from potr_cl.opencl.device import Device
from potr_cl.pipeline.fallback import for_views

GB = 1_000_000_000


def device(kind: str, integrated: bool = False) -> Device:
    shares = kind == "cpu" or integrated
    return cast(Device, SimpleNamespace(info=cast(Any, SimpleNamespace(kind=kind, shares_host_memory=shares))))


@pytest.mark.parametrize("given", [("cpu", False), ("gpu", True)])
def test_less_is_left_the_more_splats_there_are(given):
    rooms = [for_views(device(*given), 8 * GB, splats) for splats in (3_000_000, 10_000_000, 20_000_000, 500_000_000)]
    assert all(room is not None for room in rooms)
    assert rooms == sorted(cast(list[int], rooms), reverse=True)
    assert 4 * GB < rooms[1] < 7 * GB
    assert rooms[-1] == 2 * GB


def test_gpus_small_scenes_and_those_who_allow_all_have_what_they_had():
    assert for_views(device("gpu"), 8 * GB, 10_000_000) == 8 * GB
    assert for_views(device("cpu"), 8 * GB, 300_000) == 8 * GB
    assert for_views(device("cpu"), None, 10_000_000) is None
