"""The values of files of coder BUNDLES, bundle by bundle: :class:`BundledScene`.

Threads share the bundles out. Integers of a bundle become values while they are in a cache.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
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
from potr_cl.codec.native.bundles import BEYOND_TABLE, BundledFile, Tables, ValueArrays
from potr_cl.codec.native.library import native
from potr_cl.codec.steps import prediction
from potr_cl.codec.steps.rule import CLASSES, ColourSteps, factors
from potr_cl.codec.versions import VERSIONS
from potr_cl.host.threads import Run, SharedWork, thread_pool

if TYPE_CHECKING:
    from potr_cl.codec.destination import Activation, Destination

#: Bundles that NumPy decodes side by side.
_SIDE_BY_SIDE = 32
#: Bundles whose integers a thread joins at a time.
_HANDED = 4
#: Splats for each thread, so that one more pays.
SPLATS_A_THREAD = 3 * BUNDLE
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

    def fill(
        self,
        arrays: ValueArrays,
        threads: int = 1,
        centres: Callable[[Run, int], None] | None = None,
        filled: Callable[[int, int], None] | None = None,
    ) -> None:
        """Fill some arrays; sections of others are not looked at.

        Args:
            arrays: what to decode.
            threads: to work with, this one included.
            centres: what else to do meanwhile; it is told how to share out work, and into how many parts.
            filled: told from one splat to another which values are there, by this thread; others decode meanwhile.

        Raises:
            DataError: damaged.
        """
        work, number = SharedWork(), self.reader.bundles.number
        # With fewer bundles for each, threads wait for the interpreter, and for memory, longer than they decode.
        helpers = min(threads, max(self.header.splats // SPLATS_A_THREAD, 2)) - (filled is None)
        if native() is None:  # others would wait for the interpreter, and take memory meanwhile
            helpers = 0
        first = []
        if centres is not None:
            first.append(work.add(partial(centres, work.run, _PARTS * helpers if helpers else 1)))
        with thread_pool(max(helpers, 1)) as pool:
            try:
                if helpers and first:  # while this thread opens the sections
                    pool.submit(work.do)
                job = self._job(arrays)
                shares = job.shares(number)
                if job.file is None:
                    work.do()
                    self._one_by_one(job, shares, filled or _nobody)
                    shares = []
                futures = [work.add(partial(job, some)) for some in shares]
                for _ in range(helpers if shares else 0):
                    pool.submit(work.do)
                if filled is None:
                    work.do()
                self._tell(shares, futures, filled or _nobody)
                for future in first:
                    future.result()
            finally:
                work.forget()

    def _one_by_one(self, job: Job, shares: list[range], filled: Callable[[int, int], None]) -> None:
        for bundles in shares:
            job(bundles)
            filled(bundles.start * BUNDLE, min(bundles.stop * BUNDLE, self.header.splats))

    def _tell(self, shares: list[range], futures: list[Future[None]], filled: Callable[[int, int], None]) -> None:
        """Wait for shares of the bundles, and tell of all that are done at a time."""
        ready = done = 0
        while done < len(futures):
            futures[done].result()
            while done < len(futures) and futures[done].done() and futures[done].exception() is None:
                done += 1
            stop = min(shares[done - 1].stop * BUNDLE, self.header.splats)
            filled(ready, stop)
            ready = stop

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

    def _job(self, arrays: ValueArrays) -> Job:
        wanted = self._wanted(arrays)
        file = self.reader.bundled_file(wanted)
        if file is not None:
            _ = self.tables  # made once, before threads ask for them
        return Job(self, arrays, wanted, file)

    def _wanted(self, arrays: ValueArrays) -> Wanted:
        rotations = arrays.quaternions is not None
        if arrays.sh is not None:
            return self._wanted_of(len(arrays.sh), rotations)
        return Wanted(2 if rotations or arrays.log_scales is not None else 1, rotations)

    def _wanted_of(self, sh_count: int, rotations: bool) -> Wanted:
        degree = round(sh_count**0.5) - 1
        # To the end of the chain where all is asked for: so its end is checked.
        return Wanted(len(MAIN) if degree == self.header.sh_degree else 3 + degree, rotations)


def _nobody(start: int, stop: int) -> None:
    """Is told which values are there."""


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
    """What decodes bundles, by any thread."""

    scene: BundledScene
    arrays: ValueArrays
    wanted: Wanted
    file: BundledFile | None
    _works: list[NDArray[np.uint8]] = field(default_factory=list)

    def shares(self, number: int) -> list[range]:
        """The bundles of a file, as they are decoded at a time."""
        at_once = 1 if self.file is not None else _SIDE_BY_SIDE
        return [range(first, min(first + at_once, number)) for first in range(0, number, at_once)]

    def __call__(self, bundles: range) -> None:
        """Decode one of the shares.

        Raises:
            DataError: damaged.
        """
        if self.file is None:
            self._by_numpy(bundles)
            return
        # What a thread has worked with the next one takes.
        work = self._works.pop() if self._works else self.file.work()
        said, section = self.file.values(
            bundles.start, self.wanted.sections, self.wanted.rotations, work, self.arrays, self.scene.tables
        )
        self._works.append(work)
        if said == BEYOND_TABLE:
            self._by_numpy(bundles)
        else:
            check_said(self.scene.reader, said, section)

    def _by_numpy(self, bundles: range) -> None:
        header = self.scene.header
        levels = self.scene.reader.levels(bundles.start, bundles.stop, self.wanted)
        Dequantizer(header, VERSIONS[header.version]).of_levels(levels, self.scene.reader.steps, self.arrays)
        activation, own = self.scene.activation, self.arrays.part(levels.start, levels.stop)
        if activation is None:
            return
        if own.log_scales is not None:
            own.log_scales[...] = activation.scales(own.log_scales)
        if own.logits is not None:
            own.logits[...] = activation.opacities(own.logits)
        if own.quaternions is not None:
            own.quaternions[...] = activation.rotations(own.quaternions)
