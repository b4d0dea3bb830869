"""The values of files whose integers stand stream by stream, of all coders but BUNDLES: :class:`SectionedScene`.

Threads share out the properties, and the SH coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, sections
from potr_cl.codec.byte_planes import IntegerStream, PlaneStream
from potr_cl.codec.colour_factors import ColourFactors, Once
from potr_cl.codec.container import Header
from potr_cl.codec.context.decoder import Reader, Stream
from potr_cl.codec.context.lanes import Lanes
from potr_cl.codec.context.model import Sizes
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.destination import Destination
from potr_cl.codec.native.library import native
from potr_cl.codec.sections import Coder, Property, Section
from potr_cl.codec.steps.rule import ColourSteps
from potr_cl.codec.versions import FormatVersion
from potr_cl.host.threads import Run, SharedWork, first_error, thread_pool

F32 = NDArray[np.float32]

#: Coefficients and other properties whose integers may wait for a thread to make values of them.
_MOST_WAITING = 6
#: Bytes of stored integers, for each splat, that all threads together may have unpacked: half a decoded splat.
_MOST_UNPACKED = 120
#: Splats for each thread, so that one more pays.
_SPLATS_A_THREAD = 24576


@dataclass(frozen=True)
class SectionedScene:
    """A file's splats but for their centres.

    Attributes:
        header: verified.
        data: the whole file.
        rules: of the file's version.
        open_steps: gives the steps of its colours.
    """

    header: Header
    data: bytes
    rules: FormatVersion
    open_steps: Callable[[], ColourSteps | None]

    def scales(self, out: F32) -> None:
        """(N, 3) natural logarithms of standard deviations. Raises DataError if damaged."""
        self._dequantizer.scales(self.streams(Property.SCALE), out)

    def rotations(self, out: F32) -> None:
        """(N, 4) unit quaternions w, x, y, z. Raises DataError if damaged."""
        scales = self.streams(Property.SCALE) if self.rules.rotations_need_scales else []
        self._dequantizer.rotations(self.streams(Property.ROTATION), scales, out)

    def opacities(self, out: F32) -> None:
        """(N,) logits. Raises DataError if damaged."""
        self._dequantizer.opacities(self.streams(Property.OPACITY)[0], out)

    def colours(self, destination: Destination, count: int) -> None:
        """Hand so many SH coefficients of a channel to a destination. Raises DataError if damaged."""
        for _, job in self._sh_jobs(destination, count, _Shared(self)):
            job(_now)

    def decode_into(
        self, destination: Destination, sh_count: int, threads: int, means: Callable[[Run, int], NDArray[np.float32]]
    ) -> None:
        """Hand everything to a destination.

        Args:
            destination: it has room for the SH coefficients that are wanted.
            sh_count: so many of a channel are.
            threads: to work with.
            means: finds the centres; told how to share out work, and into how many parts.

        Raises:
            DataError: damaged; and what the destination raises.
        """
        shared = _Shared(self)
        shapes: _Job = partial(self._decode_shapes, destination, shared)
        opacities: _Job = partial(self._decode_opacities, destination, shared)
        # The longest first: a pool that ends with a long one ends late.
        jobs = [
            *self._sh_jobs(destination, sh_count, shared),
            (self._contextual(Property.SCALE) or self._contextual(Property.ROTATION), shapes),
            (self._contextual(Property.OPACITY), opacities),
        ]
        threads = min(threads, self._threads_in_memory())
        # With fewer splats for each, threads wait for the interpreter, and for memory, longer than they decode.
        threads = min(threads, max(self.header.splats // _SPLATS_A_THREAD, 2))
        self._run(jobs, lambda run, parts: destination.take_means(means(run, parts)), threads)

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

    def streams(self, prop: Property, indices: range | None = None) -> list[IntegerStream]:
        """Some streams of one integer a splat, all of a property's by default."""
        indices = range(sections.stream_count(prop)) if indices is None else indices
        section = self.header.find(prop, indices[0])
        if section is not None and section.coder == Coder.CONTEXT:
            return list(self._context_streams(section))
        signed, splats = sections.is_signed(prop), self.header.splats
        return [
            PlaneStream(
                container.raw_bytes(self.header, self.data, prop, index), self._planes(prop, index), signed, splats
            )
            for index in indices
        ]

    @property
    def _dequantizer(self) -> Dequantizer:
        return Dequantizer(self.header, self.rules)

    def _decode_shapes(self, destination: Destination, shared: _Shared, submit: _Submit) -> None:
        scales = shared.scales.get()
        submit(partial(destination.take_scales, scales))
        submit(partial(destination.take_rotations, self.streams(Property.ROTATION), scales))

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
        streams = self.streams(Property.SH, range(3 * m, 3 * m + 3))
        differences = m == 0 and not self.rules.colour_steps and not self._contextual(Property.SH)
        submit(partial(_take_colours, destination, streams, m, differences, shared))


class _Shared:
    """What more than one of a file's properties is made of; any thread may ask for it.

    Args:
        scene: that is decoded.

    Attributes:
        scales, opacities: their streams.
        factors: what colours are made with.
    """

    def __init__(self, scene: SectionedScene) -> None:
        self.scales = Once(lambda: scene.streams(Property.SCALE))
        self.opacities = Once(lambda: scene.streams(Property.OPACITY)[0])
        self.factors = Once(self._find_factors)
        self._scene = scene

    def _find_factors(self) -> ColourFactors:
        header, steps = self._scene.header, self._scene.open_steps()
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
