"""Decoder: from the bytes of a .potr file back to a scene (:func:`decode`, :class:`PotrFile`).

Splats come in the order of the file. Nothing in a file is trusted.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, metadata, octree
from potr_cl.codec.blocks.file import BlockedFile
from potr_cl.codec.blocks.table import FIXED_BYTES, header_bytes_of, is_of_blocks, read_table
from potr_cl.codec.bundled_scene import BundledScene
from potr_cl.codec.byte_planes import unpack_integers
from potr_cl.codec.container import Header
from potr_cl.codec.destination import BundleTaker, Destination, Fillable, SceneArrays
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.sectioned_scene import SectionedScene
from potr_cl.codec.sections import Coder, Property
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.codec.versions import VERSIONS, FormatVersion
from potr_cl.errors import DataError, UsageError
from potr_cl.host.threads import Run
from potr_cl.host.unchanged import State, refuse_changed, state_of, unchanged
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene, most_coefficients

#: More threads would find nothing to do.
_MOST_THREADS = 16


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
        section = header.find(Property.MULTIPLICITY)
        planes = 0 if section is None else section.planes
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
        self._sectioned.scales(out)
        return out

    def quaternions(self) -> NDArray[np.float32]:
        """(N, 4) float32 unit quaternions w, x, y, z. Raises DataError if damaged."""
        out = np.empty((self.header.splats, 4), np.float32)
        if self._bundled:
            self._bundled.fill(ValueArrays(quaternions=out))
            return out
        self._sectioned.rotations(out)
        return out

    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) float32 logits. Raises DataError if damaged."""
        out = np.empty(self.header.splats, np.float32)
        if self._bundled:
            self._bundled.fill(ValueArrays(logits=out))
            return out
        self._sectioned.opacities(out)
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
        self._sectioned.colours(arrays, count)
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
        threads = threads or min(os.cpu_count() or 1, _MOST_THREADS)
        _ = self.metadata  # it takes no part in the scene, but damage anywhere is damage
        if self._bundled:
            self._decode_bundles(self._bundled, destination, threads, sh_degree)
            return
        self._sectioned.decode_into(destination, self.sh_count(sh_degree), threads, self._means)

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

    @property
    def _sectioned(self) -> SectionedScene:
        """The splats of a file of other coders."""
        return SectionedScene(self.header, self.data, self.rules, self.colour_steps)

    def _raw(self, prop: Property, index: int = 0) -> NDArray[np.uint8]:
        return container.raw_bytes(self.header, self.data, prop, index)


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
        with path.open("rb") as file, unchanged(path, file):
            status, state = os.fstat(file.fileno()), state_of(file.fileno())
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISFIFO(status.st_mode)):
                raise UsageError(f"'{path}' is not a regular file")
            # The header must be sound before the rest is worth its memory.
            start = file.read(FIXED_BYTES)
            if stat.S_ISREG(status.st_mode) and is_of_blocks(start):
                start += file.read(max(min(header_bytes_of(start), status.st_size) - len(start), 0))
                return _opened(start, status.st_size, trust, partial(_read, path, state))
            if start.startswith(container.MAGIC):
                start += file.read()
        return _opened(
            start, max(len(start), status.st_size), trust, lambda offset, nbytes: start[offset : offset + nbytes]
        )
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    except DataError as error:
        raise error if f"'{path}'" in str(error) else DataError(f"'{path}': {error}") from None


def _opened(start: bytes, file_bytes: int, trust: bool, read: Callable[[int, int], bytes]) -> AnyFile:
    if not is_of_blocks(start):
        return PotrFile(container.read_header(start, file_bytes, trust), start)
    return BlockedFile(read_table(start, file_bytes, trust), read, partial(PotrFile.from_bytes, trust=trust), trust)


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
