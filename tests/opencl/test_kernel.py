"""Kernels' arguments by name, checked against the declaration; structs that are described in the kernels' source."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.tools
import pytest

from potr_cl.opencl.device import Device
from potr_cl.opencl.kernel import declared_parameters
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.structs import struct_dtype

COLUMNS = ("raster/columns.cl", "columns")


@pytest.fixture(scope="module")
def device() -> Device:
    return Device()


def test_values_arrive_where_their_names_say(device):
    rows = np.arange(6, dtype=np.float32).reshape(3, 2)
    with Memory(device) as memory:
        source, result = memory.upload(rows, "rows"), memory.upload(np.full(8, -1, np.float32), "columns")
        kernel = device.kernel(*COLUMNS)
        kernel.bind(stride=4, width=2, result=result, first=0, rows=source).launch((3,))
        assert device.download(result, (2, 4), np.float32).tolist() == [[0, 2, 4, -1], [1, 3, 5, -1]]
        kernel.set(first=1)
        kernel.launch((3,))
        assert device.download(result, (2, 4), np.float32).tolist() == [[0, 0, 2, 4], [1, 1, 3, 5]]
    assert memory.nbytes == 0


def test_what_is_missing_or_unknown_is_named(device):
    kernel = device.kernel(*COLUMNS)
    with pytest.raises(TypeError, match=r"kernel columns lacks first, rows and does not know start: it takes rows, f"):
        kernel.bind(start=0, width=1, stride=4, result=None)
    with pytest.raises(TypeError, match=r"kernel columns does not know start: it takes rows, first, width"):
        kernel.set(start=0)


def test_values_of_another_kind_are_refused(device):
    kernel = device.kernel(*COLUMNS)
    with Memory(device) as memory:
        for values, said in [
            ({"rows": 3}, r"kernel columns: rows is global const float \*, not a int"),
            ({"first": memory.allocate(16, "something")}, "first is uint, not a Buffer"),
            ({"first": 1.0}, "first is uint, not a float"),
            ({"first": -1}, "first is uint, which does not hold -1"),
            ({"first": 1 << 32}, "first is uint, which does not hold 4294967296"),
        ]:
            with pytest.raises(TypeError, match=said):
                kernel.set(**values)
    with pytest.raises(TypeError, match=r"capacity is uint, not a str"):
        device.kernel("raster/sort_cpu.cl", "sort_tiles").set(capacity="3")


def test_a_struct_must_be_the_one_declared(device):
    fill = device.kernel("raster/tile_lists_cpu.cl", "count_tiles")
    view = struct_dtype("include/splat.clh", "View")
    fill.set(view=np.zeros((), view))
    with pytest.raises(TypeError, match=r"view is View, not a ndarray"):
        fill.set(view=np.zeros((), np.float32))


def test_a_kernel_that_is_not_declared(device):
    for ask in (device.kernel, declared_parameters):
        with pytest.raises(TypeError, match=r"raster/columns\.cl declares no kernel 'rows'"):
            ask("raster/columns.cl", "rows")


def test_every_kernel_can_be_read():
    found = 0
    for file in (Path(str(files("potr_cl"))) / "cl").glob("*/*.cl"):
        for kernel in re.findall(r"^(?:kernel .*?)?void (\w+)\($", file.read_text("utf-8"), re.MULTILINE):
            names = [parameter.name for parameter in declared_parameters(f"{file.parent.name}/{file.name}", kernel)]
            assert 0 < len(names) == len(set(names))
            found += 1
    assert found > 20


@pytest.mark.parametrize(
    ("source", "name"),
    [("include/splat.clh", "View"), ("include/view_set.clh", "SetView"), ("prune/choose_gpu.cl", "Removed"),
     ("prune/choose_gpu.cl", "State")],
)  # fmt: skip
def test_structs_are_laid_out_as_the_compiler_does(device, source, name):
    members = {"View": struct_dtype("include/splat.clh", "View")}
    dtype = struct_dtype(source, name)
    if name == "SetView":  # what it holds must be known to the compiler by name first
        matched, _ = cl.tools.match_dtype_to_c_struct(device.info.handle, "ViewProbe", members["View"])
        assert matched == members["View"]
        cl.tools.get_or_register_dtype("ViewProbe", matched)
    matched, _ = cl.tools.match_dtype_to_c_struct(device.info.handle, f"{name}Probe", dtype)
    assert matched == dtype


def test_members_that_compilers_may_pad_are_refused():
    with pytest.raises(TypeError, match=r"defines no struct 'Views'"):
        struct_dtype("include/view_set.clh", "Views")
    with pytest.raises(TypeError, match=r"'ulong'"):
        struct_dtype("prune/choose_gpu.cl", "Cut")
