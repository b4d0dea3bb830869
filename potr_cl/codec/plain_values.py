"""The values of a block of the plain coder: :class:`PlainValues`, with what :class:`BlockValues` offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import dequantizer, plain
from potr_cl.codec.container import Block
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.host.threads import thread_pool

if TYPE_CHECKING:
    from potr_cl.codec.destination import Activation, BundleTaker

#: Bundles that a thread works on at a time, and threads that do: integers may be wide, and take memory.
_AT_A_TIME, _MOST_THREADS = 3, 2


@dataclass(frozen=True)
class PlainValues:
    """A block's splats but for their centres; attributes as of :class:`potr_cl.codec.block_values.BlockValues`."""

    block: Block
    data: bytes | memoryview
    open_steps: Callable[[], ColourSteps | None]
    activation: Activation | None = None

    @cached_property
    def reader(self) -> plain.Reader:
        """Of the integers."""
        return plain.opened(self.data, self.block, self.open_steps)

    def fill(self, arrays: ValueArrays, threads: int = 1, beside: Callable[[], None] | None = None) -> None:
        """As :meth:`potr_cl.codec.block_values.BlockValues.fill`."""
        with thread_pool(min(threads, _MOST_THREADS)) as pool:
            other = None if beside is None else pool.submit(beside)
            reader = self._opened(arrays)
            list(pool.map(lambda first: self._fill(reader, self._bundles(first), arrays), self._starts))
            if other is not None:
                other.result()

    def pack(
        self, destination: BundleTaker, sh_count: int, threads: int, means: Callable[[], NDArray[np.float32]]
    ) -> None:
        """As :meth:`potr_cl.codec.block_values.BlockValues.pack`."""
        destination.expect_bundles()
        destination.take_means(means())
        reader: plain.Reader | None = None
        for first in self._starts:
            bundles = self._bundles(first)

            def filled(arrays: ValueArrays, bundles: range = bundles) -> None:
                nonlocal reader
                reader = reader or self._opened(arrays)
                self._fill(reader, bundles, arrays)

            dequantizer.pack(destination, self.block, sh_count, bundles, filled)

    def _opened(self, arrays: ValueArrays) -> plain.Reader:
        """The integers that some arrays are made of."""
        reader, rotations = self.reader, arrays.quaternions is not None
        reader.open(0 if arrays.sh is None else len(arrays.sh), rotations or arrays.log_scales is not None, rotations)
        return reader

    def _fill(self, reader: plain.Reader, bundles: range, arrays: ValueArrays) -> None:
        levels = reader.levels(bundles.start, bundles.stop)
        dequantizer.fill(arrays, self.block, levels, reader.steps, self.activation)

    @property
    def _starts(self) -> range:
        return range(0, self.reader.bundles.number, _AT_A_TIME)

    def _bundles(self, first: int) -> range:
        return range(first, min(first + _AT_A_TIME, self.reader.bundles.number))
