"""The values of files of coder BUNDLES, bundle by bundle: :class:`BundledScene`.

Threads share the bundles out. Integers of a bundle become values while they are in a cache.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container
from potr_cl.codec.bundles.decoder import Reader, Wanted, check_said
from potr_cl.codec.bundles.layout import BUNDLE
from potr_cl.codec.bundles.levels import joined
from potr_cl.codec.bundles.sections import MAIN, Key
from potr_cl.codec.colour_factors import ColourFactors
from potr_cl.codec.container import Header
from potr_cl.codec.context.tokens import largest_integer
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.native.bundles import BEYOND_TABLE, BundledFile, Filling
from potr_cl.codec.native.library import native
from potr_cl.codec.native.values import Tables, ValueArrays
from potr_cl.codec.steps import prediction
from potr_cl.codec.steps.rule import CLASSES, ColourSteps, factors
from potr_cl.codec.versions import VERSIONS
from potr_cl.host.threads import Run, SharedWork, thread_pool

if TYPE_CHECKING:
    from potr_cl.codec.destination import Activation, BundleTaker, Destination

#: Bundles that NumPy decodes side by side.
_SIDE_BY_SIDE = 32
#: Bundles whose integers a thread joins at a time.
_HANDED = 4
#: Splats for each thread, so that one more pays.
SPLATS_A_THREAD = 3 * BUNDLE
#: The same where values are packed, which takes less memory.
_SPLATS_A_PACKING_THREAD = 3 * BUNDLE // 2
#: Threads that open sections and walk the octree before there are bundles to decode.
_OPENING = 3
#: Parts of the positions for each thread, so that none waits long for another.
_PARTS = 2
#: Levels whose values are looked up.
_TABLE = 1 << 16


@dataclass(frozen=True)
class BundledScene:
    """A file's splats.

    Attributes:
        header: verified.
        data: the whole file.
        open_steps: gives the steps of its colours.
        activation: what is stored instead of logarithms of scales and logits of opacities; None: these.
    """

    header: Header
    data: bytes
    open_steps: Callable[[], ColourSteps | None]
    activation: Activation | None = None

    @cached_property
    def reader(self) -> Reader:
        """Of the integers."""
        return Reader(self.header.splats, self._stored, self.open_steps)

    def _stored(self, key: Key) -> tuple[memoryview, str] | None:
        section = self.header.find(*key)
        return None if section is None else (container.stored_bytes(self.data, section), section.name)

    def fill(self, arrays: ValueArrays, threads: int = 1, centres: Callable[[Run, int], None] | None = None) -> None:
        """Fill some arrays; sections of others are not looked at.

        Args:
            arrays: what to decode.
            threads: to work with, this one included.
            centres: what else to do meanwhile; it is told how to share out work, and into how many parts.

        Raises:
            DataError: damaged.
        """
        self._share_out(lambda run: self._filling(arrays, run), threads, SPLATS_A_THREAD, centres)

    def pack(self, destination: BundleTaker, sh_count: int, threads: int, centres: Callable[[Run, int], None]) -> None:
        """Hand the values of all bundles to a destination, packed, with so many SH coefficients of a channel.

        Args:
            destination: it gets bundles as they are decoded, from all threads.
            threads, centres: as of :meth:`fill`.

        Raises:
            DataError: damaged, and what the destination raises.
        """
        destination.expect_bundles()
        self._share_out(
            lambda run: self._packing(destination, sh_count, run), threads, _SPLATS_A_PACKING_THREAD, centres
        )

    def _share_out(
        self,
        job_of: Callable[[Run], Job],
        threads: int,
        splats_a_thread: int,
        centres: Callable[[Run, int], None] | None,
    ) -> None:
        """Have threads do a job.

        Args:
            job_of: opens the sections, with a way to share that out, and says what is to be done with bundles.
            threads: this one included.
            splats_a_thread: with fewer, another thread does not pay.
            centres: as of :meth:`fill`.
        """
        work, number = SharedWork(), self.reader.bundles.number
        helpers = min(threads, max(self.header.splats // splats_a_thread, 2)) - 1
        if native() is None:  # others would wait for the interpreter, and take memory meanwhile
            helpers = 0
        first = []
        if centres is not None:
            first.append(work.add(partial(centres, work.run, _PARTS * (helpers + 1) if helpers else 1)))
        with thread_pool(max(helpers, 1)) as pool:
            try:
                if first:  # while this thread opens the sections
                    for _ in range(min(helpers, _OPENING)):
                        pool.submit(work.do)
                job = job_of(work.run if helpers else map)
                shares = [range(at, min(at + job.at_once, number)) for at in range(0, number, job.at_once)]
                futures = [work.add(partial(job, some)) for some in shares]
                for _ in range(helpers):
                    pool.submit(work.do)
                work.do()
                for future in [*futures, *first]:
                    future.result()
            finally:
                work.forget()

    def hand_to(self, destination: Destination, sh_count: int, threads: int) -> None:
        """Hand all integers but those of the centres to a destination, with so many SH coefficients of a channel.

        Raises:
            DataError: damaged.
        """
        wanted = self._wanted_of(sh_count, True)
        native = self.reader.bundled_file(wanted) is not None
        number, at_once = self.reader.bundles.number, _HANDED if native else _SIDE_BY_SIDE
        with thread_pool(threads if native else 1) as pool:
            parts = pool.map(
                lambda first: self.reader.levels(first, min(first + at_once, number), wanted),
                range(0, number, at_once),
            )
            levels = joined(list(parts))
        scales = [LevelStream(level, False) for level in levels.scales or []]
        opacities = LevelStream(levels.opacities if levels.opacities is not None else np.zeros(0), False)
        fitting = ColourFactors.of(self.header, self.reader.steps, lambda: [*scales], lambda: opacities)
        destination.take_scales(scales)
        destination.take_rotations([LevelStream(level, True) for level in levels.rotations or []], scales)
        destination.take_opacities(opacities)
        destination.take_colours([LevelStream(level, True) for level in levels.dc or []], 0, False, fitting)
        for coefficient in range(1, sh_count):
            planes = levels.coefficient(coefficient)
            destination.take_colours([LevelStream(level, True) for level in planes], coefficient, False, fitting)

    @cached_property
    def tables(self) -> Tables:
        """What makes values of levels."""
        header, activation = self.header, self.activation
        version = VERSIONS[header.version]
        levels = np.arange(self._largest_level(MAIN[1]) + 1)
        classes = np.arange(-CLASSES, CLASSES).astype(np.int8)
        scales = version.dequantize_scales(levels, header.sf_scale)
        opacities = version.dequantize_opacities(np.arange(self._largest_level(MAIN[0]) + 1), header.sf_opacity)
        return Tables(
            scales if activation is None else activation.scales(scales),
            opacities if activation is None else activation.opacities(opacities),
            factors(header.sf_dc, classes),
            factors(header.sf_ac, classes),
            *prediction.tables(),
            header.sf_rotation,
            activation is not None,
        )

    def _largest_level(self, key: Key) -> int:
        """Of a section, or the largest that is looked up."""
        section = self.reader.section(key)
        alphabets = [fitted.alphabet for fitted in section.streams] if section is not None else [1]
        return min(largest_integer(max(alphabets) - 1), _TABLE - 1)

    def _filling(self, arrays: ValueArrays, run: Run) -> Job:
        wanted = self._wanted(arrays)
        file = self.reader.bundled_file(wanted, run)
        if file is None:
            return Job(_SIDE_BY_SIDE, lambda bundles: self.by_numpy(bundles, wanted, arrays))
        fill = file.values(wanted.sections, wanted.rotations, arrays, self.tables)
        works = _Works(file)

        def decode(bundles: range) -> None:
            for bundle in bundles:
                if self.went_beyond(works.with_one(fill, bundle)):
                    self.by_numpy(range(bundle, bundle + 1), wanted, arrays)

        return Job(1, decode)

    def _packing(self, destination: BundleTaker, sh_count: int, run: Run) -> Job:
        wanted = self._wanted_of(sh_count, True)
        file = self.reader.bundled_file(wanted, run)
        if file is None:
            return Job(_SIDE_BY_SIDE, lambda bundles: self._pack_by_numpy(destination, sh_count, wanted, bundles))
        tables, works = self.tables, _Works(file)

        def decode(bundles: range) -> None:
            for bundle in bundles:
                with destination.room() as packed:
                    fill = file.packed(wanted.sections, wanted.rotations, packed, tables)
                    beyond = self.went_beyond(works.with_one(fill, bundle))
                    if not beyond:
                        destination.take_bundle(bundle * BUNDLE, packed, fill.items)
                if beyond:
                    self._pack_by_numpy(destination, sh_count, wanted, range(bundle, bundle + 1))

        return Job(1, decode)

    def went_beyond(self, said: tuple[int, int]) -> bool:
        """Whether the native path says of a bundle that its levels are beyond its tables.

        Raises:
            DataError: it says that the bundle is damaged.
        """
        if said[0] == BEYOND_TABLE:
            return True
        check_said(self.reader, *said)
        return False

    def _pack_by_numpy(self, destination: BundleTaker, sh_count: int, wanted: Wanted, bundles: range) -> None:
        start, stop = bundles.start * BUNDLE, min(bundles.stop * BUNDLE, self.header.splats)
        n = stop - start
        arrays = ValueArrays(
            np.empty((n, 3), np.float32),
            np.empty((n, 4), np.float32),
            np.empty(n, np.float32),
            np.empty((sh_count, 3, n), np.float32),
            begin=start,
        )
        self.by_numpy(bundles, wanted, arrays)
        for bundle in bundles:
            first = bundle * BUNDLE
            with destination.room() as packed:
                items = packed.take(arrays.part(first, min(first + BUNDLE, stop)))
                destination.take_bundle(first, packed, items)

    def by_numpy(self, bundles: range, wanted: Wanted, arrays: ValueArrays) -> None:
        """Fill arrays with the values of some bundles, which are decoded side by side.

        Raises:
            DataError: damaged.
        """
        header, activation = self.header, self.activation
        levels = self.reader.levels(bundles.start, bundles.stop, wanted)
        Dequantizer(header, VERSIONS[header.version]).of_levels(levels, self.reader.steps, arrays)
        own = arrays.part(levels.start, levels.stop)
        if activation is None:
            return
        if own.log_scales is not None:
            own.log_scales[...] = activation.scales(own.log_scales)
        if own.logits is not None:
            own.logits[...] = activation.opacities(own.logits)
        if own.quaternions is not None:
            own.quaternions[...] = activation.rotations(own.quaternions)

    def _wanted(self, arrays: ValueArrays) -> Wanted:
        rotations = arrays.quaternions is not None
        if arrays.sh is not None:
            return self._wanted_of(len(arrays.sh), rotations)
        return Wanted(2 if rotations or arrays.log_scales is not None else 1, rotations)

    def _wanted_of(self, sh_count: int, rotations: bool) -> Wanted:
        degree = round(sh_count**0.5) - 1
        # To the end of the chain where all is asked for: so its end is checked.
        return Wanted(len(MAIN) if degree == self.header.sh_degree else 3 + degree, rotations)


@dataclass(frozen=True)
class LevelStream:
    """Levels as a stream of integers.

    Attributes:
        levels: (n,) of any type.
        signed: whether they may be negative.
    """

    levels: NDArray[Any]
    signed: bool

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        """Those from one splat to another."""
        return self.levels[start:stop]

    @cached_property
    def joined(self) -> NDArray[Any]:
        """All of them: uint8, mapped to unsigned, where they are that small; else 32 or 64 bits each."""
        least, largest = int(self.levels.min()), int(self.levels.max())
        if not self.signed:
            return self.levels.astype(np.uint8 if largest < 1 << 8 else _wide(largest), copy=False)
        if least >= -(1 << 7) and largest < 1 << 7:
            narrow = self.levels.astype(np.int8)
            return ((narrow << 1) ^ (narrow >> 7)).view(np.uint8)
        return self.levels.astype(_wide(max(largest, -least)), copy=False)


def _wide(largest: int) -> type[np.generic]:
    return np.int32 if largest < 1 << 29 else np.int64


@dataclass(frozen=True)
class Job:
    """What is done with bundles, by any thread.

    Attributes:
        at_once: so many bundles.
        do: does it with some that follow each other; raises DataError where they are damaged.
    """

    at_once: int
    do: Callable[[range], None]

    def __call__(self, bundles: range) -> None:
        self.do(bundles)


class _Works:
    """What threads need to decode bundles: what one has worked with the next one takes."""

    def __init__(self, file: BundledFile) -> None:
        self._file = file
        self._free: list[NDArray[np.uint8]] = []

    def with_one(self, fill: Filling, bundle: int) -> tuple[int, int]:
        """What C says of a bundle, and the section at fault."""
        try:
            work = self._free.pop()
        except IndexError:
            work = self._file.work()
        said = fill(bundle, work)
        self._free.append(work)
        return said
