"""What is the time of a decode made of, part by part?

    python -m tools.bench.decode_parts FILE.potr … [--runs R] [--json FILE]

Decodes in this process with one thread, by the native path, with a clock around each part that Python calls; the time
of a part is without those of the parts that it calls. Of files of coder BUNDLES the sections are told apart by decoding
bundles to the end of one section and of the next, and their values by decoding with and without them. Memory is told
apart by decoding to arrays that were written to before. Each figure is the least of R runs.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from potr_cl.codec import container, dequantizer
from potr_cl.codec.block_values import BlockValues
from potr_cl.codec.bundles import sections
from potr_cl.codec.bundles.decoder import Wanted
from potr_cl.codec.decoder import open_file
from potr_cl.codec.destination import SceneArrays
from potr_cl.codec.native.bundles import BundledFile
from potr_cl.codec.native.library import VARIABLE, native
from potr_cl.codec.native.octree import OctreeFunctions, Walk
from potr_cl.codec.native.share import BundleShare
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.sections import Coder
from tools.results import Column, Results

#: What a clock is put around: where it is, its name there, what the table calls it.
_CLOCKS: tuple[tuple[Any, str, str], ...] = (
    (container, "read_header", "header"),
    (container, "read_section", "other sections: checksum, zstd"),
    (container, "stored_bytes", "sections of bundles: checksum"),
    (sections, "read_description", "descriptions of contexts"),
    (BundledFile, "__init__", "tables of contexts"),
    (BundleShare, "do", "bundles to values"),
    (OctreeFunctions, "tree", "octree: levels"),
    (Walk, "__init__", "octree: parts"),
    (Walk, "leaves", "octree: leaves"),
    (Walk, "centres", "octree: centres"),
    (dequantizer, "fill", "values by NumPy"),
)
#: Of bundles: parts of the chain, by the section that they end with.
_CHAIN = ("opacities", "scales", "steps and DC", "AC of degree 1", "AC of degree 2", "AC of degree 3")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--runs", type=int, default=9, metavar="R", help="of each; default 9")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    os.environ[VARIABLE] = "1"
    parts(Results(None, args.json), args.files, args.runs)


def parts(results: Results, files: list[Path], runs: int) -> None:
    """Print the table."""
    table = results.table(
        "parts",
        "A decode by the native path with one thread, part by part",
        Column("file"),
        Column("part"),
        Column("time", "ms", ".2f"),
        Column("a splat", "ns", ".1f"),
    )
    for path in files:
        data = path.read_bytes()
        splats = open_file(data, trust=True).header.splats
        found = {**_clocked(data, runs), **_of_bundles(data, runs)}
        for part, seconds in found.items():
            table.add(path.stem, part, round(1e3 * seconds, 3), round(1e9 * seconds / splats, 2))


def _clocked(data: bytes, runs: int) -> dict[str, float]:
    """Of whole decodes."""
    least: dict[str, float] = {}
    for _ in range(runs):
        times: dict[str, float] = {}
        with _clocks(times):
            began = time.perf_counter()
            open_file(data, trust=True).scene(threads=1)
            times["the whole, with clocks"] = time.perf_counter() - began
        times["all else"] = times["the whole, with clocks"] - sum(
            seconds for part, seconds in times.items() if part != "the whole, with clocks"
        )
        least = {part: min(seconds, least.get(part, seconds)) for part, seconds in times.items()}
    bare = _least(lambda: open_file(data, trust=True).scene(threads=1), runs)
    return {**least, "the whole": bare}


@contextmanager
def _clocks(times: dict[str, float]) -> Iterator[None]:
    """Put a clock around each part; its time is added up without that of the parts within."""
    within: list[float] = []

    def clocked(work: Callable[..., Any], part: str) -> Callable[..., Any]:
        def run(*args: Any, **keywords: Any) -> Any:
            within.append(0.0)
            began = time.perf_counter()
            try:
                return work(*args, **keywords)
            finally:
                spent = time.perf_counter() - began
                times[part] = times.get(part, 0.0) + spent - within.pop()
                if within:
                    within[-1] += spent

        return run

    with ExitStack() as stack:
        for owner, name, part in _CLOCKS:
            work = vars(owner).get(name)
            if callable(work):
                stack.enter_context(patch.object(owner, name, clocked(work, part)))
        yield


def _of_bundles(data: bytes, runs: int) -> dict[str, float]:
    """Parts of the bundles of a file; nothing for files of other coders."""
    body = open_file(data, trust=True).body(0)
    block = body.block
    if block.coder != Coder.BUNDLES:
        return {}
    scene = BlockValues(block, body.data, body.colour_steps)
    count = body.sh_count()
    destination = SceneArrays(block, count)
    tables, bundles, functions = scene.tables, scene.reader.bundles.number, native()
    assert functions is not None

    def decoded(sections: int, rotations: bool, arrays: ValueArrays) -> Callable[[], None]:
        opened = scene.reader.bundled_file(Wanted(sections, rotations))
        assert opened is not None

        def run() -> None:
            share = functions.bundle_share(bundles)
            share.open(opened, sections, rotations, arrays, tables)
            share.do()

        return run

    nothing, everything = ValueArrays(), destination.values
    assert everything.sh is not None
    last = round(count**0.5) + 2
    of: dict[str, float] = {}
    before = 0.0
    for number in range(1, last + 1):
        seconds = _least(decoded(number, False, nothing), runs)
        of[f"integers: {_CHAIN[number - 1]}"] = seconds - before
        before = seconds
    scales = _least(decoded(2, False, nothing), runs)
    of["integers: rotations"] = _least(decoded(2, True, nothing), runs) - scales
    decoded(last, True, everything)()
    written = _least(decoded(last, True, everything), runs)
    of["values, to memory that was written to before"] = written - before - of["integers: rotations"]

    def fresh() -> None:
        arrays = SceneArrays(block, count)
        decoded(last, True, arrays.values)()

    of["memory that was not"] = _least(fresh, runs) - written

    def touched() -> None:
        np.empty(everything.sh.size if everything.sh is not None else 0, np.float32).fill(0)

    of["filling as much fresh memory as SH coefficients take"] = _least(touched, runs)
    return of


def _least(work: Callable[[], Any], runs: int) -> float:
    times = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times[1:])


if __name__ == "__main__":
    main()
