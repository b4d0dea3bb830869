"""Decoder: from the bytes of a .potr file back to a scene (:func:`decode`, :class:`PotrFile`).

Splats come in the order of the file. Nothing in a file is trusted. Header and table are read when a file is opened;
blocks are when they are asked for, and no others.
"""

from __future__ import annotations

import contextvars
import json
import math
import os
import stat
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container
from potr_cl.codec.body import Body
from potr_cl.codec.container import FIXED_BYTES, Block, FileHeader, header_bytes_of
from potr_cl.codec.sections import Property
from potr_cl.errors import DataError, UsageError
from potr_cl.host.inputs import State, refuse_changed, state_of, unchanged
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene, joined, most_coefficients

#: Whole numbers have at most this many bits beside their sign: what other languages read them into.
_BITS = 63


def parse(raw: bytes) -> dict[str, Any]:
    """The object of a metadata section.

    Strict, where Python's own reader is lenient: UTF-8 only, no NaN or Infinity, no number beyond float64 or 64 bits,
    no half of a surrogate pair. So what comes out can be written as JSON again.

    Raises:
        DataError: it is something else.
    """
    try:
        facts = json.loads(raw.decode("utf-8"), parse_constant=_refuse, parse_float=_real, parse_int=_whole)
        json.dumps(facts, ensure_ascii=False).encode("utf-8")  # fails on half a surrogate pair
    except (ValueError, RecursionError):
        facts = None
    if not isinstance(facts, dict):
        raise DataError("section 'metadata' is not a JSON object")
    return facts


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def _real(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError("beyond float64")
    return value


def _whole(digits: str) -> int:
    # Length first: to read thousands of digits takes long, and Python refuses it with an error of its own.
    value = int(digits) if len(digits) <= 20 else 1 << 64
    if abs(value) >> _BITS:
        raise ValueError("beyond 64 bits")
    return value


#: Blocks that are decoded side by side; each has threads of its own.
_SIDE_BY_SIDE = 4

T = TypeVar("T")
#: Gives so many bytes of a file from an offset on, or fewer where it ends.
Reading: TypeAlias = Callable[[int, int], "bytes | memoryview"]


@dataclass(frozen=True)
class PotrFile:
    """An opened .potr file. What is asked of its scene is of the finest level.

    Attributes:
        header: verified.
        metadata: what the encoder noted of itself; empty if it noted nothing.
        read: reads some of the file.
    """

    header: FileHeader
    metadata: dict[str, Any]
    read: Reading

    @property
    def blocks(self) -> tuple[Block, ...]:
        """What the table says of each."""
        return self.header.blocks

    def body(self, number: int, sh_degree: int | None = None) -> Body:
        """A block, read.

        Args:
            number: which.
            sh_degree: SH coefficients of higher degrees are not read; None: all are.

        Raises:
            UsageError: the file cannot be read any more.
        """
        block = self.blocks[number]
        return Body(block, self.read(block.offset, block.nbytes if sh_degree is None else block.bytes_to(sh_degree)))

    def part(self, number: int, threads: int = 1, sh_degree: int | None = None, box: Box | None = None) -> Scene | None:
        """The splats of a block, or those of them that lie in a box; None if there are none.

        Raises:
            As :meth:`body`.
            DataError: damaged.
        """
        return self.of(number, lambda body: _some_of(body, threads, sh_degree, box), sh_degree)

    def of(self, number: int, work: Callable[[Body], T], sh_degree: int | None = None) -> T:
        """What is made of a block; errors say which, if there are several."""
        try:
            return work(self.body(number, sh_degree))
        except DataError as error:
            if len(self.blocks) == 1:
                raise
            raise DataError(f"block {number}: {error}") from None

    def numbers(self, box: Box | None = None) -> list[int]:
        """The finest level's blocks that have splats in a box, or may have; all without one."""
        return [k for k in self.header.of_level() if box is None or box.meets(self.blocks[k].box)]

    def parts(
        self, threads: int = 0, sh_degree: int | None = None, box: Box | None = None, level: int = 0
    ) -> Iterator[Scene]:
        """Block by block in their order, with no more of them in memory than are decoded side by side.

        Args:
            threads: 0: one a processor.
            sh_degree: leave out SH coefficients of higher degrees; None: none.
            box: leave out splats whose centres lie outside, and do not read blocks that lie outside; None: none.
            level: of detail; 0 is the finest.

        Raises:
            UsageError: there is no such degree or level; or the file cannot be read any more.
            DataError: damaged.
        """
        most_coefficients(self.header.sh_degree, sh_degree)
        numbers = [k for k in self._level(level) if box is None or box.meets(self.blocks[k].box)]
        threads = threads or os.cpu_count() or 1
        at_once = max(min(_SIDE_BY_SIDE, threads, len(numbers)), 1)
        with ThreadPoolExecutor(at_once) as pool:

            def begun(number: int) -> Future[Scene | None]:
                # Memory that is bounded here is bounded in threads too.
                run = contextvars.copy_context().run
                return pool.submit(run, self.part, number, -(-threads // at_once), sh_degree, box)

            waiting = [begun(number) for number in numbers[:at_once]]
            left = numbers[at_once:]
            try:
                while waiting:
                    part = waiting.pop(0).result()
                    if left:
                        waiting.append(begun(left.pop(0)))
                    if part is not None:
                        yield part
            finally:
                for future in waiting:
                    future.cancel()

    def scene(self, threads: int = 0, sh_degree: int | None = None, box: Box | None = None, level: int = 0) -> Scene:
        """Decode everything, or a part; arguments as of :meth:`parts`.

        Raises:
            As :meth:`parts`.
            UsageError: no splat lies in the box.
        """
        count, own = most_coefficients(self.header.sh_degree, sh_degree), [self.blocks[k] for k in self._level(level)]
        splats = sum(block.splats for block in own)
        try:
            if box is not None:
                parts = list(self.parts(threads, sh_degree, box, level))
                if not parts:
                    raise UsageError(f"no splat lies in the box {box}: the scene lies in {self.bounds}")
                return joined(parts)
            if len(own) == 1:
                return self.of(self._level(level)[0], lambda body: body.scene(threads, sh_degree), sh_degree)
            whole, first = None, 0
            for part in self.parts(threads, sh_degree, None, level):
                whole = whole or Scene.blank(splats, count, part)
                whole.put(first, part)
                first += len(part)
        except MemoryError:
            needed = splats * (11 + 3 * count) * 4
            raise DataError(f"the scene needs {needed / 1e9:.1f} GB of memory, more than there is") from None
        assert whole is not None  # a level has a block
        return whole

    def _level(self, level: int) -> list[int]:
        if not 0 <= level <= self.blocks[0].level:
            raise UsageError(f"there is no level {level}: the file has levels 0 to {self.blocks[0].level}")
        return self.header.of_level(level)

    def means(self) -> NDArray[np.float32]:
        """(N, 3) float32 centres, world units; only their sections are read. Raises DataError if damaged."""
        return np.concatenate([self.of(k, lambda body: body.means(), -1) for k in self.numbers()])

    @property
    def bounds(self) -> Box:
        """Of all blocks together."""
        boxes = [block.box for block in self.blocks]
        low, high = np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0)
        return Box.of([*low, *high])


def _some_of(body: Body, threads: int, sh_degree: int | None, box: Box | None) -> Scene | None:
    """The splats of a block that lie in a box."""
    cut = box if box is not None and not box.covers(body.block.box) else None
    if cut is None:
        return body.scene(threads, sh_degree)
    inside = np.flatnonzero(cut.holds(body.means()))
    if not len(inside):
        return None
    some = body.scene(threads, sh_degree).subset(inside)
    # Each SH coefficient contiguous in memory, as a decoder leaves them.
    return replace(some, sh=np.ascontiguousarray(some.sh.transpose(1, 2, 0)).transpose(2, 0, 1))


def open_file(source: bytes | str | os.PathLike[str], trust: bool = False) -> PotrFile:
    """Open a .potr file, given as bytes or as a path, and verify header, table and metadata.

    Args:
        source: the file; a path may be that of a pipe that brings one.
        trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.

    Raises:
        UsageError: the path cannot be read.
        DataError: not a .potr file, or a damaged one, or too many splats for its size.
    """
    if isinstance(source, bytes):
        return _opened(source, len(source), trust, _part_of(source))
    path = Path(source)
    try:
        with path.open("rb") as file, unchanged(path, file):
            status, state = os.fstat(file.fileno()), state_of(file.fileno())
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISFIFO(status.st_mode)):
                raise UsageError(f"'{path}' is not a regular file")
            start = file.read(FIXED_BYTES)
            if stat.S_ISREG(status.st_mode):
                start += file.read(max(min(header_bytes_of(start), status.st_size) - len(start), 0))

                def at_once(offset: int, nbytes: int) -> bytes:
                    file.seek(offset)
                    return file.read(nbytes)

                opened = _opened(start, status.st_size, trust, at_once)
                return replace(opened, read=partial(_read, path, state))
            if header_bytes_of(start):
                start += file.read()
        return _opened(start, len(start), trust, _part_of(start))
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    except DataError as error:
        raise error if f"'{path}'" in str(error) else DataError(f"'{path}': {error}") from None


def _part_of(data: bytes) -> Reading:
    return lambda offset, nbytes: memoryview(data)[offset : offset + nbytes]


def _opened(start: bytes, file_bytes: int, trust: bool, read: Reading) -> PotrFile:
    header = container.read_header(start, file_bytes, trust)
    facts: dict[str, Any] = {}
    for section in header.sections:
        if section.kind is Property.METADATA:
            stored = read(header.start + section.offset, section.stored_bytes)
            raw = container.read_section(stored, replace(section, offset=0))
            facts = parse(raw.tobytes())
    return PotrFile(header, facts, read)


def _read(path: Path, state: State, offset: int, nbytes: int) -> bytes:
    """Some bytes of a file that has been opened before, and was in this state then.

    Raises:
        UsageError: it cannot be read any more.
        DataError: it was changed since, or another file is in its place.
    """
    try:
        with path.open("rb") as file:
            file.seek(offset)
            found = file.read(nbytes)
            refuse_changed(path, state, state_of(file.fileno()))
            return found
    except OSError as error:
        raise UsageError(f"cannot read '{path}': {error.strerror or error}") from None


def decode(
    source: bytes | str | os.PathLike[str], trust: bool = False, sh_degree: int | None = None, box: Box | None = None
) -> Scene:
    """Decode a .potr file, given as bytes or as a path.

    Args:
        source: the file.
        trust: whether it may hold more splats a byte than a real scene has. Without, the memory taken is in proportion
            to the size of the file.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        box: leave out splats whose centres lie outside. Only blocks that meet the box are read.

    Raises:
        UsageError: the path cannot be read, there is no such degree, or no splat lies in the box.
        DataError: damaged, or too many splats for its size.
    """
    try:
        return open_file(source, trust).scene(sh_degree=sh_degree, box=box)
    except DataError as error:
        where = "" if isinstance(source, bytes) else os.fspath(source)
        raise error if where in str(error) else DataError(f"'{where}': {error}") from None
