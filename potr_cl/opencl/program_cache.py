"""Built programs that are kept on the disk: :func:`built`.

A cache is a help: what is damaged there is built again, and where nothing can be read or written programs are built
anew. pyopencl's own caches are left out, because they can stop a build: that of programs believes its bytes and has a
lock that a killed process leaves behind, that of the code that calls kernels is a database that can be locked or
damaged, and saves less than it costs to check.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import platform
import re
import threading
from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pyopencl as cl
from pyopencl.characterize import has_src_build_cache

from potr_cl.errors import PotrError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.libraries import without_warnings
from potr_cl.opencl.cache_folder import cache_folder

cl._PYOPENCL_NO_CACHE = True
# For each kernel object pyopencl generates the code that calls it, and never forgets the source: once is enough for a
# process, however many devices it opens.
from pyopencl import invoker  # noqa: E402 (it opens its database where it may have one)

invoker._generate_enqueue_and_set_args_module = functools.cache(invoker._generate_enqueue_and_set_args_module)

#: Variables by which users have drivers compile something else, for one as the instructions of another processor.
_OF_COMPILERS = ("CL_CONFIG_", "POCL_", "IGC_", "NEO", "AMD_", "GPU_", "LP_", "GALLIVM_", "RUSTICL_")
_DIGEST = hashlib.sha256().digest_size


def folder() -> Path | None:
    """Where programs are kept; None where they cannot be."""
    return cache_folder("programs")


def built(context: cl.Context, source: str, options: Sequence[str]) -> cl.Program:
    """A program, from the disk where it has been built before.

    Args:
        context: of one device.
        source: OpenCL C, without anything that it would include.
        options: the compiler's.

    Raises:
        pyopencl.Error: the compiler refuses it.
    """
    device = context.devices[0]
    place = None if has_src_build_cache(device) else folder()  # some drivers keep programs themselves
    if place is None:
        return cl.Program(context, source).build(list(options), cache_dir=False)
    path = place / _key(device, source, options)
    binary = _kept(path)
    if binary is not None:
        with suppress(cl.Error):  # the driver does not like it any more
            return cl.Program(context, [device], [binary]).build(list(options), cache_dir=False)
    program = cl.Program(context, source).build(list(options), cache_dir=False)
    with suppress(OSError, PotrError, cl.Error):
        binary = program.get_info(cl.program_info.BINARIES)[0]
        with replacing(path) as file:
            file.write(hashlib.sha256(binary).digest() + binary)
    return program


def _kept(path: Path) -> bytes | None:
    """What a file holds, if that is what was once written there."""
    with suppress(OSError):
        content = path.read_bytes()
        if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST]:
            return content[_DIGEST:]
    return None


def _key(device: cl.Device, source: str, options: Sequence[str]) -> str:
    """The name of a program's file. Machines that share a home may call different processors by the same name."""
    driver = device.platform
    about = (
        *(driver.vendor, driver.name, driver.version),
        *(device.vendor, device.name, device.version, device.driver_version),
        _processor() if device.type & cl.device_type.CPU else "",
        *sorted(each for each in os.environ.items() if each[0].startswith(_OF_COMPILERS)),
        *options,
        source,
    )
    return hashlib.sha256(repr(about).encode(errors="surrogateescape")).hexdigest()[:32]


@functools.cache
def _processor() -> str:
    """What tells processors apart that compute with other instructions."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        return next((line for line in file if line.startswith(("flags", "Features"))), "")
    return platform.processor()


_turns = threading.Lock()
#: Held by who builds or loads a program, by the program; of all programs of CPUs there is one.
_locks: defaultdict[Hashable, threading.Lock] = defaultdict(threading.Lock)
#: NVIDIA's compiler takes no longer for two programs at a time than for one after the other, but several times as long
#: for six.
_at_a_time = threading.BoundedSemaphore(2)


@contextmanager
def building(program: Hashable, alone: bool) -> Iterator[None]:
    """Build or load a program, while nobody else does the same one; another one is built at the same time.

    Of several devices of a kind the second one then finds what the first one has built. Warnings are not shown
    meanwhile: some drivers chat unasked, and a full disk stops no build.

    Args:
        program: what names it.
        alone: whether no other program may be built at a time: the compilers of CPUs have threads of their own, and
            not all of them may be called by several.
    """
    with _turns:
        lock = _locks[None if alone else program]
    with lock, _at_a_time, without_warnings():
        yield


#: A program: the file of its source, and its macros.
Wanted = tuple[str, tuple[tuple[str, str], ...]]

#: More are not noted: those of the latest encodes are among the first.
_MOST = 64


class Foresight:
    """The programs that were needed for a purpose.

    Args:
        folder: of the notes.
        purpose: what for, on which device and with which driver.

    Attributes:
        programs: in the order in which they were asked for.
    """

    def __init__(self, folder: Path, purpose: str) -> None:
        self._path = folder / f"needed-{hashlib.sha256(purpose.encode()).hexdigest()[:24]}.json"
        self.programs: list[Wanted] = []
        with suppress(OSError, ValueError, TypeError, KeyError):
            for source, macros in json.loads(self._path.read_text("utf-8"))[:_MOST]:
                if re.fullmatch(r"\w+/\w+\.cl", source):
                    self.programs.append((source, tuple((str(name), str(value)) for name, value in macros)))

    def note(self, program: Wanted) -> None:
        """Note that a program was needed."""
        if program in self.programs or len(self.programs) >= _MOST:
            return
        self.programs.append(program)
        with suppress(OSError, PotrError), replacing(self._path) as file:
            file.write(json.dumps(self.programs).encode())
