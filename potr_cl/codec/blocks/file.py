"""A file of blocks, opened: :class:`BlockedFile`. Blocks are read and decoded when they are asked for, and no others.

Nothing in a file is trusted: what the table says of a block is compared with the block's own header before memory is
taken for its splats, and with its centres afterwards.
"""

from __future__ import annotations

import contextvars
import os
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, metadata
from potr_cl.codec.blocks.table import BlockTable
from potr_cl.codec.container import Header
from potr_cl.codec.versions import VERSIONS
from potr_cl.errors import DataError, UsageError
from potr_cl.host import mapped
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene, joined, most_coefficients

#: Blocks that are decoded side by side; each has threads of its own.
_SIDE_BY_SIDE = 4
#: A block's header is within so many bytes, unless it has more sections than are ever written.
_HEADER_BYTES = 1 << 12


class Body(Protocol):
    """A block, opened, as :class:`potr_cl.codec.decoder.PotrFile`."""

    @property
    def header(self) -> Header: ...

    def means(self) -> NDArray[np.float32]: ...

    def scene(self, threads: int = 0, sh_degree: int | None = None) -> Scene: ...


B = TypeVar("B", bound=Body)
T = TypeVar("T")


@dataclass(frozen=True)
class BlockedFile(Generic[B]):
    """An opened file of blocks.

    Attributes:
        table: verified.
        read: gives so many bytes of the file from an offset on, or fewer where it ends.
        open_body: opens a block that was read; its header is verified again.
        trust: as of :func:`potr_cl.codec.blocks.table.read_table`.
    """

    table: BlockTable
    read: Callable[[int, int], bytes]
    open_body: Callable[[bytes], B]
    trust: bool = False

    @property
    def metadata(self) -> dict[str, Any]:
        """What the encoder noted of itself; empty if it noted nothing.

        Raises:
            DataError: damaged.
        """
        return metadata.parse(self.table.metadata)

    def header(self, number: int) -> Header:
        """The header of a block, verified; the rest of it is not read.

        Raises:
            DataError: damaged, or not what the table says.
        """
        block = self.table.blocks[number]
        start = self.read(block.offset, min(block.nbytes, _HEADER_BYTES))
        size = int.from_bytes(start[12:16], "little")
        if len(start) < size <= block.nbytes:
            start = self.read(block.offset, size)
        header = self._of(number, lambda: container.read_header(start, block.nbytes, self.trust))
        self._check(number, header)
        return header

    def body(self, number: int) -> B:
        """A block, read and opened.

        Raises:
            UsageError: the file cannot be read any more.
            DataError: damaged, or not what the table says.
        """
        block = self.table.blocks[number]
        data = self.read(block.offset, block.nbytes)
        if len(data) != block.nbytes or zlib.crc32(data) != block.crc:
            raise DataError(f"block {number} is damaged (its checksum does not match): get the file again")
        opened = self._of(number, lambda: self.open_body(data))
        self._check(number, opened.header)
        return opened

    def checked(self, number: int) -> B:
        """The same, after its centres were compared with the table's box.

        Raises:
            As :meth:`body`.
        """
        body = self.body(number)
        if not self.table.blocks[number].box.holds(self._of(number, body.means)).all():
            raise DataError(f"block {number} holds centres outside of its box: get the file again")
        return body

    def part(self, number: int, threads: int = 1, sh_degree: int | None = None, box: Box | None = None) -> Scene | None:
        """The splats of a block, or those of them that lie in a box; None if there are none.

        Raises:
            As :meth:`body`, and what decodes it.
        """
        body, own = self.body(number), self.table.blocks[number].box
        cut = box if box is not None and not box.covers(own) else None
        if cut is not None and not cut.holds(self._of(number, body.means)).any():
            return None
        scene = self._of(number, lambda: body.scene(threads, sh_degree))
        if not own.holds(scene.means).all():
            raise DataError(f"block {number} holds centres outside of its box: get the file again")
        return scene if cut is None else _some(scene, np.flatnonzero(cut.holds(scene.means)))

    def _of(self, number: int, work: Callable[[], T]) -> T:
        """What is made of a block; errors say which."""
        try:
            return work()
        except DataError as error:
            raise DataError(f"block {number}: {error}") from None

    def numbers(self, box: Box | None = None) -> list[int]:
        """The numbers of the blocks that have splats in a box, or may have; all without one."""
        return [number for number, block in enumerate(self.table.blocks) if box is None or box.meets(block.box)]

    def parts(self, threads: int = 0, sh_degree: int | None = None, box: Box | None = None) -> Iterator[Scene]:
        """Block by block in their order, with no more of them in memory than are decoded side by side.

        Args:
            threads: 0: one a processor.
            sh_degree: leave out SH coefficients of higher degrees; None: none.
            box: leave out splats whose centres lie outside, and do not read blocks that lie outside; None: none.

        Raises:
            UsageError: there is no such degree; or the file cannot be read any more.
            DataError: damaged.
        """
        most_coefficients(self.table.sh_degree, sh_degree)
        numbers = self.numbers(box)
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

    def scene(self, threads: int = 0, sh_degree: int | None = None, box: Box | None = None) -> Scene:
        """Decode everything, or a part; arguments as of :meth:`parts`.

        Raises:
            As :meth:`parts`.
            UsageError: no splat lies in the box.
        """
        count = most_coefficients(self.table.sh_degree, sh_degree)
        headers = [self.header(number) for number in self.numbers(box)]  # before memory is taken on the table's word
        try:
            if box is not None:
                parts = list(self.parts(threads, sh_degree, box))
                if not parts:
                    raise UsageError(f"no splat lies in the box {box}: the scene lies in {self.bounds}")
                return joined(parts)
            whole = _empty(self.table, sum(header.splats for header in headers), count)
            first = 0
            for part in self.parts(threads, sh_degree):
                whole.put(first, part)
                first += len(part)
        except MemoryError:
            needed = self.table.splats * (11 + 3 * count) * 4
            raise DataError(f"the scene needs {needed / 1e9:.1f} GB of memory, more than there is") from None
        return whole

    @property
    def bounds(self) -> Box:
        """Of all blocks together."""
        boxes = [block.box for block in self.table.blocks]
        low, high = np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0)
        return Box.of([*low, *high])

    def _check(self, number: int, header: Header) -> None:
        block, table = self.table.blocks[number], self.table
        if not VERSIONS[header.version].in_blocks:
            raise DataError(f"block {number} is of format version {header.version}, which no block may be of")
        own = (header.splats, header.sh_degree, header.antialiased, header.low_pass)
        if own != (block.splats, table.sh_degree, table.antialiased, table.low_pass):
            raise DataError(f"block {number} is not what the table says of it: get the file again")


def _some(scene: Scene, rows: NDArray[np.int64]) -> Scene:
    """Some splats of a scene, each SH coefficient contiguous in memory as a decoder leaves them."""
    some = scene.subset(rows)
    return replace(some, sh=np.ascontiguousarray(some.sh.transpose(1, 2, 0)).transpose(2, 0, 1))


def _empty(table: BlockTable, splats: int, count: int) -> Scene:
    return Scene(
        np.empty((splats, 3), np.float32),
        np.empty((splats, 3), np.float32),
        np.empty((splats, 4), np.float32),
        np.empty(splats, np.float32),
        mapped.array((count, 3, splats), np.float32, "SH coefficients").transpose(2, 0, 1),
        table.antialiased,
        table.low_pass,
    )
