"""An open device: programs, variants of kernels, memory and what is accounted for, errors; one opened ahead."""

from __future__ import annotations

import dataclasses
import gc
from collections import defaultdict, deque
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.opencl import ahead
from potr_cl.opencl import device as opencl_device
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.opencl.memory import Reused, Scratch
from potr_cl.opencl.source import kernel_source


@pytest.fixture(scope="module")
def device() -> Device:
    return Device()


def test_self_check_passes(device: Device) -> None:
    before = device.allocated
    device.self_check()
    assert device.allocated == before


def test_programs_are_built_once(device: Device) -> None:
    first = device.program("opencl/probe.cl", LANES=1)
    assert device.program("opencl/probe.cl", LANES=1) is first is not device.program("opencl/probe.cl", LANES=4)


def test_headers_are_included_once() -> None:
    source = kernel_source("raster/project.cl")
    assert "#include" not in source
    assert source.count("#define TILE ") == 1


def test_a_variant_takes_the_place_of_a_file(tmp_path: Path, device: Device) -> None:
    """Of a kernel file, of a header, and under a name of its own; what a variant includes comes from the package."""
    variants = {}
    for number, (name, text) in enumerate({
        "mine/probe.cl": '#include "mine/twice.clh"\nkernel void f(global float *x) { x[0] *= TWICE * TILE; }',
        "mine/twice.clh": '#include "include/subtiles.clh"\n#define TWICE 2\n',
        "include/subtiles.clh": "#define TILE 3\n",
    }.items()):  # fmt: skip
        variants[name] = tmp_path / str(number)
        variants[name].write_text(text)
    changed = Device(device.info, variants=variants)
    buffer = changed.upload(np.ones(1, np.float32), "a number")
    changed.kernel("mine/probe.cl", "f").bind(x=buffer).launch((1,))
    assert changed.download(buffer, (1,), np.float32) == 6
    assert "#define TILE 3" not in kernel_source("raster/project.cl")


def test_a_macro_and_flags_of_a_variant_reach_the_compiler(device: Device) -> None:
    def options(of: Device) -> str:
        program = of.program("raster/sort_gpu.cl", SORT_CAPACITY=2048)
        return str(program.get_build_info(of.info.handle, cl.program_build_info.OPTIONS))

    changed = Device(device.info, build_options=["-cl-mad-enable"], macros={"SORT_CAPACITY": 1024})
    assert "-DSORT_CAPACITY=1024" in options(changed)
    assert "SORT_CAPACITY=2048" not in options(changed)
    assert "-cl-mad-enable" in options(changed)
    assert "-DSORT_CAPACITY=2048" in options(device)
    assert "-cl-mad-enable" not in options(device)


def test_failing_build_names_the_device(device: Device) -> None:
    """And the compiler's reason, in one line."""
    with pytest.raises(DeviceError, match=r"failed to build opencl/probe.cl \(.*error.*--device") as error:
        device.program("opencl/probe.cl", LANES="nonsense")
    assert device.info.name in str(error.value)
    assert "clBuildProgram" not in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("excess", ["buffer", "memory"])
def test_allocation_beyond_the_device_is_refused(device: Device, excess: str) -> None:
    nbytes = device.info.largest_buffer + 1 if excess == "buffer" else device.info.memory + 1
    before = device.allocated
    with pytest.raises(DeviceError, match=r"cannot hold the splats of a test: .* MB .*--device"):
        device.allocate(nbytes, "the splats of a test")
    assert device.allocated == before


def test_upload_and_download(device: Device) -> None:
    array = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    before = device.allocated
    buffer = device.upload(array.transpose(2, 0, 1), "a test")  # any strides
    assert device.allocated == before + array.nbytes
    assert np.array_equal(device.download(buffer, (4, 2, 3), np.float32), array.transpose(2, 0, 1))
    device.free(buffer)
    assert device.allocated == before
    nothing = device.upload(np.empty(0, np.float32), "nothing")
    assert device.download(nothing, (0,), np.float32).size == 0
    device.free(nothing)


@pytest.mark.parametrize("count", [1, 4096, 4097, 5003])
@pytest.mark.parametrize("value", [np.uint8(7), np.float32(-np.inf), np.int64(-3 << 40)])
def test_large_buffers_are_filled_too(
    device: Device, count: int, value: np.generic, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opencl_device, "_FILLED", 4096)  # a gigabyte would take too long
    expected = np.arange(count + 8).astype(value.dtype)
    buffer = device.upload(expected, "a test")
    device.fill(buffer, value, count * value.nbytes)
    expected[:count] = value
    assert np.array_equal(device.download(buffer, (count + 8,), value.dtype), expected)
    device.fill(buffer, value)
    assert (device.download(buffer, (count + 8,), value.dtype) == value).all()
    device.free(buffer)


def test_the_same_memory_is_taken_again(device: Device) -> None:
    before = device.allocated
    memory = Reused(device)
    taken = []
    for turn, counts in enumerate([(1000, 5000), (900, 5000), (300, 7000, 10), (300, 7000)]):
        buffers = [memory.allocate(4 * count, "a test") for count in counts]
        for value, (buffer, count) in enumerate(zip(buffers, counts, strict=True)):
            device.fill(buffer, np.uint32(10 * turn + value), 4 * count)
        for value, (buffer, count) in enumerate(zip(buffers, counts, strict=True)):
            assert (device.download(buffer, (count,), np.uint32) == 10 * turn + value).all()
        taken.append(device.allocated - before)
        assert memory.nbytes == taken[-1]
        words = np.arange(50 + turn, dtype=np.uint32)
        assert np.array_equal(device.download(memory.upload(words, "a test"), words.shape, np.uint32), words)
        memory.close()
    assert 24_000 <= taken[0] <= taken[1] < 31_000
    assert 32_000 <= taken[2] <= taken[3] < 42_000
    # Kernels want a buffer of nothing, too, if only to leave it alone.
    for nothing in (memory.allocate(0, "a test"), memory.upload(np.zeros(0, np.uint32), "a test")):
        assert nothing is not None
    memory.close()
    memory.give_back()
    assert device.allocated == before


def test_scratch_grows_and_survives_failure(device: Device) -> None:
    before = device.allocated
    scratch = Scratch(device, "a test")
    assert scratch.reserve(100)
    first = scratch.buffer
    assert not scratch.reserve(50)
    assert scratch.buffer is first
    with pytest.raises(DeviceError):
        scratch.reserve(device.info.memory * 2)
    assert scratch.nbytes == 0
    assert scratch.reserve(10)
    scratch.close()
    scratch.close()
    assert device.allocated == before


def test_stage_times_need_profiling(device: Device) -> None:
    profiled = Device(device.info, profiling=True)
    profiled.stage_times()
    profiled.self_check()
    times = profiled.stage_times()
    assert times["probe_integers"] > 0
    assert profiled.stage_times() == {}
    device.self_check()
    assert device.stage_times() == {}


NO_MEMORY = [
    cl.MemoryError("clEnqueueNDRangeKernel failed: MEM_OBJECT_ALLOCATION_FAILURE"),
    cl.RuntimeError("clCreateBuffer failed: OUT_OF_HOST_MEMORY"),
    cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES"),
    cl.RuntimeError("clWaitForEvents failed: MEM_OBJECT_ALLOCATION_FAILURE - more"),
    cl.LogicError("clCreateBuffer failed: INVALID_BUFFER_SIZE"),
    MemoryError("std::bad_alloc"),
    MemoryError(),
]
OTHER_FAULTS = [
    cl.LogicError("clSomething failed: INVALID_VALUE\nmore"),
    cl.RuntimeError("clBuildProgram failed: X\n\nBuild on <A>:\n\nerror: OUT_OF_RESOURCES is no type"),
]


@pytest.mark.parametrize("error", [*NO_MEMORY, *OTHER_FAULTS], ids=str)
def test_driver_errors_become_device_errors(device: Device, error: Exception) -> None:
    with pytest.raises(DeviceError) as caught, device.errors("failed to think"):
        raise error
    assert (type(caught.value) is DeviceMemoryError) == (error in NO_MEMORY)
    assert ("ran out of memory" if error in NO_MEMORY else "failed to think") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_launch_that_finds_no_memory(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_arguments: object) -> None:
        raise cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_HOST_MEMORY")

    kernel = device.kernel("opencl/probe.cl", "probe_integers", LANES=1)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", refuse)
    with pytest.raises(DeviceMemoryError):
        kernel.launch((64,))


def test_memory_in_use_is_given_back_when_the_device_is_done() -> None:
    """Where a driver would wait itself, and hold up all threads, it is waited for before."""
    info = choose_device()
    there = Device(dataclasses.replace(info, platform="NVIDIA CUDA"), family=info.family)
    add = there.kernel("prune/add_totals.cl", "add_totals")
    count = 1 << 20
    totals, more = (there.upload(np.zeros(count, np.int64), "a test") for _ in range(2))
    for _ in range(50):
        add.bind(totals=totals, more=more, count=count).launch((count,), (64,))
    last = cl.enqueue_marker(there.queue)
    there.free(totals)
    assert last.command_execution_status == cl.command_execution_status.COMPLETE
    there.free(more)
    assert there.allocated == 0


def test_the_narrowest_sub_groups_are_found_by_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where kernels can choose how wide they are; a CPU's runtime can say so, too, but its kernels need not."""
    info = dataclasses.replace(choose_device(), kind="gpu")
    if "cl_intel_required_subgroup_size" not in info.handle.extensions:
        pytest.skip("no device here whose kernels can choose")
    assert Device(family="gpu").sub_group is None
    assert Device(info, family="gpu").sub_group == 8
    builds, exact = [], Device._native_exp2_is_exact

    def fails_once(device: Device) -> bool:
        builds.append(device.sub_group)
        if builds == [8]:
            raise DeviceError("refused")
        return exact(device)

    monkeypatch.setattr(Device, "_native_exp2_is_exact", fails_once)
    wide = Device(info, family="gpu")
    assert wide.sub_group == 16
    assert builds == [8, 16, 16]
    program = wide.program("opencl/probe.cl", LANES=1)
    assert "-DSUB_GROUP=16" in program.get_build_info(info.handle, cl.program_build_info.OPTIONS)


# Opened before somebody asks for it -----------------------------------------------------------------------------------


@pytest.fixture
def contexts(monkeypatch):
    """The devices of which contexts are made, in their order."""
    made = []
    real = ahead.new_context

    def counted(handle):
        made.append(handle)
        return real(handle)

    gc.collect()  # devices of other tests leave their contexts now
    monkeypatch.setattr(ahead, "_begun", None)
    monkeypatch.setattr(ahead, "new_context", counted)
    monkeypatch.setattr(ahead, "_left", defaultdict(lambda: deque(maxlen=0)))  # nothing of other tests
    return made


def test_who_opens_a_device_again_and_again_has_one_context(contexts, monkeypatch):
    """Drivers never give back all that they take for one."""
    monkeypatch.setattr(ahead, "_left", defaultdict(lambda: deque(maxlen=1)))
    for _ in range(3):
        device = Device()
        device.shared_kernel("opencl/fill.cl", "fill")
        del device
    assert len(contexts) == 1
    with suppress(DeviceError), Device().errors("has failed"):
        raise cl.RuntimeError("of the device")
    Device()
    assert len(contexts) == 2  # that of a device that has failed is left to nobody


def test_what_was_begun_is_taken_once(contexts):
    info = choose_device()
    ahead.begin_to_open(None)
    first, second = Device(), Device()
    assert contexts == [info.handle] * 2
    assert first.context.devices == second.context.devices == [info.handle]
    assert first.context != second.context


@pytest.mark.parametrize("spec", ["no such device", "all", "0,1", None])
def test_whatever_was_begun_a_device_opens(spec, contexts):
    """Also where nothing has begun because the name fits no device, or several."""
    ahead.begin_to_open(spec, whole=spec is not None)
    device = Device()
    assert device.context.devices == [device.info.handle]
    with pytest.raises(DeviceError, match="no such device"):
        Device("no such device")


def test_a_context_of_another_device_is_left_alone(contexts):
    ahead.begin_to_open(None)
    other = SimpleNamespace(handle=object())
    with pytest.raises(AttributeError):  # an object is no device: it was asked all the same
        ahead.context_of(other)
    assert contexts == [choose_device().handle, other.handle]


def test_several_devices_are_begun_together(contexts, monkeypatch):
    info = choose_device()
    monkeypatch.setattr(ahead, "choose_devices", lambda spec: [info, info])
    ahead.begin_to_open("all")
    devices = [Device(info) for _ in range(3)]
    assert contexts == [info.handle] * 3  # two that were begun, and one more
    assert len({device.context.int_ptr for device in devices}) == 3
