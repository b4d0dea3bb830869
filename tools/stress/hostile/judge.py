"""Judge what reads a file by what it does: :class:`Judge`. In a process of its own, which a bad file may end.

Linux only: memory is what /proc says.
"""

from __future__ import annotations

import ctypes
import dataclasses
import logging
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from potr_cl.errors import PotrError
from tools.stress.hostile.changes import Files
from tools.stress.hostile.formats import Format, WrongResult, parts_of

#: A file that takes longer hangs: seconds of processor time, and, should it wait for something, how many times as many
#: of the clock, for other processes may keep the processor busy.
LONGEST, _WAITING = 5.0, 12
#: Bytes from which on memory that was freed is given back to the system before the next file.
_MUCH = 1 << 19
#: Room that the process may take beyond what it has when it begins and what a file may cost. What is reserved and never
#: touched counts too: stacks of threads, arenas of their allocators.
_ROOM = 1 << 29
#: More is not tried, for the sake of the machine.
_MOST = 1 << 30
#: A message for people: one line, of so many characters at most.
_LONGEST_MESSAGE = 1000
#: Numbers of glibc's mallopt, and two bytes to fill memory with that is handed out or given back.
_M_PERTURB, _FILLINGS = -6, (0x55, 0xAA)
_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".exr", ".heic")
_STARTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "pty.spawn")


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What came of one file.

    Attributes:
        kind: "read", "refused", or what is wrong: "exception", "memory", "message", "result", "warning", "terminal",
            "garbage", "program", "name", "leftover". A process that ends instead is a "crash", or a "hang" where its
            alarm rang.
        text: of the message, or of what is wrong.
        seconds: of processor time that it took.
        memory: bytes at most beyond what the process held before.
    """

    kind: str
    text: str
    seconds: float
    memory: int

    @property
    def fine(self) -> bool:
        return self.kind in ("read", "refused")


class Judge:
    """Reads files of one format in a folder.

    Args:
        form: the format.
        folder: to put the files into; with the folders ``tmp`` and ``cwd`` beside ``input``, which must stay empty.
        longest: seconds of processor time that a file may take, after which an alarm ends the process; 0: for ever.
    """

    def __init__(self, form: Format, folder: Path, longest: float = LONGEST) -> None:
        self._form, self._folder, self._longest = form, folder, longest
        self._input = folder / "input"
        self._there: set[str] = set()
        self._said: list[str] = []
        self._watched = _Watched(self._input)
        self._memory = _Memory()
        self._errors = os.open(folder / "stderr", os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(self._errors, 2)
        system = ctypes.CDLL(None)
        self._perturb: Callable[[int, int], int] | None = getattr(system, "mallopt", None)
        self._trim: Callable[[int], int] | None = getattr(system, "malloc_trim", None)
        self._freed = _MUCH
        self._cases = 0
        logging.getLogger("potr_cl").addHandler(_Kept(self._said))
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, category, *_, **__: self._said.append(f"{category.__name__}: {message}")

    def put(self, files: Files) -> Path:
        """Put files where they are read; those of the case before go."""
        for name in self._there - set(files):
            self._place(name).unlink(missing_ok=True)
        for name, content in files.items():
            place = self._place(name)
            if os.sep in name:
                place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        self._there = set(files)
        return self._place(next(iter(files)))

    def judge(self, path: Path, size: int) -> Verdict:
        """Read a file.

        Args:
            size: bytes of it and of those that belong to it.
        """
        self._cases += 1
        allowance = self._form.allowance(path, size)
        self._limit(allowance)
        self._said.clear()
        self._watched.found.clear()
        if self._freed >= _MUCH and self._trim is not None:
            self._trim(0)  # what a file before has freed would hide what this one takes
        self._memory.reset()
        began = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, self._longest)
        signal.setitimer(signal.ITIMER_REAL, self._longest * _WAITING)
        self._watched.on = True
        kind, text, result = self._read(path)
        self._watched.on = False
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        seconds = time.process_time() - began
        memory = self._freed = self._memory.grown()
        if kind in ("read", "refused"):
            kind, text = self._second_look(kind, text)
        if kind in ("read", "refused") and memory > allowance:
            kind, text = "memory", f"{memory} bytes for a file of {size}, which may take {allowance}"
        if kind == "memory" and memory <= allowance > _MOST:  # more than is tried here, but no more than is promised
            kind = "refused"
        if kind == "read" and self._form.twice and self._cases % 4 == 0:
            kind, text = self._twice(path, result)
        return Verdict(kind, text, seconds, memory)

    def _limit(self, allowance: int) -> None:
        """Have what takes much more than it may run into an error."""
        most = self._memory.virtual() + min(allowance, _MOST) + _ROOM
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))

    def _read(self, path: Path) -> tuple[str, str, Any]:
        try:
            return "read", "", self._form.read(path)
        except PotrError as error:
            if _from_memory(error):
                return "memory", f"the process ran into its limit: {error}", None
            return "refused", str(error), None
        except MemoryError:
            return "memory", "the process ran into its limit\n" + traceback.format_exc(), None
        except WrongResult as error:
            return "result", str(error), None
        except BaseException:
            return "exception", traceback.format_exc(), None

    def _second_look(self, kind: str, text: str) -> tuple[str, str]:
        """What was read or refused may still have done what it should not."""
        if self._watched.found:
            return self._watched.found[0]
        for message in [text, *self._said]:
            if len(message) > _LONGEST_MESSAGE or not message.isprintable():
                return "message", repr(message[:2000])
        for message in self._said:
            if "Warning: " in message[:40]:
                return "warning", message
        printed = os.fstat(self._errors).st_size
        if printed:
            shown = os.pread(self._errors, min(printed, 1 << 16), 0).decode("utf-8", "replace")
            os.ftruncate(self._errors, 0)
            os.lseek(self._errors, 0, os.SEEK_SET)
            if not all(each.isprintable() or each in "\n\t" for each in shown):
                return "terminal", repr(shown[:2000])
        for place in ("tmp", "cwd"):
            left = os.listdir(self._folder / place)
            if left:
                return "leftover", f"{place}: {left[:5]}"
        return kind, text

    def _twice(self, path: Path, result: Any) -> tuple[str, str]:
        if self._perturb is None:
            return "read", ""
        found = []
        for filling in _FILLINGS:
            self._perturb(_M_PERTURB, filling)
            found.append(parts_of(self._form.read(path)))
        self._perturb(_M_PERTURB, 0)
        if found[0] != found[1] or found[0] != parts_of(result):
            return "garbage", "two readings of one file differ: memory was read that nobody had written to"
        return "read", ""

    def _place(self, name: str) -> Path:
        return self._input / name


class _Memory:
    """The most that this process held in memory since a moment."""

    def __init__(self) -> None:
        self._clear = os.open("/proc/self/clear_refs", os.O_WRONLY)
        self._status = os.open("/proc/self/status", os.O_RDONLY)
        self._before = 0

    def reset(self) -> None:
        os.pwrite(self._clear, b"5", 0)
        self._before = self._kib(b"VmRSS:") * 1024

    def grown(self) -> int:
        return max(self._kib(b"VmHWM:") * 1024 - self._before, 0)

    def virtual(self) -> int:
        return self._kib(b"VmSize:") * 1024

    def _kib(self, name: bytes) -> int:
        text = os.pread(self._status, 4096, 0)
        start = text.index(name) + len(name)
        return int(text[start : text.index(b"kB", start)])


class _Watched:
    """Sees through Python's audit events whether a file's reader starts programs or obeys names."""

    def __init__(self, folder: Path) -> None:
        self.on = False
        self.found: list[tuple[str, str]] = []
        tmp = os.fspath(folder.parent / "tmp")
        system = "/proc/self/", "/usr/", "/sys/", "/etc/ld"
        self._allowed = (os.fspath(folder), tmp, sys.prefix, sys.base_prefix, *system)
        sys.addaudithook(self._see)

    def _see(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            self._see_open(*args)
        elif event in _STARTS or event.startswith("socket.connect"):
            self.found.append(("program", f"{event} {args!r:.300}"))

    def _see_open(self, path: Any, mode: Any, flags: Any) -> None:
        if not isinstance(path, (str, bytes, os.PathLike)):
            return  # a descriptor
        name = os.fsdecode(path)
        if name.startswith("<"):
            return
        real = os.path.normpath(os.path.join(os.getcwd(), name))
        writes = isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if real == os.devnull:
            return
        if real.startswith(self._allowed) and not (writes and real.startswith(self._allowed[0])):
            return
        if not writes and (real.lower().endswith(_IMAGES) or real.endswith((".py", ".pyc"))):
            return  # the pictures that cameras name may lie anywhere
        self.found.append(("name", f"opens {name!r:.300}{' to write' if writes else ''}"))


class _Kept(logging.Handler):
    """Keeps what is logged."""

    def __init__(self, said: list[str]) -> None:
        super().__init__()
        self._said = said

    def emit(self, record: logging.LogRecord) -> None:
        self._said.append(record.getMessage())


def _from_memory(error: BaseException | None) -> bool:
    """Whether an error stands for a lack of memory."""
    seen = 0
    while error is not None and seen < 20:
        if isinstance(error, MemoryError):
            return True
        error, seen = error.__cause__ or error.__context__, seen + 1
    return False
