"""OpenCL devices: which there are, which to take, and one object that owns a context, its programs and its memory."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
import logging
import os
import re
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from platform import machine
from typing import Any, Literal

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.opencl import compiler

Family = Literal["cpu", "gpu"]

logger = logging.getLogger("potr_cl")

#: Environment variable that stands in for ``--device``.
DEVICE_VARIABLE = "POTR_CL_DEVICE"

_ICD_VARIABLE = "OCL_ICD_VENDORS"
_WINDOWS_ICD_VARIABLE = "OCL_ICD_FILENAMES"
_INTEL_PACKAGE = "intel-opencl-rt"
_INTEL_LIBRARY = "libintelocl.so"
_INTEL_WINDOWS_LIBRARY = "intelocl64.dll"


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device and what matters about it.

    Attributes:
        index: position in :func:`list_devices`; what ``--device INDEX`` means.
        name, platform, version: as the driver spells them; ``version`` is the platform's.
        kind: "gpu", "cpu" or "accelerator".
        integrated: a GPU that shares the host's memory.
        memory: bytes of global memory. largest_buffer: bytes that one buffer may have.
        local_memory: bytes of local memory a work-group.
        compute_units: as the driver counts them.
        vector_width: floats in the native vector (1 where scalar code is what the device wants).
        max_work_group: work-items that fit one work-group.
        family: which kernels it will run: "gpu" (a work-group a tile) or "cpu" (row vectors).
        handle: the pyopencl device.
    """

    index: int
    name: str
    platform: str
    version: str
    kind: Literal["gpu", "cpu", "accelerator"]
    integrated: bool
    memory: int
    largest_buffer: int
    local_memory: int
    compute_units: int
    vector_width: int
    max_work_group: int
    family: Family
    handle: cl.Device

    def __str__(self) -> str:
        return f"'{self.name}' ({self.platform})"


def _installed_by_pip(library: str) -> Path | None:
    """Where pip put this library of Intel's CPU runtime; None if it did not."""
    try:
        paths = importlib.metadata.files(_INTEL_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    path = next((Path(str(p.locate())).resolve() for p in paths if p.name == library), None)
    return path if path is not None and path.exists() else None


def _register_intel_runtime_on_windows() -> None:
    """As :func:`_register_intel_runtime`, for Windows' loader: it reads a list of libraries beside the registry."""
    library = _installed_by_pip(_INTEL_WINDOWS_LIBRARY)
    known = os.environ.get(_WINDOWS_ICD_VARIABLE, "")
    if library is not None and _INTEL_WINDOWS_LIBRARY not in known:
        os.environ[_WINDOWS_ICD_VARIABLE] = f"{known}{os.pathsep}{library}" if known else str(library)


def _register_intel_runtime() -> None:
    """Make the loader see Intel's CPU runtime where pip installed it.

    Its wheel brings an ``.icd`` file that holds a placeholder path, so a folder is made with an ``.icd`` of the real
    path beside links to all those that the loader would have read. Must run before the first platform query.
    """
    library = _installed_by_pip(_INTEL_LIBRARY)
    if library is None:
        return
    known = os.environ.get(_ICD_VARIABLE) or os.environ.get("OPENCL_VENDOR_PATH") or "/etc/OpenCL/vendors"
    vendors = Path(known)
    if not vendors.is_dir():
        if vendors.exists() or _ICD_VARIABLE in os.environ:
            return  # the user points the loader to one library: that is an order
        others: list[Path] = []
    else:
        others = sorted(vendors.glob("*.icd"))
    if any(_INTEL_LIBRARY in icd.read_text(errors="replace") for icd in others):
        return
    contents = {icd.name: icd.read_text(errors="replace") for icd in others}
    contents["potr_cl_intel_cpu.icd"] = f"{library}\n"
    digest = hashlib.sha256(repr(sorted(contents.items())).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"potr_cl_icd_{os.getuid()}_{digest}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        if folder.stat().st_uid != os.getuid():
            return  # someone else's folder: do not load libraries that it names
        for name, text in contents.items():
            partial = folder / f".{name}.{os.getpid()}"
            partial.write_text(text)
            partial.replace(folder / name)
    except OSError as error:
        logger.warning("cannot register Intel's CPU runtime: %s", error)
        return
    os.environ[_ICD_VARIABLE] = str(folder)


_devices: list[DeviceInfo] | None = None
_listing = threading.Lock()


def list_devices() -> list[DeviceInfo]:
    """All usable OpenCL devices, in the order of the platforms.

    Platforms that fail to answer or have no device are left out, each with a warning or silently as they deserve. The
    first call loads the drivers; other threads go on meanwhile.
    """
    global _devices
    with _listing:
        if _devices is None:
            _devices = list(_find_devices())
    return list(_devices)


def _loader_function(name: str) -> Any:
    """A function of the OpenCL loader that pyopencl has loaded; None where it cannot be had.

    pyopencl would call it too, but keep all other threads waiting meanwhile; a driver takes a tenth of a second to load
    and another to make a context.
    """
    # First what the whole process sees: a library may stand before the loader, as Oclgrind's does.
    for library in (None, cl._cl.__file__):
        with suppress(OSError, AttributeError, TypeError):
            return getattr(ctypes.CDLL(library), name)
    return None


def _load_drivers() -> None:
    list_platforms, list_handles = _loader_function("clGetPlatformIDs"), _loader_function("clGetDeviceIDs")
    if list_platforms is None or list_handles is None:
        return
    every_type = ctypes.c_uint64(0xFFFFFFFF)
    count = ctypes.c_uint()
    list_platforms(0, None, ctypes.byref(count))
    platforms = (ctypes.c_void_p * count.value)()
    list_platforms(count, platforms, None)
    for platform in platforms:
        list_handles(ctypes.c_void_p(platform), every_type, 0, None, ctypes.byref(count))


def _new_context(handle: cl.Device) -> cl.Context:
    create = _loader_function("clCreateContext")
    if create is not None:
        create.restype = ctypes.c_void_p
        error = ctypes.c_int()
        devices = (ctypes.c_void_p * 1)(handle.int_ptr)
        context = create(None, 1, devices, None, None, ctypes.byref(error))
        if context:
            return cl.Context.from_int_ptr(context, retain=False)
    return cl.Context([handle])  # which says what is wrong


def _find_devices() -> Iterator[DeviceInfo]:
    if hasattr(os, "getuid"):
        _register_intel_runtime()
    else:
        _register_intel_runtime_on_windows()
    _load_drivers()
    try:
        platforms = cl.get_platforms()
    except cl.Error as error:  # the loader's way of saying that there is none
        logger.debug("no OpenCL platform: %s", error)
        return
    index = 0
    for platform in platforms:
        try:
            handles = platform.get_devices()
        except cl.Error as error:
            logger.debug("OpenCL platform without a device: %s", error)
            continue
        for handle in handles:
            try:
                info = _describe(index, platform, handle)
            except cl.Error as error:
                logger.warning("leaving out an OpenCL device that cannot be queried: %s", error)
                continue
            if handle.available and handle.compiler_available:
                yield info
                index += 1


def _describe(index: int, platform: cl.Platform, handle: cl.Device) -> DeviceInfo:
    kind: Literal["gpu", "cpu", "accelerator"] = "accelerator"
    if handle.type & cl.device_type.GPU:
        kind = "gpu"
    elif handle.type & cl.device_type.CPU:
        kind = "cpu"
    native = int(handle.native_vector_width_float)
    # A CPU runtime that asks for scalars packs work-items into vectors itself, as GPUs do (Mesa's llvmpipe, which also
    # ends every loop after 65,535 rounds: too few for one work-item a tile).
    family: Family = "cpu" if kind == "cpu" and native > 1 else "gpu"
    return DeviceInfo(
        index=index,
        name=handle.name.strip(),
        platform=platform.name.strip(),
        version=platform.version.strip(),
        kind=kind,
        integrated=bool(handle.host_unified_memory),
        memory=int(handle.global_mem_size),
        largest_buffer=int(handle.max_mem_alloc_size),
        local_memory=int(handle.local_mem_size),
        compute_units=int(handle.max_compute_units),
        vector_width=max(w for w in (1, 4, 8, 16) if w <= max(native, 1)),
        max_work_group=int(handle.max_work_group_size),
        family=family,
        handle=handle,
    )


def _preference(info: DeviceInfo) -> tuple[float, ...]:
    """Sort key, best first: discrete GPU, integrated GPU, accelerator, CPU runtimes by measured speed."""
    platform = info.platform.lower()
    if "oclgrind" in platform or "fpga emulation" in platform:  # a simulator is nobody's first choice
        return (9, 0, info.index)
    if info.kind == "gpu":
        return (1 if info.integrated else 0, 0, info.index)
    if info.kind == "accelerator":
        return (2, 0, info.index)
    if "intel" in platform:
        return (3, 0, info.index)
    if _is_pocl(info):
        release = re.search(r"pocl (\d+)\.(\d+)", info.version.lower())
        newness = int(release[1]) + int(release[2]) / 100 if release else 0.0
        return (4, -newness, info.index)
    return (5, 0, info.index)


def _is_pocl(info: DeviceInfo) -> bool:
    return "portable computing language" in info.platform.lower()


def compiler_fault(info: DeviceInfo) -> str | None:
    """Why a device can compile nothing, not even an empty program; None if it can.

    Only PoCL's CPU devices are asked, the others are believed: a PoCL that is older than the CPU offers it all the same
    and then refuses every program. Being asked costs a few hundredths of a second, the first time.
    """
    return compiler.fault(info.handle) if info.kind == "cpu" and _is_pocl(info) else None


def _cpu_runtime_advice() -> str:
    """How to get a CPU runtime that works on this machine."""
    pocl = "a newer PoCL from your system's packages (Debian, Ubuntu: pocl-opencl-icd)"
    if sys.platform in ("linux", "win32") and machine().lower() in ("x86_64", "amd64"):
        return f"`pip install intel-opencl-rt intel-cmplr-lib-rt` (for AMD's CPUs too) or {pocl}"
    return pocl


def _compiles_nothing(infos: Sequence[DeviceInfo]) -> str:
    """One line that says so of these devices, and how to mend it."""
    names = ", ".join(map(str, infos))
    return (
        f"device {names} cannot compile even an empty program ({compiler_fault(infos[0])}): mend it by "
        f"{_cpu_runtime_advice()}"
    )


_passed_over: set[DeviceInfo] = set()


def choose_device(spec: str | None = None) -> DeviceInfo:
    """The best of the devices that ``spec`` fits and that can compile (see :func:`compiler_fault`).

    Better ones that cannot are passed over with a warning, one a process.

    Args:
        spec: as for :func:`fitting_devices`.

    Raises:
        DeviceError: there is no device, none that ``spec`` fits, or none of those can compile.
    """
    unable: list[DeviceInfo] = []
    for info in fitting_devices(spec):
        if compiler_fault(info) is None:
            if not _passed_over.issuperset(unable):
                _passed_over.update(unable)
                logger.warning("%s; going on with %s", _compiles_nothing(unable), info)
            return info
        unable.append(info)
    raise DeviceError(_compiles_nothing(unable))


def fitting_devices(spec: str | None = None) -> list[DeviceInfo]:
    """The devices that ``spec`` fits, best first: discrete GPUs, integrated ones, then CPU runtimes by speed.

    Args:
        spec: an index of :func:`list_devices`, "cpu", "gpu", or part of a device's or platform's name in any case;
            None takes the environment variable ``POTR_CL_DEVICE``; without that every device fits.

    Raises:
        DeviceError: there is no device, or none that ``spec`` fits.
    """
    devices = sorted(list_devices(), key=_preference)
    if not devices:
        raise DeviceError(
            f"no OpenCL device found: install your GPU's OpenCL driver, or a CPU runtime by {_cpu_runtime_advice()}"
        )
    spec = spec or os.environ.get(DEVICE_VARIABLE)
    if not spec:
        return devices
    wanted = spec.strip().lower()
    if wanted.isdigit():
        matches = [d for d in devices if d.index == int(wanted)]
    elif wanted in ("cpu", "gpu"):
        matches = [d for d in devices if d.kind == wanted]
    else:
        matches = [d for d in devices if wanted in d.name.lower() or wanted in d.platform.lower()]
    if not matches:
        listed = ", ".join(f"{d.index}: {d.name}" for d in sorted(devices, key=lambda d: d.index))
        raise DeviceError(f"no OpenCL device fits '{spec}'; there are {listed}")
    return matches


def kernel_source(name: str, variants: Mapping[str, Path] | None = None) -> str:
    """Text of ``cl/<name>`` with its ``#include "…"`` lines replaced by the headers, each once.

    Args:
        name: of the kernel file, as in ``prune/removal_cpu.cl``.
        variants: files to read in place of those of these names, or under names that ``cl/`` does not have.
    """
    variants = variants or {}
    folder = files("potr_cl") / "cl"
    seen: set[str] = set()

    def expand(file: str) -> str:
        def include(match: re.Match[str]) -> str:
            if match[1] in seen:
                return ""
            seen.add(match[1])
            return expand(match[1])

        return re.sub(
            r'^#include "([\w./]+)"$', include, variants.get(file, folder / file).read_text("utf-8"), flags=re.MULTILINE
        )

    return expand(name)


class Device:
    """A context, a queue, the programs built for them and the memory taken on one device.

    Args:
        info: the device, or what :func:`choose_device` understands.
        profiling: record a pair of device timestamps for every launch, see :attr:`timings`.
        family: run the kernels of this family instead of the device's own (for tests and benchmarks).
        build_options: compiler flags for every program; the kernels' accuracy is known without any.
        variants: kernel files and headers to read in place of those of these names in ``cl/``, or under names that it
            does not have (for experiments); what they include is looked up in the same way.
        macros: values that the kernels' macros have in every program, whatever the package asks for (for experiments).

    Attributes:
        info, context, queue.
        family: "cpu" or "gpu".
        vector_width: floats a vector of the CPU kernels has; asked of the device and proved by a build.
        allocated: bytes taken with :meth:`allocate` and not freed.
        timings: (kernel name, event) of the launches since the list was last cleared; empty without profiling.

    Raises:
        DeviceError: the device cannot be opened or lacks what the kernels need.
    """

    def __init__(
        self,
        info: DeviceInfo | str | None = None,
        *,
        profiling: bool = False,
        family: Family | None = None,
        build_options: Sequence[str] = (),
        variants: Mapping[str, Path] | None = None,
        macros: Mapping[str, str | int | float] | None = None,
    ) -> None:
        self.info = info if isinstance(info, DeviceInfo) else choose_device(info)
        if compiler_fault(self.info) is not None:
            raise DeviceError(_compiles_nothing([self.info]))
        self.family: Family = family or self.info.family
        self.allocated = 0
        self.timings: list[tuple[str, cl.Event]] = []
        self._unfinished: list[list[cl.Buffer]] = []
        self._profiling = profiling
        self._build_options = tuple(build_options)
        self._variants = dict(variants or {})
        self._macros = dict(macros or {})
        self._programs: dict[tuple[str, tuple[tuple[str, str], ...]], cl.Program] = {}
        self._kernels: dict[tuple[Any, ...], cl.Kernel] = {}
        with self.errors("cannot be opened"):
            self.context = _new_context(self.info.handle)
            flags = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
            self.queue = cl.CommandQueue(self.context, self.info.handle, properties=flags)
        if self.info.max_work_group < 256 and self.family == "gpu":
            raise DeviceError(
                f"device {self.info} runs at most {self.info.max_work_group} work-items a work-group, 256 are needed: "
                "choose another with --device"
            )
        self.vector_width = self._proven_vector_width()
        self.native_exp2 = self.family == "gpu" and self._native_exp2_is_exact()

    @property
    def several_queues(self) -> bool:
        """Whether what one queue has finished is there for others. With Mesa's rusticl (22.3) it is not, silently."""
        return "rusticl" not in self.info.platform.lower()

    @contextmanager
    def errors(self, what: str) -> Iterator[None]:
        """Turn pyopencl's errors into a DeviceError that says ``what`` about this device, or a DeviceMemoryError."""
        try:
            yield
        except cl.MemoryError as error:
            raise DeviceMemoryError(
                f"device {self.info} ran out of memory ({error}): {self._memory_advice()}"
            ) from None
        except cl.Error as error:
            said = compiler.complaint(error)
            raise DeviceError(f"device {self.info} {what} ({said}): choose another with --device") from None

    def _memory_advice(self) -> str:
        return "render fewer pixels or splats at a time, or choose a device with more memory with --device"

    def program(self, source: str, **defines: str | int | float) -> cl.Program:
        """The program of ``cl/<source>`` with these macros, built on first use.

        Raises:
            DeviceError: the device's compiler refused it.
        """
        macros = tuple(sorted((name, _literal(value)) for name, value in {**defines, **self._macros}.items()))
        key = (source, macros)
        if key not in self._programs:
            options = ["-cl-std=CL1.2", *self._build_options, *(f"-D{name}={value}" for name, value in macros)]
            with self.errors(f"failed to build {source}"), warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)  # some drivers chat without being asked
                self._programs[key] = cl.Program(self.context, kernel_source(source, self._variants)).build(options)
        return self._programs[key]

    def kernel(self, source: str, name: str, **defines: str | int | float) -> cl.Kernel:
        """A new kernel object of :meth:`program`; keep it, making one is slow."""
        with self.errors(f"failed to build {source}"):
            return cl.Kernel(self.program(source, **defines), name)

    def shared_kernel(self, source: str, name: str, types: Sequence[Any], **defines: str | int | float) -> cl.Kernel:
        """A kernel object that is made once: who takes it sets all its arguments before each launch.

        Args:
            source, defines: as :meth:`program` takes them.
            types: of the arguments: NumPy's of numbers and structs, None for buffers. Told them, pyopencl sets the
                arguments twenty times as fast.
        """
        key = (source, name, tuple(sorted(defines.items())))
        if key not in self._kernels:
            kernel = self.kernel(source, name, **defines)
            kernel.set_scalar_arg_dtypes(types)
            self._kernels[key] = kernel
        return self._kernels[key]

    def allocate(self, nbytes: int, what: str) -> cl.Buffer:
        """A read-write buffer.

        Args:
            nbytes: its size; at least one byte is taken.
            what: the buffer holds, for the error's sake.

        Raises:
            DeviceMemoryError: it would not fit one buffer or the device's memory.
        """
        nbytes = max(int(nbytes), 16)
        if nbytes > self.info.largest_buffer or self.allocated + nbytes > self.info.memory:
            raise DeviceMemoryError(
                f"device {self.info} cannot hold {what}: {nbytes / 1e6:.0f} MB beside {self.allocated / 1e6:.0f} MB "
                f"taken, of {self.info.memory / 1e6:.0f} MB in buffers of at most {self.info.largest_buffer / 1e6:.0f} "
                f"MB: {self._memory_advice()}"
            )
        with self.errors(f"cannot hold {what}"):
            buffer = cl.Buffer(self.context, cl.mem_flags.READ_WRITE, nbytes)
        self.allocated += nbytes
        if self._unfinished:
            self._unfinished[-1].append(buffer)
        return buffer

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Free what was allocated inside if an error leaves it: for objects that own several buffers."""
        self._unfinished.append([])
        try:
            yield
        except BaseException:
            for buffer in list(self._unfinished[-1]):
                self.free(buffer)
            raise
        finally:
            finished = self._unfinished.pop()
            if self._unfinished:
                self._unfinished[-1].extend(finished)

    def free(self, buffer: cl.Buffer) -> None:
        """Give back what :meth:`allocate` gave."""
        for buffers in self._unfinished:
            if buffer in buffers:
                buffers.remove(buffer)
        self.allocated -= buffer.size
        buffer.release()

    def upload(self, array: np.ndarray[Any, Any], what: str) -> cl.Buffer:
        """A buffer that holds a copy of ``array``, C order."""
        array = np.ascontiguousarray(array)
        buffer = self.allocate(array.nbytes, what)
        if array.nbytes:
            with self.errors(f"cannot hold {what}"):
                cl.enqueue_copy(self.queue, buffer, array, is_blocking=True)
        return buffer

    def download(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: Any) -> np.ndarray[Any, Any]:
        """A copy of a buffer's beginning, once everything before it in the queue is done."""
        array = np.empty(shape, dtype)
        if array.nbytes:
            with self.errors("failed while computing"):
                cl.enqueue_copy(self.queue, array, buffer, is_blocking=True)
        return array

    def launch(
        self,
        kernel: cl.Kernel,
        items: tuple[int, ...],
        group: tuple[int, ...] | None = None,
        queue: cl.CommandQueue | None = None,
    ) -> None:
        """Enqueue ``kernel`` with the arguments it has; in another queue than the device's own if one is given."""
        try:
            event = cl.enqueue_nd_range_kernel(queue or self.queue, kernel, items, group)
        except cl.Error:
            with self.errors(f"failed to run {kernel.function_name}"):
                raise
        if self._profiling:
            self.timings.append((kernel.function_name, event))

    def stage_times(self) -> dict[str, float]:
        """Seconds each kernel took on the device since :attr:`timings` was last cleared, summed by name.

        Clears :attr:`timings`. Empty without profiling.
        """
        self.queue.finish()
        sums: dict[str, float] = {}
        for name, event in self.timings:
            sums[name] = sums.get(name, 0.0) + (event.profile.end - event.profile.start) * 1e-9
        self.timings.clear()
        return sums

    def _proven_vector_width(self) -> int:
        """The widest vector, up to the native one, whose test kernel builds and computes right."""
        width = self.info.vector_width
        if _aborts_on_wide_vectors(self.info):
            width = min(width, 8)
        values = np.linspace(-8, 0, 64, dtype=np.float32)
        while width > 1:
            try:
                if np.abs(self._probe("probe_rows", values, LANES=width) - np.exp2(values)).max() < 1e-6:
                    return width
            except DeviceError as error:
                logger.debug("vectors of %d floats: %s", width, error)
            width = {16: 8, 8: 4, 4: 1}[width]
        return 1

    def _native_exp2_is_exact(self) -> bool:
        """Whether ``native_exp2`` is good to a few units in the last place where alpha needs it."""
        values = np.linspace(-8, 0, 4096, dtype=np.float32)
        exact = np.exp2(values.astype(np.float64))
        return bool(np.abs(self._probe("probe_native_exp2", values, LANES=1) / exact - 1).max() < 5e-7)

    def _probe(self, name: str, values: np.ndarray[Any, Any], **defines: int) -> np.ndarray[Any, Any]:
        kernel = self.kernel("opencl/probe.cl", name, **defines)
        source = self.upload(values, "a probe")
        result = self.allocate(values.nbytes, "a probe")
        kernel.set_args(source, result)
        self.launch(kernel, (len(values) // defines["LANES"],))
        out = self.download(result, values.shape, values.dtype)
        self.free(source)
        self.free(result)
        return out

    def self_check(self) -> None:
        """Prove in about two seconds that the device does what the kernels rely on.

        Integer atomics, local memory with barriers, 64-bit integers, vectors, and a buffer of a tenth of its memory
        written and read back at both ends.

        Raises:
            DeviceError: one of them fails; the message says which.
        """
        n = 1 << 16
        counter = self.upload(np.zeros(2, np.uint32), "a probe")
        keys = self.allocate(n * 8, "a probe")
        kernel = self.kernel("opencl/probe.cl", "probe_integers", LANES=1)
        kernel.set_args(counter, keys)
        self.launch(kernel, (n,), (64,))
        if self.download(counter, (2,), np.uint32).tolist() != [n, (n - 1) % 64 * (n // 64)]:
            raise DeviceError(f"device {self.info} fails the self-check: atomics or local memory give wrong sums")
        expected = (np.arange(n, dtype=np.uint64) << np.uint64(32)) | np.uint64(7)
        if not np.array_equal(self.download(keys, (n,), np.uint64), expected):
            raise DeviceError(f"device {self.info} fails the self-check: 64-bit integers are wrong")
        self.free(counter)
        self.free(keys)
        if self.family == "cpu" and self.vector_width == 1 and self.info.vector_width > 1:
            raise DeviceError(f"device {self.info} fails the self-check: no vector width computes right")
        size = min(self.info.memory // 10, self.info.largest_buffer, 1 << 28)
        big = self.allocate(size, "the self-check's buffer")
        mark = np.array([0x5EED, 0xBEEF], np.uint32)
        with self.errors("fails the self-check: a large buffer cannot be used"):
            for offset in (0, size // 16 * 16 - 16):
                cl.enqueue_copy(self.queue, big, mark, dst_offset=offset, is_blocking=True)
                back = np.empty_like(mark)
                cl.enqueue_copy(self.queue, back, big, src_offset=offset, is_blocking=True)
                if not np.array_equal(mark, back):
                    raise DeviceError(f"device {self.info} fails the self-check: a large buffer loses its content")
        self.free(big)


class Scratch:
    """A buffer that grows when asked to, and loses its content then.

    Attributes:
        buffer: the memory. nbytes: its size; 0 before the first :meth:`reserve` and after one that failed.
    """

    def __init__(self, device: Device, what: str) -> None:
        self._device = device
        self._what = what
        self.buffer: cl.Buffer = None
        self.nbytes = 0

    def reserve(self, nbytes: int) -> bool:
        """Have at least ``nbytes``; whether the memory is new.

        Raises:
            DeviceError: the device has no room.
        """
        if self.buffer is not None and self.nbytes >= nbytes:
            return False
        self.free()
        self.buffer = self._device.allocate(nbytes, self._what)
        self.nbytes = nbytes
        return True

    def free(self) -> None:
        """Give the memory back."""
        if self.buffer is not None:
            self._device.free(self.buffer)
            self.buffer = None
        self.nbytes = 0


def _aborts_on_wide_vectors(info: DeviceInfo) -> bool:
    """Whether vectors of 16 floats may end the whole process inside the compiler, where no trial can catch it.

    PoCL on LLVM before 15 ("Do not know how to scalarize this operator's operand"), seen with PoCL 3.0 on a CPU with
    AVX-512.
    """
    llvm = re.search(r"llvm (\d+)", info.version.lower())
    return llvm is not None and int(llvm[1]) < 15


def _literal(value: str | int | float) -> str:
    """A macro's value: floats with enough digits and the suffix that keeps OpenCL C from using doubles."""
    return f"{value:.9e}f" if isinstance(value, float) else str(value)
