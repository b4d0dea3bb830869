"""A block of a file, read: :class:`Body` decodes it, or some of its properties. Nothing in it is trusted."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, octree
from potr_cl.codec.block_values import BlockValues
from potr_cl.codec.container import Block
from potr_cl.codec.dequantizer import BundleTaker, Fillable, SceneArrays
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.plain import PlainValues
from potr_cl.codec.sections import Coder, Property
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.errors import DataError
from potr_cl.host import mapped
from potr_cl.host.threads import Run
from potr_cl.model.scene import Scene, most_coefficients

#: More threads would find nothing to do.
_MOST_THREADS = 16
#: Centres that are compared with their box at a time: they stay in a cache.
_ROWS = 1 << 14


@dataclass(frozen=True)
class Body:
    """A block. Its properties can be decoded one by one, in any order and from several threads.

    Attributes:
        block: what the table says of it, verified.
        data: its bytes, of the sections that will be asked for at least.
    """

    block: Block
    data: bytes | memoryview

    def means(self, run: Run = map, parts: int = 1) -> NDArray[np.float32]:
        """(N, 3) float32 centres, world units. ``run`` shares out the work, in so many parts.

        Raises:
            DataError: damaged.
        """
        block = self.block
        counts = self._raw(Property.MULTIPLICITY)
        if len(counts) % 4:
            raise DataError("section 'multiplicity' does not hold whole integers")
        tree = octree.OctreeStreams(
            origin=block.origin,
            side=block.side,
            depth=block.depth,
            occupancy=self._raw(Property.OCCUPANCY),
            several=self._raw(Property.SEVERAL),
            multiplicities=np.frombuffer(counts.tobytes(), "<u4").astype(np.uint64),
            leaf_levels=self._raw(Property.LEAF_LEVEL),
            tails=self._raw(Property.TAIL),
        )
        means = octree.parse(tree, block.splats, run, parts)
        self._check_box(means)
        return means

    def _check_box(self, means: NDArray[np.float32]) -> None:
        # As one row of numbers: of rows of three each would cost a call.
        box, flat = self.block.box, means.reshape(-1)
        low, high = (np.tile(np.array(corner, np.float32), _ROWS) for corner in (box.low, box.high))
        for start in range(0, len(flat), len(low)):
            some = flat[start : start + len(low)]
            if not ((some >= low[: len(some)]).all() and (some <= high[: len(some)]).all()):
                raise DataError("centres lie outside of the block's box: get the file again")

    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) float32 natural logarithms of standard deviations. Raises DataError if damaged."""
        out = np.empty((self.block.splats, 3), np.float32)
        self._values.fill(ValueArrays(log_scales=out))
        return out

    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) float32 unit quaternions w, x, y, z. Raises DataError if damaged."""
        out = np.empty((self.block.splats, 4), np.float32)
        self._values.fill(ValueArrays(quaternions=out))
        return out

    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) float32 logits. Raises DataError if damaged."""
        out = np.empty(self.block.splats, np.float32)
        self._values.fill(ValueArrays(logits=out))
        return out

    def sh(self, degree: int | None = None) -> NDArray[np.float32]:
        """(N, M, 3) float32 SH coefficients, each contiguous in memory.

        Args:
            degree: those up to this degree, 0 for the DC alone; sections of others are not looked at. None: all.

        Raises:
            UsageError: there is no such degree.
            DataError: damaged.
        """
        planar = mapped.array((self.sh_count(degree), 3, self.block.splats), np.float32, "SH coefficients")
        self._values.fill(ValueArrays(sh=planar))
        return planar.transpose(2, 0, 1)

    def colour_steps(self) -> ColourSteps | None:
        """What fits the steps of colours to each splat; None if all are the same. Raises DataError if damaged."""
        if self.block.find(Property.STEPS) is None:
            return None
        return ColourSteps.from_bytes(self._raw(Property.STEPS).tobytes(), self.block.splats)

    def scene(self, threads: int = 0, sh_degree: int | None = None) -> Scene:
        """Decode everything, or all but some SH coefficients.

        Args:
            threads: 0: one a processor.
            sh_degree: as ``degree`` of :meth:`sh`.

        Raises:
            UsageError: there is no such degree.
            DataError: damaged.
        """
        arrays = SceneArrays(self.block, self.sh_count(sh_degree))
        self.decode_into(arrays, threads, sh_degree)
        return arrays.scene

    def decode_into(self, destination: Fillable | BundleTaker, threads: int = 0, sh_degree: int | None = None) -> None:
        """Decode as :meth:`scene` does, but hand what is decoded to a destination, which may be on another device.

        Args:
            destination: it has room for the SH coefficients that are wanted.
            threads, sh_degree: as of :meth:`scene`.

        Raises:
            As :meth:`scene`, and what the destination raises.
        """
        threads = threads or min(os.cpu_count() or 1, _MOST_THREADS)
        values = replace(self._values, activation=destination.activation)
        if isinstance(destination, BundleTaker):
            values.pack(destination, self.sh_count(sh_degree), threads, self.means)
        else:
            values.fill(destination.values, threads, lambda: destination.take_means(self.means()))

    def sh_count(self, degree: int | None = None) -> int:
        """How many SH coefficients of a channel there are up to a degree, which need not be in the file; None: all.

        Raises:
            UsageError: there is no such degree.
        """
        return most_coefficients(self.block.sh_degree, degree)

    @cached_property
    def _values(self) -> BlockValues | PlainValues:
        kind: Callable[..., BlockValues | PlainValues] = (
            BlockValues if self.block.coder == Coder.BUNDLES else PlainValues
        )
        return kind(self.block, self.data, self.colour_steps)

    def _raw(self, prop: Property) -> NDArray[np.uint8]:
        section = self.block.find(prop)
        return np.empty(0, np.uint8) if section is None else container.read_section(self.data, section)
