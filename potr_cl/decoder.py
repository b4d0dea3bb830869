"""Decoder: from the bytes of a .potr file back to a scene, in order. Nothing in a file is trusted."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl import bitstream, octree, quantize
from potr_cl.bitstream import Header, Property
from potr_cl.errors import DataError, UsageError
from potr_cl.scene import SH_COEFFICIENTS, Scene

#: Splats dequantised at a time: few enough for bounded temporaries, enough that threads seldom wait for each other.
_BLOCK = 1 << 17

_EMPTY = np.empty(0, np.uint8)


@dataclass(frozen=True)
class PotrFile:
    """An opened .potr file. Its properties can be decoded one by one, in any order and from several threads.

    Attributes:
        header: verified.
        data: the whole file.
    """

    header: Header
    data: bytes

    @staticmethod
    def from_bytes(data: bytes) -> PotrFile:
        """Verify the header of a file in memory.

        Raises:
            DataError: not a .potr file, or a damaged one.
        """
        return PotrFile(bitstream.read_header(data, len(data)), data)

    @staticmethod
    def open(path: str | os.PathLike[str]) -> PotrFile:
        """Read a file and verify its header.

        Raises:
            UsageError: the path cannot be read.
            DataError: not a .potr file, or a damaged one.
        """
        path = Path(path)
        try:
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                # The header must be sound before the rest is worth its memory.
                start = file.read(len(bitstream.MAGIC))
                if start == bitstream.MAGIC or size == 0:
                    start += file.read()
            return PotrFile(bitstream.read_header(start, max(len(start), size)), start)
        except OSError as error:
            raise UsageError(f"cannot read '{path}': {error.strerror}") from None
        except DataError as error:
            raise DataError(f"'{path}': {error}") from None

    @property
    def metadata(self) -> dict[str, Any]:
        """What the encoder noted of itself; empty if it noted nothing.

        Raises:
            DataError: damaged.
        """
        try:
            facts = json.loads(bytes(self._raw(Property.METADATA)) or b"{}")
        except (ValueError, RecursionError):
            facts = None
        if not isinstance(facts, dict):
            raise DataError("section 'metadata' is not a JSON object")
        return facts

    def means(self) -> NDArray[np.float32]:
        """(N, 3) float32 centres, world units.

        Raises:
            DataError: damaged.
        """
        header = self.header
        planes = self._planes(Property.MULTIPLICITY)
        raw = self._raw(Property.MULTIPLICITY)
        count = len(raw) // planes if planes else 0
        if planes and len(raw) != planes * count:
            raise DataError("section 'multiplicity' does not hold whole integers")
        tree = octree.OctreeStreams(
            origin=header.origin,
            side=header.side,
            depth=header.depth,
            occupancy=self._raw(Property.OCCUPANCY),
            several=self._raw(Property.SEVERAL),
            multiplicities=bitstream.unpack_integers(raw, planes, False, 0, count).astype(np.uint64),
            tail_lengths=self._raw(Property.TAIL_LENGTH),
            tails=self._raw(Property.TAIL),
        )
        return octree.parse(tree, header.splats)

    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) float32 natural logarithms of standard deviations. Raises DataError if damaged."""
        out = np.empty((self.header.splats, 3), np.float32)
        for axis in range(3):
            for block, steps in self._blocks([(Property.SCALE, axis)]):
                out[block, axis] = quantize.dequantize_scales(steps[0], self.header.sf_scale)
        return out

    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) float32 unit quaternions w, x, y, z. Raises DataError if damaged."""
        out = np.empty((self.header.splats, 4), np.float32)
        for block, steps in self._blocks([(Property.ROTATION, axis) for axis in range(3)]):
            quantize.dequantize_rotations(steps, self.header.sf_rotation, out[block])
        return out

    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) float32 logits. Raises DataError if damaged."""
        out = np.empty(self.header.splats, np.float32)
        for block, steps in self._blocks([(Property.OPACITY, 0)]):
            out[block] = quantize.dequantize_opacities(steps[0], self.header.sf_opacity)
        return out

    def sh(self) -> NDArray[np.float32]:
        """(N, M, 3) float32 SH coefficients, each contiguous in memory. Raises DataError if damaged."""
        planar = self._empty_sh()
        for m in range(len(planar)):
            self._decode_coefficient(m, planar[m])
        return planar.transpose(2, 0, 1)

    def scene(self, threads: int = 0) -> Scene:
        """Decode everything.

        Args:
            threads: 0: one a processor.

        Raises:
            DataError: damaged.
        """
        header = self.header
        planar = self._empty_sh()
        jobs: list[Callable[[], Any]] = [self.means, self.quaternions, self.log_scales, self.opacity_logits]
        jobs += [partial(self._decode_coefficient, m, planar[m]) for m in range(len(planar))]
        pool = ThreadPoolExecutor(threads or min(os.cpu_count() or 1, len(jobs)))
        try:
            futures = [pool.submit(job) for job in jobs]
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done() and (error := future.exception()) is not None:
                    raise error
            means, quaternions, log_scales, opacity_logits = (f.result() for f in futures[:4])
        except MemoryError:
            needed = header.splats * (11 + 3 * SH_COEFFICIENTS[header.sh_degree]) * 4
            raise DataError(f"the scene needs {needed / 1e9:.1f} GB of memory, more than there is") from None
        finally:
            pool.shutdown(cancel_futures=True)
        return Scene(means, log_scales, quaternions, opacity_logits, planar.transpose(2, 0, 1))

    # ------------------------------------------------------------------------------------------ inside

    def _raw(self, prop: Property, index: int = 0) -> NDArray[np.uint8]:
        section = self.header.find(prop, index)
        return _EMPTY if section is None else bitstream.read_section(self.data, section)

    def _planes(self, prop: Property, index: int = 0) -> int:
        section = self.header.find(prop, index)
        return 0 if section is None else section.planes

    def _blocks(self, streams: list[tuple[Property, int]]) -> Iterator[tuple[slice, list[NDArray[np.integer]]]]:
        """The integers of some streams side by side, block by block."""
        coded = [(self._raw(*key), self._planes(*key), bitstream.is_signed(key[0])) for key in streams]
        for start in range(0, self.header.splats, _BLOCK):
            stop = min(start + _BLOCK, self.header.splats)
            yield (
                slice(start, stop),
                [bitstream.unpack_integers(raw, planes, signed, start, stop) for raw, planes, signed in coded],
            )

    def _empty_sh(self) -> NDArray[np.float32]:
        return np.empty((SH_COEFFICIENTS[self.header.sh_degree], 3, self.header.splats), np.float32)

    def _decode_coefficient(self, m: int, out: NDArray[np.float32]) -> None:
        """One SH coefficient into ``out`` (3, N): R, G, B."""
        factor = np.float32(self.header.sf_sh)
        keys = [(Property.SH, 3 * m + channel) for channel in range(3)]
        widest = max(self._planes(*key) for key in keys)
        if widest == 0:
            out[:] = 0
            return
        # Sums of three integers need two bits more than their planes hold, running sums of differences any number.
        dtype: type[np.signedinteger] = np.int16 if widest == 1 else np.int32 if widest <= 3 else np.int64
        if m == 0:
            dtype = np.int64
        last = [0, 0, 0]
        for block, steps in self._blocks(keys):
            channels: list[NDArray[Any]] = [s.astype(dtype) for s in steps]
            if m == 0:
                for channel, differences in enumerate(channels):
                    differences[0] += last[channel]
                    np.cumsum(differences, out=differences)
                    last[channel] = differences[-1]
            y, co, cg = channels
            r = y - cg
            np.divide(r + co, factor, out=out[0, block], dtype=np.float32, casting="unsafe")
            np.divide(y + cg, factor, out=out[1, block], dtype=np.float32, casting="unsafe")
            np.divide(r - co, factor, out=out[2, block], dtype=np.float32, casting="unsafe")


def decode(source: bytes | str | os.PathLike[str]) -> Scene:
    """Decode a .potr file, given as bytes or as a path.

    Raises:
        UsageError: the path cannot be read.
        DataError: damaged.
    """
    if isinstance(source, bytes):
        return PotrFile.from_bytes(source).scene()
    try:
        return PotrFile.open(source).scene()
    except DataError as error:
        where = os.fspath(source)
        raise error if where in str(error) else DataError(f"'{where}': {error}") from None
