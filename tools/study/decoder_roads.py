"""Which road to a quick decoder: C that is compiled with the package, or OpenCL kernels? (:func:`compare`)

    python -m tools.bench.decode FILE.potr --part roads --device DEVICE …

Decoded are the tokens of a file's context coder, which is where most of a decode's time goes; the OpenCL kernels are
prototypes of the same arithmetic and their tokens are compared with the C library's. A decode that needs OpenCL pays
for a context and for loading its kernels too, in every process.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.codec import container, sections
from potr_cl.codec.context.lanes import Lanes
from potr_cl.codec.context.model import CHANNELS, HEAD, read_description
from potr_cl.codec.context.tokens import ALPHABET, SIZES
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.library import native
from potr_cl.codec.sections import Coder, Property
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from tools.results import Column, Results

Streams = list[NDArray[np.uint8]]

_FOLDER = Path(__file__).parent
_KERNELS = {f"roads/context_tokens_{family}.cl": _FOLDER / f"context_tokens_{family}.cl" for family in ("cpu", "gpu")}
_MOST_ITEMS = 1024


@dataclass
class Section:
    """A section of the context coder, ready to be decoded."""

    streams: int
    in_chain: bool
    weights: NDArray[np.int32]
    entries: list[NDArray[np.uint32]]
    classes: list[NDArray[np.uint8]]
    size_of: NDArray[np.int16]
    states: NDArray[np.uint32]
    words: NDArray[np.uint8]


def compare(results: Results, files: list[Path], devices: list[str], runs: int) -> None:
    """Measure all roads on all files."""
    table = results.table(
        "roads",
        "Tokens of the context coder, by the road taken; a fresh process pays for the context and the kernels too",
        Column("file"),
        Column("tokens", format=","),
        Column("road"),
        Column("on"),
        Column("context", "ms", ".0f"),
        Column("loading kernels", "ms", ".0f"),
        Column("decoding, best", "ms", ".1f"),
        Column("a token", "ns", ".2f"),
        Column("least processor time", "ms", ".1f"),
    )
    functions = native()
    if functions is None:
        raise SystemExit("the compiled library is not there: python -m tools.make.native")
    for path in files:
        file = open_file(path)
        lanes = Lanes(file.header.splats)
        parts = list(_sections(file, functions, lanes))
        tokens = file.header.splats * sum(part.streams for part in parts)

        def row(
            road: str, on: str, context: float | None, loading: float | None, best: tuple[float, float],
            path: Path = path, tokens: int = tokens,
        ) -> None:  # fmt: skip
            table.add(
                path.stem, tokens, road, on, _ms(context), _ms(loading), round(1e3 * best[0], 2),
                round(1e9 * best[0] / tokens, 3), round(1e3 * best[1], 2),
            )  # fmt: skip

        wanted, best = _timed(lambda: _by_c(functions, parts, lanes), runs)  # noqa: B023
        row("C", "one core", None, None, best)
        for name in devices:
            for family in _families(name):
                began = time.perf_counter()
                device = Device(name, family=family, variants=_KERNELS)
                context = time.perf_counter() - began
                began = time.perf_counter()
                road = _OpenCL(device, lanes, parts)
                loading = time.perf_counter() - began
                found, best = _timed(road.decode, runs)
                for mine, theirs in zip(found, wanted, strict=True):
                    for step, count in enumerate(lanes.counts):
                        if not np.array_equal(mine[step, :count], theirs[step, :count]):
                            raise SystemExit(f"{device.info} decodes other tokens than the C library")
                row(f"OpenCL, family {family}", str(device.info), context, loading, best)


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(1e3 * seconds, 1)


def _families(device: str) -> list[Family]:
    return ["gpu"] if Device(device).info.kind == "gpu" else ["cpu", "gpu"]


def _timed(
    work: Callable[[], list[NDArray[np.uint8]]], runs: int
) -> tuple[list[NDArray[np.uint8]], tuple[float, float]]:
    """What a work gives; the least wall time and the least processor time that it takes, seconds."""
    result = work()
    wall, used = [], []
    for _ in range(runs):
        began, had = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - began)
        used.append(time.process_time() - had)
    return result, (min(wall), min(used))


def _sections(file: PotrFile, functions: Functions, lanes: Lanes) -> Iterator[Section]:
    for section in sorted(file.blocks[0].sections, key=lambda section: (section.kind, section.index)):
        if section.coder != Coder.CONTEXT:
            continue
        stored = container.stored_bytes(file.data, section)
        described, beside = HEAD.unpack_from(stored)
        start = HEAD.size + described
        weights, models = read_description(stored[HEAD.size : start], section.streams, section.name)
        start += beside
        size_of = np.zeros(256, np.int16)
        size_of[:ALPHABET] = SIZES[sections.is_signed(section.kind)]
        yield Section(
            section.streams,
            section.kind == Property.SH and section.index > 0,
            weights,
            [functions.context_table(model.frequencies) for model in models],
            [model.classes for model in models],
            size_of,
            np.frombuffer(stored[start : start + 4 * lanes.number], "<u4").astype(np.uint32),
            np.frombuffer(stored[start + 4 * lanes.number :], np.uint8),
        )


def _by_c(functions: Functions, parts: list[Section], lanes: Lanes) -> list[NDArray[np.uint8]]:
    """Tokens of all streams."""
    shape = (lanes.steps, lanes.number)
    found, chain = [], [np.zeros(shape, np.int16) for _ in range(CHANNELS)]
    for part in parts:
        sums = chain if part.in_chain else [np.zeros(shape, np.int16) for _ in range(CHANNELS)]
        states, read, same = part.states.copy(), 0, [np.empty(shape, np.int16) for _ in range(CHANNELS)]
        for s in range(part.streams):
            c = s % CHANNELS
            tokens = np.empty(shape, np.uint8)
            taken = functions.context_stream(
                part.words, read, states, part.entries[c], part.classes[c], part.size_of, [*sums, *same[:c]],
                part.weights[s], lanes.counts, tokens, same[c],
            )  # fmt: skip
            assert taken is not None
            read = taken
            found.append(tokens)
            if c == CHANNELS - 1:
                for total, size in zip(sums, same, strict=True):
                    total += size
    return found


class _OpenCL:
    """The same on a device, tokens brought back; words and tables are in its memory before the clock starts."""

    def __init__(self, device: Device, lanes: Lanes, parts: list[Section]) -> None:
        self._device, self._lanes, self._parts = device, lanes, parts
        gpu = device.family == "gpu"
        self._items = 1
        while gpu and self._items < min(lanes.number, _MOST_ITEMS, device.info.max_work_group):
            self._items *= 2
        macros = {"ITEMS": self._items, "LANES_OF_ITEM": -(-lanes.number // self._items)} if gpu else {}
        source = f"roads/context_tokens_{device.family}.cl"
        self._kernel = device.kernel(source, "context_tokens", **macros)
        self._add = device.kernel(source, "add_sizes", **macros)
        self._ready = [self._upload(part) for part in parts]

    def _upload(self, part: Section) -> dict[str, Any]:
        up = self._device.upload
        return {
            "words": up(part.words, "words"),
            "entries": [up(entries, "entries") for entries in part.entries],
            "bases": [up(classes.astype(np.uint32) * np.uint32(4096), "bases") for classes in part.classes],
            "size_of": up(part.size_of, "sizes"),
            "weights": [up(self._known_weights(part, s), "weights") for s in range(part.streams)],
        }

    @staticmethod
    def _known_weights(part: Section, s: int) -> NDArray[np.int32]:
        """Without those of channels that come later."""
        weights: NDArray[np.int32] = part.weights[s].copy()
        weights[CHANNELS + s % CHANNELS : -2] = 0
        return weights

    def decode(self) -> list[NDArray[np.uint8]]:
        """Tokens of all streams."""
        device, lanes = self._device, self._lanes
        shape = (lanes.steps, lanes.number)
        nothing = np.zeros(shape, np.int16)
        buffers: list[cl.Buffer] = []

        def up(array: NDArray[Any]) -> cl.Buffer:
            buffers.append(device.upload(array, "a section"))
            return buffers[-1]

        chain = [up(nothing) for _ in range(CHANNELS)]
        recent = up(np.zeros(lanes.number, np.int32))
        results = []
        for part, ready in zip(self._parts, self._ready, strict=True):
            sums = chain if part.in_chain else [up(nothing) for _ in range(CHANNELS)]
            same = [up(nothing) for _ in range(CHANNELS)]
            states, read = up(part.states), up(np.zeros(1, np.uint32))
            for s in range(part.streams):
                c = s % CHANNELS
                buffers.append(device.allocate(lanes.steps * lanes.number, "tokens"))
                results.append(buffers[-1])
                self._kernel.bind(
                    words=ready["words"], available=len(part.words) // 2, read=read, states=states, recent=recent,
                    lanes=lanes.number, steps=lanes.steps, splats=lanes.splats, entries=ready["entries"][c],
                    bases=ready["bases"][c], size_of=ready["size_of"], sum0=sums[0], sum1=sums[1], sum2=sums[2],
                    same0=same[0], same1=same[1], weights=ready["weights"][s], tokens=results[-1], sizes=same[c],
                )  # fmt: skip
                self._kernel.launch((self._items,), (self._items,))
                if c == CHANNELS - 1:
                    for total, sizes in zip(sums, same, strict=True):
                        self._add.bind(sums=total, sizes=sizes).launch((nothing.size,))
        device.queue.finish()
        found = [device.download(buffer, shape, np.uint8) for buffer in results]
        for buffer in buffers:
            device.free(buffer)
        return found
