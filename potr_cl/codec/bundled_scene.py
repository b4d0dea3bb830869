"""The values of files of coder BUNDLES, bundle by bundle: :class:`BundledScene`.

Threads share the bundles out. Integers of a bundle become values while they are in a cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import numpy as np

from potr_cl.codec import container
from potr_cl.codec.bundles.decoder import Reader, Wanted, check_said
from potr_cl.codec.bundles.sections import MAIN, Key
from potr_cl.codec.container import Header
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.native.bundles import BEYOND_TABLE, BundledFile, SceneArrays, Tables
from potr_cl.codec.versions import VERSIONS

#: Bundles that NumPy decodes side by side.
_SIDE_BY_SIDE = 64
#: Levels whose values are looked up.
_TABLE = 1 << 16


@dataclass(frozen=True)
class BundledScene:
    """A file's splats.

    Attributes:
        header: verified.
        data: the whole file.
    """

    header: Header
    data: bytes

    @cached_property
    def reader(self) -> Reader:
        """Of the integers."""
        return Reader(self.header.splats, self._stored)

    def _stored(self, key: Key) -> tuple[memoryview, str] | None:
        section = self.header.find(*key)
        return None if section is None else (container.stored_bytes(self.data, section), section.name)

    def jobs(self, arrays: SceneArrays, threads: int) -> list[Job]:
        """What fills some arrays, to be done by as many threads; their sections are looked at, and no others'.

        Raises:
            DataError: damaged.
        """
        wanted = self._wanted(arrays)
        file = self.reader.bundled_file(wanted)
        share = _Share(self.reader.bundles.number, 1 if file is not None else _SIDE_BY_SIDE)
        return [Job(self, arrays, wanted, file, share) for _ in range(threads if file is not None else 1)]

    def _wanted(self, arrays: SceneArrays) -> Wanted:
        rotations = arrays.quaternions is not None
        if arrays.sh is not None:
            degree = round(len(arrays.sh) ** 0.5) - 1
            # To the end of the chain where all is asked for: so its end is checked.
            return Wanted(len(MAIN) if degree == self.header.sh_degree else 3 + degree, rotations)
        return Wanted(2 if rotations or arrays.log_scales is not None else 1, rotations)


class _Share:
    """Gives every thread the next bundles."""

    def __init__(self, number: int, at_once: int) -> None:
        self._number, self._at_once = number, at_once
        self._next, self._lock = 0, Lock()

    def take(self) -> range:
        with self._lock:
            first = self._next
            self._next = min(first + self._at_once, self._number)
            return range(first, self._next)


@dataclass(frozen=True)
class Job:
    """A thread's part of a decode: calling it takes bundles until none are left."""

    scene: BundledScene
    arrays: SceneArrays
    wanted: Wanted
    file: BundledFile | None
    share: _Share

    def __call__(self) -> None:
        """Raises DataError if damaged."""
        work = None if self.file is None else self.file.work()
        while len(bundles := self.share.take()):
            if self.file is None or work is None:
                self._by_numpy(bundles)
                continue
            said, section = self.file.values(
                bundles.start, self.wanted.sections, self.wanted.rotations, work, self.arrays, self._tables
            )
            if said == BEYOND_TABLE:
                self._by_numpy(bundles)
            else:
                check_said(self.scene.reader, said, section)

    @cached_property
    def _tables(self) -> Tables:
        header = self.scene.header
        version = VERSIONS[header.version]
        levels = np.arange(_TABLE)
        return Tables(
            version.dequantize_scales(levels, header.sf_scale),
            version.dequantize_opacities(levels, header.sf_opacity),
            header.sf_rotation,
            header.sf_dc,
            header.sf_ac,
        )

    def _by_numpy(self, bundles: range) -> None:
        header = self.scene.header
        levels = self.scene.reader.levels(bundles.start, bundles.stop, self.wanted)
        Dequantizer(header, VERSIONS[header.version]).of_levels(levels, self.arrays)
