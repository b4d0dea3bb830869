"""GPU kernels assume nothing of which work-items run together, or first.

The kernels' work-items and work-groups get other numbers than the runtime gives them: whoever counted on a wave of 32
or 64 in step, or on a work-group before another, finds others there. Between barriers CPU runtimes run one work-item,
or one vector of them, after the other, so that nobody is in step by chance; Oclgrind (tools.stress.simulated) looks for
races besides.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl import device as opencl_device
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions

#: Other numbers of work-items along the first dimension, n at a time: scattered or backwards; groups go backwards.
_SHAKEN = """
inline size_t shaken_item(uint d)
{
    const size_t n = get_local_size(d), i = get_local_id(d);
    return d != 0 ? i : n & (n - 1) ? n - 1 - i : (77 * i + 13) & (n - 1);
}
inline size_t shaken_group(uint d)
{
    return get_num_groups(d) - 1 - get_group_id(d);
}
inline size_t shaken_global(uint d)
{
    return get_global_offset(d) + shaken_group(d) * get_local_size(d) + shaken_item(d);
}
#define get_local_id shaken_item
#define get_group_id shaken_group
#define get_global_id shaken_global
"""


@pytest.fixture
def shaken(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The kernel files whose work-items have got other numbers."""
    source = opencl_device.kernel_source
    files: list[str] = []

    def with_other_numbers(*arguments: Any) -> str:
        files.append(arguments[0])
        return _SHAKEN + source(*arguments)

    monkeypatch.setattr(opencl_device, "kernel_source", with_other_numbers)
    return files


@pytest.mark.parametrize("group", [64, 6])
def test_each_work_item_gets_one_number_and_another(group: int, shaken: list[str], tmp_path: Path) -> None:
    (tmp_path / "numbers.cl").write_text("""
        kernel void numbers(global uint *of_runtime)
        {
            const size_t mine = get_global_id(0);
            #undef get_global_id
            of_runtime[mine] = get_global_id(0);
        }""")
    device = Device(variants={"mine/numbers.cl": tmp_path / "numbers.cl"})
    count = 4 * group
    with Memory(device) as memory:
        numbers = memory.upload(np.full(count, -1, np.int32), "numbers")
        device.kernel("mine/numbers.cl", "numbers").bind(of_runtime=numbers).launch((count,), (group,))
        found = device.download(numbers, (count,), np.int32)
    assert sorted(found) == list(range(count))
    assert (found != np.arange(count)).any()
    assert set(found[:group]) == set(range(count - group, count))


@pytest.mark.slow
@pytest.mark.parametrize("choices", [{"preset": "best", "fit": {"on": True, "steps": 8}}, {"preset": "paper"}])
def test_an_encode_in_another_order_has_the_same_bytes(
    plush_excerpt: Scene, plush_excerpt_cameras: list[Camera], choices: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    options = EncodeOptions.for_preset(**choices, q=0.5, prune={"iterations": 3}, cameras_anyway=True)

    def made() -> bytes:
        return encode(plush_excerpt, plush_excerpt_cameras[:5], options, device=Device(family="gpu")).data

    as_numbered = made()
    shaken = request.getfixturevalue("shaken")
    assert made() == as_numbered
    assert "raster/composite_gpu.cl" in shaken
