"""One OpenCL device, opened: its context, its queue, the kernels built for it and the memory taken on it."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.host.libraries import whatever_warns
from potr_cl.host.threads import in_background, thread_pool
from potr_cl.opencl import compiler, program_cache, quirks
from potr_cl.opencl.ahead import context_of, leave
from potr_cl.opencl.discovery import DeviceInfo, Family, choose_device, compiler_fault, not_to_be_taken
from potr_cl.opencl.kernel import Kernel, declared_parameters
from potr_cl.opencl.pieces import Pieces
from potr_cl.opencl.program_cache import Foresight, Wanted, building
from potr_cl.opencl.source import kernel_source

logger = logging.getLogger("potr_cl")

#: Threads that load programs at a time; drivers build one after another, whatever the threads.
_BUILDERS = 2

#: Work-items of sub-groups, the narrowest first. pyopencl cannot ask which ones a device has.
_SUB_GROUPS = (8, 16)

#: Bytes that the driver fills; more are filled by a kernel, with work-groups of so many work-items.
_FILLED, _FILLING = 1 << 30, 256

#: How drivers say that there is not enough memory, besides what pyopencl makes a MemoryError of.
_NO_MEMORY = (
    "OUT_OF_HOST_MEMORY",
    "OUT_OF_RESOURCES",
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "INVALID_BUFFER_SIZE",
    "std::bad_alloc",
)


class Device:
    """A context, a queue, the programs built for them and the memory taken on one device.

    Several threads may use one at a time, each with objects (a rasterizer, an encode) that it has made itself.

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
        sub_group: work-items of the narrowest sub-group, of GPUs whose kernels can choose one; None elsewhere.
        allocated: bytes taken with :meth:`allocate` and not freed.
        pieces: cuts launches that would take too long; None where they may take as long as they like.
        timings: (kernel name, event) of the launches since the list was last cleared; empty without profiling.

    Raises:
        DeviceError: the device cannot be opened or lacks what the kernels need.
        FileNotFoundError: a variant is not there.
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
        if (fault := compiler_fault(self.info)) is not None:
            raise DeviceError(not_to_be_taken([self.info], f"cannot compile even an empty program ({fault})"))
        self.family: Family = family or self.info.family
        self.timings: list[tuple[str, cl.Event]] = []
        self._lock = threading.RLock()  # of the two that follow
        self.allocated = 0
        self._unfinished: dict[int, list[list[cl.Buffer]]] = {}  # by thread
        self.profiling = profiling
        longest = self.info.longest_kernel
        self.pieces = None if longest is None else Pieces(longest, self.info.compute_units)
        self._build_options = tuple(build_options)
        self._variants = dict(variants or {})
        for path in self._variants.values():
            if not path.is_file():
                raise FileNotFoundError(f"there is no file '{path}' to read a kernel from")
        self._macros = dict(macros or {})
        self._programs: dict[Wanted, cl.Program] = {}
        self._frees_wait = quirks.WAITING_FREES.concerns(self.info.platform, self.info.version)
        self._foresight: Foresight | None = None
        self._of_this_thread = threading.local()
        self._leaving: weakref.finalize[..., Device] | None = None
        with self.errors("cannot be opened"):
            self.context, self._built_before = context_of(self.info)
            self._leaving = weakref.finalize(self, leave, self.info.handle, self.context, self._built_before)
            self._leaving.atexit = False
            if profiling and not self.info.profiling:
                raise DeviceError(f"device {self.info} measures no times: open it without profiling")
            flags = cl.command_queue_properties.PROFILING_ENABLE if profiling else 0
            self.queue = cl.CommandQueue(self.context, self.info.handle, properties=flags)
        if self.info.max_work_group < 256 and self.family == "gpu":
            raise DeviceError(
                f"device {self.info} supports work-groups of only {self.info.max_work_group} work-items; 256 are "
                "required: choose another with --device"
            )
        self.sub_group: int | None = None
        self.sub_group = self._narrowest_sub_group()
        self.vector_width = self._proven_vector_width()
        self.native_exp2 = self.family == "gpu" and self._native_exp2_is_exact()

    @property
    def _of_device(self) -> list[str]:
        """Macros that every program gets for what the device is like."""
        pieces = [] if self.pieces is None else ["-DIN_PIECES=1"]
        return pieces if self.sub_group is None else [*pieces, f"-DSUB_GROUP={self.sub_group}"]

    @property
    def several_queues(self) -> bool:
        """Whether what one queue has finished is there for others."""
        return not quirks.ONE_QUEUE.concerns(self.info.platform, self.info.version)

    @contextmanager
    def errors(self, what: str) -> Iterator[None]:
        """Turn pyopencl's errors into a DeviceError that says ``what`` about this device, or a DeviceMemoryError."""
        try:
            yield
        except (cl.Error, MemoryError) as error:
            if self._leaving is not None:
                self._leaving.detach()  # it may work no more: some drivers tell a crash as a lack of resources
            said = compiler.complaint(error)
            if isinstance(error, (cl.MemoryError, MemoryError)) or any(
                code in str(error).partition("\n")[0] for code in _NO_MEMORY
            ):
                raise DeviceMemoryError(
                    f"device {self.info} ran out of memory ({said}): {self._memory_advice()}"
                ) from None
            raise DeviceError(f"device {self.info} {what} ({said}): choose another with --device") from None

    def _memory_advice(self) -> str:
        return "render fewer pixels or splats at a time, or choose a device with more memory with --device"

    def program(self, source: str, **defines: str | int | float) -> cl.Program:
        """The program of ``cl/<source>`` with these macros, built on first use.

        Raises:
            DeviceError: the device's compiler refused it.
        """
        macros = tuple(sorted((name, _literal(value)) for name, value in {**defines, **self._macros}.items()))
        built = self._built((source, macros))
        if self._foresight is not None:
            self._foresight.note((source, macros))
        return built

    def prepare_for(self, purpose: str) -> Future[None]:
        """Load in another thread the programs that were needed for a purpose before, and note those that are now.

        Args:
            purpose: any text: what was done the last time under the same one is about to be done again.

        Returns:
            Done when all are loaded. Nobody need wait for it, and it raises nothing.
        """
        folder = program_cache.folder()
        if folder is None or self._variants or self._macros or self._build_options:
            return in_background(lambda: None)
        about = (purpose, self.info.name, self.info.platform, self.info.version, self.family)
        self._foresight = Foresight(folder, repr(about))

        def load(program: Wanted) -> None:
            with suppress(DeviceError, OSError, Warning):
                self._built(program)

        def load_all(wanted: Sequence[Wanted]) -> None:
            with thread_pool(1 if self.info.kind == "cpu" else min(os.cpu_count() or 1, _BUILDERS)) as threads:
                list(threads.map(load, wanted))

        return in_background(load_all, list(self._foresight.programs))

    def _built(self, wanted: Wanted) -> cl.Program:
        source, macros = wanted
        if wanted not in self._programs:
            with building(wanted, alone=self.info.kind == "cpu"):
                if wanted not in self._programs:
                    options = [
                        "-cl-std=CL1.2",
                        *self._build_options,
                        *self._of_device,
                        *(f"-D{name}={value}" for name, value in macros),
                    ]
                    text = kernel_source(source, self._variants)
                    program = self._built_before.get((text, tuple(options)))
                    if program is None:
                        with self.errors(f"failed to build {source}"):
                            program = whatever_warns(lambda: program_cache.built(self.context, text, options))
                        self._built_before[text, tuple(options)] = program
                    self._programs[wanted] = program
        return self._programs[wanted]

    def compiler_log(self) -> list[str]:
        """What the compiler has warned of in the programs built so far, each line once."""
        log = cl.program_build_info.LOG
        said = [self._programs[each].get_build_info(self.info.handle, log) for each in sorted(self._programs)]
        lines = (line.strip() for text in said for line in text.splitlines())
        return list(dict.fromkeys(line for line in lines if re.search(r"\b(?:warning|error)\b", line, re.IGNORECASE)))

    def kernel(self, source: str, name: str, **defines: str | int | float) -> Kernel:
        """A new kernel object of :meth:`program`; keep it, making one is slow.

        Raises:
            TypeError: the file declares no such kernel, or one with an argument of an unknown kind.
            DeviceError: the device's compiler refused it.
        """
        declared_parameters(source, name, self._variants)  # before a compiler is asked: its message would mislead
        with self.errors(f"failed to build {source}"):
            handle = cl.Kernel(self.program(source, **defines), name)
        return Kernel(self, handle, source, self._variants)

    def shared_kernel(self, source: str, name: str, **defines: str | int | float) -> Kernel:
        """A kernel object that is made once a device and thread.

        Who takes it binds all its arguments before each launch; another thread has another, for its own arguments.

        Args:
            source, defines: as :meth:`program` takes them.
        """
        kernels: dict[tuple[Any, ...], Kernel] = self._of_this_thread.__dict__.setdefault("kernels", {})
        key = (source, name, tuple(sorted(defines.items())))
        if key not in kernels:
            kernels[key] = self.kernel(source, name, **defines)
        return kernels[key]

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
        with self._lock:
            self.allocated += nbytes
            if scopes := self._unfinished.get(threading.get_ident()):
                scopes[-1].append(buffer)
        return buffer

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Free what this thread allocated inside if an error leaves it: for objects that own several buffers."""
        thread = threading.get_ident()
        with self._lock:
            scopes = self._unfinished.setdefault(thread, [])
            scopes.append([])
        try:
            yield
        except BaseException:
            for buffer in list(scopes[-1]):
                self.free(buffer)
            raise
        finally:
            with self._lock:
                finished = scopes.pop()
                if scopes:
                    scopes[-1].extend(finished)
                else:
                    del self._unfinished[thread]

    def free(self, buffer: cl.Buffer) -> None:
        """Give back what :meth:`allocate` gave."""
        with self._lock:
            # Another thread than the one that allocated it may free it.
            for buffers in (scope for scopes in self._unfinished.values() for scope in scopes):
                if buffer in buffers:
                    buffers.remove(buffer)
            self.allocated -= buffer.size
        if self._frees_wait:
            with suppress(cl.Error):  # a queue that has failed: whoever looks at its results is told
                self.queue.finish()
        buffer.release()

    def upload(self, array: np.ndarray[Any, Any], what: str, pending: list[cl.Event] | None = None) -> cl.Buffer:
        """A buffer that holds a copy of ``array``, C order.

        Args:
            array: to be copied.
            what: it is, for the error's sake.
            pending: takes the copy as an event, which is only enqueued then: the array must not change before it is
                done, nor the event be given up. None: it is done when the method returns.
        """
        array = np.ascontiguousarray(array)
        buffer = self.allocate(array.nbytes, what)
        if array.nbytes:
            with self.errors(f"cannot hold {what}"):
                event = cl.enqueue_copy(self.queue, buffer, array, is_blocking=pending is None)
            if pending is not None:
                pending.append(event)
        return buffer

    def fill(self, buffer: cl.Buffer, value: np.generic, nbytes: int | None = None) -> None:
        """Enqueue that a buffer holds one value again and again.

        Args:
            buffer: of any size.
            value: of 1 to 8 bytes.
            nbytes: how many of the buffer's bytes, from its beginning on; None: all whole values that it has room for.
        """
        nbytes = buffer.size // value.nbytes * value.nbytes if nbytes is None else nbytes
        with self.errors("failed to fill a buffer"):
            if nbytes <= _FILLED:
                cl.enqueue_fill_buffer(self.queue, buffer, value, 0, nbytes)
                return
        # NVIDIA's driver (quirks.SHORT_FILLS) writes elsewhere where a buffer is large.
        words = np.frombuffer(value.tobytes() * (8 // value.nbytes), np.uint32)
        kernel = self.shared_kernel("opencl/fill.cl", "fill")
        kernel.bind(words=buffer, count=nbytes // 4, first=int(words[0]), second=int(words[1]))
        kernel.launch((-(-nbytes // (4 * _FILLING)) * _FILLING,), (_FILLING,))
        if nbytes % 4:
            rest = np.frombuffer(value.tobytes() * (nbytes % 4 // value.nbytes), np.uint8)
            with self.errors("failed to fill a buffer"):
                cl.enqueue_copy(self.queue, buffer, rest, dst_offset=nbytes - nbytes % 4, is_blocking=True)

    def download(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: Any, start: int = 0) -> np.ndarray[Any, Any]:
        """A copy of a part of a buffer, from the byte ``start`` on, once everything before it in the queue is done."""
        array = np.empty(shape, dtype)
        if array.nbytes:
            with self.errors("failed while computing"):
                cl.enqueue_copy(self.queue, array, buffer, src_offset=start, is_blocking=True)
        return array

    def copy(self, target: Any, source: Any, nbytes: int | None = None, to: int = 0, of: int = 0) -> None:
        """Enqueue a copy from one buffer to another; from or to an array on the host, and wait for it.

        Args:
            target, source: buffers of this device, or one of them an array.
            nbytes: how many; None: as many as there are. to, of: where they begin, in buffers.

        Raises:
            DeviceError: the device failed.
        """
        with self.errors("failed while computing"):
            if isinstance(source, np.ndarray):
                cl.enqueue_copy(self.queue, target, source, dst_offset=to, is_blocking=True)
            elif isinstance(target, np.ndarray):
                cl.enqueue_copy(self.queue, target, source, src_offset=of, is_blocking=True)
            else:
                nbytes = min(target.size - to, source.size - of) if nbytes is None else nbytes
                cl.enqueue_copy(self.queue, target, source, byte_count=nbytes, dst_offset=to, src_offset=of)

    def finish(self) -> None:
        """Return once all is done that was enqueued.

        Raises:
            DeviceError: the device failed.
        """
        with self.errors("failed while computing"):
            self.queue.finish()

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
        if quirks.NO_WIDE_VECTORS.concerns(self.info.platform, self.info.version):
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

    def _narrowest_sub_group(self) -> int | None:
        """The least of Intel's sizes that builds: work-items have most registers then (cl/include/registers.clh)."""
        on_gpu = self.family == self.info.kind == "gpu"
        if not on_gpu or "cl_intel_required_subgroup_size" not in self.info.handle.extensions:
            return None
        for self.sub_group in _SUB_GROUPS:
            try:
                self._native_exp2_is_exact()
            except DeviceError as error:
                logger.debug("sub-groups of %d work-items: %s", self.sub_group, error)
            else:
                return self.sub_group
        return None

    def _native_exp2_is_exact(self) -> bool:
        """Whether ``native_exp2`` is good to a few units in the last place where alpha needs it."""
        values = np.linspace(-8, 0, 4096, dtype=np.float32)
        exact = np.exp2(values.astype(np.float64))
        return bool(np.abs(self._probe("probe_native_exp2", values, LANES=1) / exact - 1).max() < 5e-7)

    def digits(self) -> str:
        """What tells this device from one that rounds differently: a hash of what some of the kernels' maths gives.

        Devices of the same name can be of hosts whose processors have other instructions.
        """
        values = np.linspace(-7.9, -0.1, 1600, dtype=np.float32)
        macros = {"LANES": self.vector_width, **({"NATIVE_EXP2": 1} if self.native_exp2 else {})}
        found = self._probe("probe_digits", values, **macros).tobytes()
        return hashlib.sha256(repr((self.family, self.vector_width)).encode() + found).hexdigest()[:16]

    def _probe(self, name: str, values: np.ndarray[Any, Any], **defines: int) -> np.ndarray[Any, Any]:
        kernel = self.kernel("opencl/probe.cl", name, **defines)
        source = self.upload(values, "a probe")
        result = self.allocate(values.nbytes, "a probe")
        kernel.bind(values=source, result=result).launch((len(values) // defines["LANES"],))
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
        kernel.bind(counters=counter, keys=keys).launch((n,), (64,))
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


def _literal(value: str | int | float) -> str:
    """A macro's value: floats with enough digits and the suffix that keeps OpenCL C from using doubles."""
    return f"{value:.9e}f" if isinstance(value, float) else str(value)
