"""Decoder: from the bytes of a .potr file back to a scene (:func:`decode`, :class:`PotrFile`).

Splats come in the order of the file. Nothing in a file is trusted.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, metadata, octree, sections
from potr_cl.codec.blocks.file import BlockedFile
from potr_cl.codec.blocks.table import FIXED_BYTES, header_bytes_of, is_of_blocks, read_table
from potr_cl.codec.bundled_scene import BundledScene
from potr_cl.codec.byte_planes import IntegerStream, PlaneStream, unpack_integers
from potr_cl.codec.colour_factors import ColourFactors, Once
from potr_cl.codec.container import Header
from potr_cl.codec.context.decoder import Reader, Stream
from potr_cl.codec.context.lanes import Lanes
from potr_cl.codec.context.model import Sizes
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.destination import BundleTaker, Destination, Fillable, SceneArrays
from potr_cl.codec.native.library import native
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.sections import Coder, Property, Section
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.codec.versions import VERSIONS, FormatVersion
from potr_cl.errors import DataError, UsageError
from potr_cl.host.threads import Run, SharedWork, first_error, thread_pool
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene, most_coefficients

#: More threads would find nothing to do.
_MOST_THREADS = 16
#: Coefficients and other properties whose integers may wait for a thread to make values of them.
_MOST_WAITING = 6
#: Bytes of stored integers, for each splat, that all threads together may have unpacked: half a decoded splat.
_MOST_UNPACKED = 120
#: Splats for each thread, so that one more pays.
_SPLATS_A_THREAD = 24576

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
    def from_bytes(data: bytes, trust: bool = False) -> PotrFile:
        """Verify the header of a file in memory.

        Args:
            data: the whole file.
            trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.

        Raises:
            DataError: not a .potr file, or a damaged one, or too many splats for its size.
        """
        return PotrFile(container.read_header(data, len(data), trust), data)

    @staticmethod
    def open(path: str | os.PathLike[str], trust: bool = False) -> PotrFile:
        """Read a file and verify its header.

        Args:
            path: of the file, or of a pipe that brings one.
            trust: as of :meth:`from_bytes`.

        Raises:
            UsageError: the path cannot be read.
            DataError: not a .potr file, or a damaged one, or too many splats for its size.
        """
        opened = open_file(path, trust)
        if isinstance(opened, BlockedFile):
            raise DataError(f"'{os.fspath(path)}': a file of blocks, which is no single one")
        return opened

    @property
    def metadata(self) -> dict[str, Any]:
        """What the encoder noted of itself; empty if it noted nothing.

        Raises:
            DataError: damaged.
        """
        return metadata.parse(bytes(self._raw(Property.METADATA)))

    def means(self) -> NDArray[np.float32]:
        """(N, 3) float32 centres, world units.

        Raises:
            DataError: damaged.
        """
        return self._means(map, 1)

    def _means(self, run: Run, parts: int) -> NDArray[np.float32]:
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
            multiplicities=unpack_integers(raw, planes, False, 0, count).astype(np.uint64),
            tail_lengths=self._raw(Property.TAIL_LENGTH),
            tails=self._raw(Property.TAIL),
            absolute=self.rules.absolute_leaf_levels,
        )
        return octree.parse(tree, header.splats, run, parts)

    def log_scales(self) -> NDArray[np.float32]:
        """(N, 3) float32 natural logarithms of standard deviations. Raises DataError if damaged."""
        out = np.empty((self.header.splats, 3), np.float32)
        if self._bundled:
            self._bundled.fill(ValueArrays(log_scales=out))
            return out
        self._dequantizer.scales(self._streams(Property.SCALE), out)
        return out

    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) float32 unit quaternions w, x, y, z. Raises DataError if damaged."""
        out = np.empty((self.header.splats, 4), np.float32)
        if self._bundled:
            self._bundled.fill(ValueArrays(quaternions=out))
            return out
        scales = self._streams(Property.SCALE) if self.rules.rotations_need_scales else []
        self._dequantizer.rotations(self._streams(Property.ROTATION), scales, out)
        return out

    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) float32 logits. Raises DataError if damaged."""
        out = np.empty(self.header.splats, np.float32)
        if self._bundled:
            self._bundled.fill(ValueArrays(logits=out))
            return out
        self._dequantizer.opacities(self._streams(Property.OPACITY)[0], out)
        return out

    def sh(self, degree: int | None = None) -> NDArray[np.float32]:
        """(N, M, 3) float32 SH coefficients, each contiguous in memory.

        Args:
            degree: those up to this degree, 0 for the DC alone; sections of others are not looked at. None: all.

        Raises:
            UsageError: there is no such degree.
            DataError: damaged.
        """
        count = self.sh_count(degree)
        arrays = SceneArrays(self.header, self.rules, count)
        if self._bundled:
            self._bundled.fill(ValueArrays(sh=arrays.values.sh))
            return arrays.sh
        for _, job in self._sh_jobs(arrays, count, _Shared(self)):
            job(_now)
        return arrays.sh

    def colour_steps(self) -> ColourSteps | None:
        """What fits the steps of colours to each splat; None if all are the same.

        Raises:
            DataError: damaged.
        """
        if self.header.find(Property.STEPS) is None:
            return None
        return ColourSteps.from_bytes(self._raw(Property.STEPS).tobytes(), self.header.splats)

    def scene(self, threads: int = 0, sh_degree: int | None = None) -> Scene:
        """Decode everything, or all but some SH coefficients.

        Args:
            threads: 0: one a processor.
            sh_degree: as ``degree`` of :meth:`sh`.

        Raises:
            UsageError: there is no such degree.
            DataError: damaged.
        """
        try:
            arrays = SceneArrays(self.header, self.rules, self.sh_count(sh_degree))
            self.decode_into(arrays, threads, sh_degree)
        except MemoryError:
            needed = self.header.splats * (11 + 3 * self.sh_count(sh_degree)) * 4
            raise DataError(f"the scene needs {needed / 1e9:.1f} GB of memory, more than there is") from None
        return arrays.scene

    def decode_into(self, destination: Destination, threads: int = 0, sh_degree: int | None = None) -> None:
        """Decode as :meth:`scene` does, but hand what is decoded to a destination, which may be on another device.

        Args:
            destination: it has room for the SH coefficients that are wanted.
            threads, sh_degree: as of :meth:`scene`.

        Raises:
            As :meth:`scene`, and what the destination raises.
        """
        _ = self.metadata  # it takes no part in the scene, but damage anywhere is damage
        if self._bundled:
            self._decode_bundles(
                self._bundled, destination, threads or min(os.cpu_count() or 1, _MOST_THREADS), sh_degree
            )
            return
        shared = _Shared(self)
        shapes: _Job = partial(self._decode_shapes, destination, shared)
        opacities: _Job = partial(self._decode_opacities, destination, shared)
        # The longest first: a pool that ends with a long one ends late.
        jobs = [
            *self._sh_jobs(destination, self.sh_count(sh_degree), shared),
            (self._contextual(Property.SCALE) or self._contextual(Property.ROTATION), shapes),
            (self._contextual(Property.OPACITY), opacities),
        ]
        threads = min(threads or min(os.cpu_count() or 1, _MOST_THREADS), self._threads_in_memory())
        # With fewer splats for each, threads wait for the interpreter, and for memory, longer than they decode.
        threads = min(threads, max(self.header.splats // _SPLATS_A_THREAD, 2))
        self._run(jobs, lambda run, parts: destination.take_means(self._means(run, parts)), threads)

    def sh_count(self, degree: int | None = None) -> int:
        """How many SH coefficients of a channel there are up to a degree, which need not be in the file; None: all.

        Raises:
            UsageError: there is no such degree.
        """
        return most_coefficients(self.header.sh_degree, degree)

    @property
    def rules(self) -> FormatVersion:
        """Those of the file's version."""
        return VERSIONS[self.header.version]

    def _run(self, jobs: list[tuple[bool, _Job]], centres: Callable[[Run, int], None], threads: int) -> None:
        """Do some jobs, each with whether it takes the context coder, and decode the centres.

        By NumPy the context coder makes many short calls, in which threads would only wait for each other: one makes
        them all, and leaves what else is to be done with the integers to others.
        """
        alone = native() is None
        left: list[Future[None]] = []
        work = SharedWork()

        def leave(what: Callable[[], None]) -> None:
            # What waits holds memory; where much does, threads are not what is missing.
            if sum(not future.done() for future in left) < _MOST_WAITING:
                left.append(work.add(what))
                pool.submit(work.do)
            else:
                what()

        submit: _Submit = _now if threads == 1 else leave

        def in_turn(some: list[_Job]) -> None:
            for job in some:
                job(submit)

        contextual = [job for takes_coder, job in jobs if takes_coder]
        with thread_pool(threads) as pool:
            try:
                coded = [partial(in_turn, some) for some in ([contextual] if alone else [[job] for job in contextual])]
                others = [partial(job, _now) for takes_coder, job in jobs if not takes_coder]
                first = [work.add(what) for what in (*coded, partial(centres, work.run, threads), *others)]
                for _ in range(min(threads, len(first))):
                    pool.submit(work.do)
                for futures in (first, left):
                    if (error := first_error(futures)) is not None:
                        raise error
            finally:
                work.forget()

    def _decode_bundles(
        self, scene: BundledScene, destination: Destination, threads: int, sh_degree: int | None
    ) -> None:
        if isinstance(destination, BundleTaker):
            count = self.sh_count(sh_degree)
            replace(scene, activation=destination.activation).pack(destination, count, threads, self.means)
        elif isinstance(destination, Fillable):
            fill = replace(scene, activation=destination.activation).fill
            fill(destination.values, threads, lambda: destination.take_means(self.means()))
        else:
            scene.hand_to(destination, self.sh_count(sh_degree), threads)
            destination.take_means(self.means())

    # ------------------------------------------------------------------------------------------ inside

    @cached_property
    def _bundled(self) -> BundledScene | None:
        """The splats of a file of coder BUNDLES, None for others."""
        section = self.header.find(Property.OPACITY)
        if section is None or section.coder != Coder.BUNDLES:
            return None
        return BundledScene(self.header, self.data, self.colour_steps)

    def _raw(self, prop: Property, index: int = 0) -> NDArray[np.uint8]:
        section = self.header.find(prop, index)
        return _EMPTY if section is None else container.read_section(self.data, section)

    def _planes(self, prop: Property, index: int = 0) -> int:
        section = self.header.find(prop, index)
        return 0 if section is None else section.planes

    def _contextual(self, prop: Property, index: int = 0) -> bool:
        section = self.header.find(prop, index)
        return section is not None and section.coder == Coder.CONTEXT

    def _context_streams(self, section: Section, history: Sizes | None = None) -> Iterator[Stream]:
        """The streams of a section of coder CONTEXT, one after another."""
        yield from Reader(
            container.stored_bytes(self.data, section),
            section.integers // section.streams,
            section.streams,
            sections.is_signed(section.kind),
            sections.is_predicted(section.kind, section.index) and not self.rules.colour_steps,
            history,
            section.name,
        )

    def _threads_in_memory(self) -> int:
        """How many threads may unpack three streams each: real files' integers are narrow enough for all threads."""
        widest = max((section.planes for section in self.header.sections), default=0)
        return max(1, _MOST_UNPACKED // (3 * max(widest, 1)))

    def _streams(self, prop: Property, indices: range | None = None) -> list[IntegerStream]:
        """Some streams of one integer a splat, all of a property's by default."""
        indices = range(sections.stream_count(prop)) if indices is None else indices
        section = self.header.find(prop, indices[0])
        if section is not None and section.coder == Coder.CONTEXT:
            return list(self._context_streams(section))
        signed, splats = sections.is_signed(prop), self.header.splats
        return [PlaneStream(self._raw(prop, index), self._planes(prop, index), signed, splats) for index in indices]

    @property
    def _dequantizer(self) -> Dequantizer:
        return Dequantizer(self.header, self.rules)

    def _decode_shapes(self, destination: Destination, shared: _Shared, submit: _Submit) -> None:
        scales = shared.scales.get()
        submit(partial(destination.take_scales, scales))
        submit(partial(destination.take_rotations, self._streams(Property.ROTATION), scales))

    def _decode_opacities(self, destination: Destination, shared: _Shared, submit: _Submit) -> None:
        submit(partial(destination.take_opacities, shared.opacities.get()))

    def _sh_jobs(self, destination: Destination, count: int, shared: _Shared) -> list[tuple[bool, _Job]]:
        """What decodes so many SH coefficients of a channel, and whether it takes the context coder."""
        stop = 3 * count
        contextual = [s for s in self.header.sections if s.kind == Property.SH and s.coder == Coder.CONTEXT]
        chained = [s for s in contextual if 0 < s.index < stop]
        in_chain = {s.index // 3 + m for s in chained for m in range(s.streams // 3)}
        alone = [m for m in range(count) if m not in in_chain]
        jobs: list[tuple[bool, _Job]] = (
            [(True, partial(self._decode_chain, chained, destination, shared))] if chained else []
        )
        return jobs + [
            (self._contextual(Property.SH, 3 * m), partial(self._decode_coefficient, m, destination, shared))
            for m in alone
        ]

    def _decode_chain(self, chain: list[Section], destination: Destination, shared: _Shared, submit: _Submit) -> None:
        """AC coefficients whose contexts are made of those before."""
        history = Sizes(Lanes(self.header.splats))
        for section in sorted(chain, key=lambda s: s.index):
            streams = self._context_streams(section, history)
            for m, channels in enumerate(zip(streams, streams, streams, strict=True), start=section.index // 3):
                submit(partial(_take_colours, destination, channels, m, False, shared))

    def _decode_coefficient(self, m: int, destination: Destination, shared: _Shared, submit: _Submit) -> None:
        """The three channels of one SH coefficient."""
        streams = self._streams(Property.SH, range(3 * m, 3 * m + 3))
        differences = m == 0 and not self.rules.colour_steps and not self._contextual(Property.SH)
        submit(partial(_take_colours, destination, streams, m, differences, shared))


class _Shared:
    """What more than one of a file's properties is made of; any thread may ask for it.

    Args:
        file: that is decoded.

    Attributes:
        scales, opacities: their streams.
        factors: what colours are made with.
    """

    def __init__(self, file: PotrFile) -> None:
        self.scales = Once(lambda: file._streams(Property.SCALE))
        self.opacities = Once(lambda: file._streams(Property.OPACITY)[0])
        self.factors = Once(self._find_factors)
        self._file = file

    def _find_factors(self) -> ColourFactors:
        header, steps = self._file.header, self._file.colour_steps()
        return ColourFactors.of(header, steps, self.scales.get, self.opacities.get)


def _take_colours(
    destination: Destination, streams: Sequence[IntegerStream], m: int, differences: bool, shared: _Shared
) -> None:
    destination.take_colours(streams, m, differences, shared.factors.get())


#: Takes what needs no more than what is at hand, to be done now or by another thread.
_Submit = Callable[[Callable[[], None]], None]
#: Decodes some of a file.
_Job = Callable[[_Submit], None]


def _now(work: Callable[[], None]) -> None:
    work()


#: A .potr file, opened: of a scene in one piece, or in blocks.
AnyFile: TypeAlias = "PotrFile | BlockedFile[PotrFile]"


def open_file(source: bytes | str | os.PathLike[str], trust: bool = False) -> AnyFile:
    """Open a .potr file of any version, given as bytes or as a path, and verify its header.

    Of a file of blocks only the header is read; the blocks are when they are asked for.

    Args:
        source: the file; a path may be that of a pipe that brings one.
        trust: whether it may hold more splats a byte than a real scene has, and so take memory out of proportion.

    Raises:
        UsageError: the path cannot be read.
        DataError: not a .potr file, or a damaged one, or too many splats for its size.
    """
    if isinstance(source, bytes):
        return _opened(source, len(source), trust, lambda offset, nbytes: source[offset : offset + nbytes])
    path = Path(source)
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISFIFO(status.st_mode)):
                raise UsageError(f"'{path}' is not a regular file")
            # The header must be sound before the rest is worth its memory.
            start = file.read(FIXED_BYTES)
            if stat.S_ISREG(status.st_mode) and is_of_blocks(start):
                start += file.read(max(min(header_bytes_of(start), status.st_size) - len(start), 0))
                return _opened(start, status.st_size, trust, partial(_read, path))
            if start.startswith(container.MAGIC):
                start += file.read()
        return _opened(
            start, max(len(start), status.st_size), trust, lambda offset, nbytes: start[offset : offset + nbytes]
        )
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


def _opened(start: bytes, file_bytes: int, trust: bool, read: Callable[[int, int], bytes]) -> AnyFile:
    if not is_of_blocks(start):
        return PotrFile(container.read_header(start, file_bytes, trust), start)
    return BlockedFile(read_table(start, file_bytes, trust), read, partial(PotrFile.from_bytes, trust=trust), trust)


def _read(path: Path, offset: int, nbytes: int) -> bytes:
    """Some bytes of a file, fewer where it has got shorter."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            return file.read(nbytes)
    except OSError as error:
        raise UsageError(f"cannot read '{path}': {error.strerror or error}") from None


def decode(
    source: bytes | str | os.PathLike[str],
    trust: bool = False,
    sh_degree: int | None = None,
    box: Box | None = None,
) -> Scene:
    """Decode a .potr file, given as bytes or as a path.

    Args:
        source: the file.
        trust: whether it may hold more splats a byte than a real scene has. Without, the memory taken is in proportion
            to the size of the file.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        box: leave out splats whose centres lie outside. Of a file of blocks only those that meet the box are read.

    Raises:
        UsageError: the path cannot be read, there is no such degree, or no splat lies in the box.
        DataError: damaged, or too many splats for its size.
    """
    try:
        return scene_of_file(open_file(source, trust), sh_degree, box)
    except DataError as error:
        where = "" if isinstance(source, bytes) else os.fspath(source)
        raise error if where in str(error) else DataError(f"'{where}': {error}") from None


def scene_of_file(file: AnyFile, sh_degree: int | None = None, box: Box | None = None, threads: int = 0) -> Scene:
    """Decode an opened file; arguments and errors as of :func:`decode`."""
    if isinstance(file, BlockedFile):
        return file.scene(threads, sh_degree, box)
    scene = file.scene(threads, sh_degree)
    if box is None:
        return scene
    inside = np.flatnonzero(box.holds(scene.means))
    if not len(inside):
        low, high = scene.means.min(axis=0), scene.means.max(axis=0)
        raise UsageError(f"no splat lies in the box {box}: the scene lies in {Box.of([*low, *high])}")
    return scene.subset(inside)
