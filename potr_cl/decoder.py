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

from potr_cl import bitstream, context_coder, octree, quantize
from potr_cl.bitstream import Coder, Header, Property, Section
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
            absolute=header.version > 1,
        )
        return octree.parse(tree, header.splats)

    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) float32 natural logarithms of standard deviations. Raises DataError if damaged."""
        return self._dequantized_scales(self._streams(Property.SCALE))

    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) float32 unit quaternions w, x, y, z. Raises DataError if damaged."""
        return self._dequantized_rotations(self._streams(Property.SCALE) if self.header.version > 1 else [])

    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) float32 logits. Raises DataError if damaged."""
        out = np.empty(self.header.splats, np.float32)
        dequantize = quantize.dequantize_opacities if self.header.version == 1 else quantize.dequantize_logits
        for block, steps in self._blocks(self._streams(Property.OPACITY)):
            out[block] = dequantize(steps[0], self.header.sf_opacity)
        return out

    def sh(self) -> NDArray[np.float32]:
        """(N, M, 3) float32 SH coefficients, each contiguous in memory. Raises DataError if damaged."""
        planar = self._empty_sh()
        for job in self._sh_jobs(planar):
            job()
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
        # The longest first: a pool that ends with a long one ends late.
        colours = self._sh_jobs(planar)
        jobs: list[Callable[[], Any]] = [*colours, self.means, self._shapes, self.opacity_logits]
        pool = ThreadPoolExecutor(threads or min(os.cpu_count() or 1, len(jobs)))
        try:
            futures = [pool.submit(job) for job in jobs]
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done() and (error := future.exception()) is not None:
                    raise error
            means, (log_scales, quaternions), opacity_logits = (f.result() for f in futures[len(colours) :])
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

    def _context_streams(
        self, section: Section, history: context_coder.Sizes | None = None
    ) -> Iterator[NDArray[np.integer]]:
        """The streams of a section of coder CONTEXT, one after another."""
        yield from context_coder.Reader(
            bitstream.stored_bytes(self.data, section),
            section.raw_bytes // section.planes,
            section.planes,
            bitstream.is_signed(section.kind),
            bitstream.is_predicted(section.kind, section.index),
            history,
            section.name,
        )

    def _streams(self, prop: Property, indices: range | None = None) -> list[_Stream]:
        """Some streams of one integer a splat, all of a property's by default."""
        indices = range(bitstream.indices(prop)) if indices is None else indices
        section = self.header.find(prop, indices[0])
        if section is not None and section.coder == Coder.CONTEXT:
            return [partial(_part, values) for values in self._context_streams(section)]
        signed = bitstream.is_signed(prop)
        return [
            partial(bitstream.unpack_integers, self._raw(prop, index), self._planes(prop, index), signed)
            for index in indices
        ]

    def _blocks(self, streams: list[_Stream]) -> Iterator[tuple[slice, list[NDArray[np.integer]]]]:
        """The integers of some streams side by side, block by block."""
        for start in range(0, self.header.splats, _BLOCK):
            stop = min(start + _BLOCK, self.header.splats)
            yield slice(start, stop), [stream(start, stop) for stream in streams]

    def _shapes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Log scales and quaternions."""
        scales = self._streams(Property.SCALE)
        return self._dequantized_scales(scales), self._dequantized_rotations(scales)

    def _dequantized_scales(self, streams: list[_Stream]) -> NDArray[np.float32]:
        out = np.empty((self.header.splats, 3), np.float32)
        for axis, stream in enumerate(streams):
            for block, steps in self._blocks([stream]):
                out[block, axis] = quantize.dequantize_scales(steps[0], self.header.sf_scale)
        return out

    def _dequantized_rotations(self, scales: list[_Stream]) -> NDArray[np.float32]:
        """Quaternions; ``scales`` matter in format version 2 only."""
        out = np.empty((self.header.splats, 4), np.float32)
        if self.header.version == 1:
            for block, steps in self._blocks(self._streams(Property.ROTATION)):
                quantize.dequantize_rotations(steps, self.header.sf_rotation, out[block])
        else:
            for block, steps in self._blocks([*self._streams(Property.ROTATION), *scales]):
                factors = quantize.rotation_factors(steps[3:], self.header.sf_rotation)
                quantize.dequantize_rotations(steps[:3], factors, out[block])
        return out

    def _empty_sh(self) -> NDArray[np.float32]:
        return np.empty((SH_COEFFICIENTS[self.header.sh_degree], 3, self.header.splats), np.float32)

    def _sh_jobs(self, planar: NDArray[np.float32]) -> list[Callable[[], None]]:
        """What decodes all SH coefficients into ``planar`` (M, 3, N); the jobs may run at the same time."""
        chained = [s for s in self.header.sections if s.kind == Property.SH and s.coder == Coder.CONTEXT and s.index]
        in_chain = {s.index // 3 + m for s in chained for m in range(s.planes // 3)}
        alone = [m for m in range(len(planar)) if m not in in_chain]
        jobs: list[Callable[[], None]] = [partial(self._decode_chain, chained, planar)] if chained else []
        return jobs + [partial(self._decode_coefficient, m, planar[m]) for m in alone]

    def _decode_chain(self, sections: list[Section], planar: NDArray[np.float32]) -> None:
        """AC coefficients whose contexts are made of those before."""
        history = context_coder.Sizes(context_coder.Lanes(self.header.splats))
        for section in sorted(sections, key=lambda s: s.index):
            streams = self._context_streams(section, history)
            for m, channels in enumerate(zip(streams, streams, streams, strict=True), start=section.index // 3):
                for block, steps in self._blocks([partial(_part, values) for values in channels]):
                    _to_rgb(_wider(steps), self.header.sf_ac, planar[m, :, block])

    def _decode_coefficient(self, m: int, out: NDArray[np.float32]) -> None:
        """One SH coefficient into ``out`` (3, N): R, G, B."""
        streams = self._streams(Property.SH, range(3 * m, 3 * m + 3))
        section = self.header.find(Property.SH, 3 * m)
        differences = m == 0 and not (section is not None and section.coder == Coder.CONTEXT)
        last = [0, 0, 0]
        for block, steps in self._blocks(streams):
            if differences:
                channels = [s.astype(np.int64) for s in steps]
                for c, channel in enumerate(channels):
                    channel[0] += last[c]
                    np.cumsum(channel, out=channel)
                    last[c] = channel[-1]
            else:
                channels = _wider(steps)
            _to_rgb(channels, self.header.sf_dc if m == 0 else self.header.sf_ac, out[:, block])


#: Gives the integers from one splat to another of a stream.
_Stream = Callable[[int, int], NDArray[np.integer]]


def _part(values: NDArray[np.integer], start: int, stop: int) -> NDArray[np.integer]:
    return values[start:stop]


def _wider(steps: list[NDArray[np.integer]]) -> list[NDArray[Any]]:
    """Integers of a type that holds the sums of three of them."""
    most = max(s.dtype.itemsize for s in steps)
    dtype: type[np.signedinteger] = np.int16 if most == 1 else np.int32 if most == 2 else np.int64
    return [s.astype(dtype) for s in steps]


def _to_rgb(channels: list[NDArray[Any]], factor: float, out: NDArray[np.float32]) -> None:
    """Steps of Y, Co, Cg to R, G, B in ``out`` (3, n)."""
    divisor = np.float32(factor)
    y, co, cg = channels
    r = y - cg
    np.divide(r + co, divisor, out=out[0], dtype=np.float32, casting="unsafe")
    np.divide(y + cg, divisor, out=out[1], dtype=np.float32, casting="unsafe")
    np.divide(r - co, divisor, out=out[2], dtype=np.float32, casting="unsafe")


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
