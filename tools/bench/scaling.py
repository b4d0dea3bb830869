"""Time and memory of an encode against splats, views and workers, with the exponents that fit them.

    python -m tools.bench.scaling SCENE … [--splats N …] [--views N …] [--workers N …] [--size WxH]
        [--limit S] [--json FILE]

Cities of the scenes (tools.make.city) are encoded, each in a process of its own; those of one size one after the other,
so that one city at a time lies on the disk. One number at a time is varied, the others have the middle ones of theirs.
Workers are the devices that are there, the first so many; where there are fewer, the first is opened several times,
which says what sharing out costs and not what it brings. Peaks are the kernel's figure of the process (Linux only), on
CPU devices less the device's memory, which is the host's; and what was allocated on all devices at most. Each figure y
is fitted by

    y = constant · splats^a · views^b · workers^c
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.workers.host import HostPool
from tools.make.city import City, building_of, write_cameras, write_city
from tools.results import Column, Results
from tools.workloads import growth, in_process, plain_parser, read, resident

#: What is varied, and what is fitted with it.
NUMBERS = ("splats", "views", "workers")
FIGURES = ("time", "pruning", "re-fit", "host peak", "device peak", "splats left")
#: Columns of an encode: names, and their units and formats.
_COLUMNS = (
    "splats||,.0f; views||.0f; workers||.0f; time|s|.1f; pruning|s|.1f; re-fit|s|.1f; coding|s|.1f; "
    "host peak|GB|.2f; device peak|GB|.2f; splats left||,.0f"
)
#: Splats, views, workers.
Point = tuple[int, int, int]
#: An encode's figures by the names of the columns.
Row = dict[str, float]


def devices(workers: int) -> list[Device]:
    """So many opened devices: the best one, others of its name, and it again where there are no more."""
    first = Device()
    others = [info for info in list_devices() if info.name == first.info.name and info != first.info]
    return [first, *(Device(others[n]) if n < len(others) else Device(first.info) for n in range(workers - 1))]


def measure(point: Point, folder: Path, rounds: int | None, memory: float | None) -> Row:
    """The encode of a city that lies in a folder, in this process."""
    scene, cameras = read(folder)
    opened = devices(point[2])
    options = dataclasses.replace(EncodeOptions.for_preset("best", between=False), cameras_anyway=True)
    if rounds is not None:
        options = options.changed(prune={"iterations": rounds})
    if memory is not None:
        options = options.changed(memory=int(memory * 2**30))
    taken, done = 0, list[Encoded]()

    def progress(_stage: str, _done: float) -> None:
        nonlocal taken
        taken = max(taken, sum(device.allocated for device in opened))

    pool = HostPool(opened) if point[2] > 1 else None
    before, began = resident("VmRSS"), time.perf_counter()
    grown = growth(lambda: done.append(encode(scene, train_views(cameras), options, progress, opened[0], pool=pool)))
    seconds = time.perf_counter() - began
    host = before + grown - (taken if opened[0].info.kind == "cpu" else 0)

    def of(*stages: str) -> float:
        return sum(done[0].seconds.get(stage, 0.0) for stage in stages)

    return {
        **dict(zip(NUMBERS, point, strict=True)), "time": seconds, "pruning": of("prepare views", "prune"),
        "re-fit": of("refit"), "coding": of("octree", "entropy coding"), "host peak": host / 1e9,
        "device peak": taken / 1e9, "splats left": len(done[0].order),
    }  # fmt: skip


def points(splats: Sequence[int], views: Sequence[int], workers: Sequence[int]) -> list[Point]:
    """Those to measure, by splats: of each number all values, with the middle ones of the others."""
    a, b, c = (sorted(each)[(len(each) - 1) // 2] for each in (splats, views, workers))
    keys = [*((n, b, c) for n in splats), *((a, n, c) for n in views), *((a, b, n) for n in workers)]
    return sorted(dict.fromkeys(keys), key=lambda key: key[0])


def exponents(measured: Sequence[Mapping[str, float]], figure: str) -> tuple[dict[str, float], float]:
    """The exponents that fit a figure, of the numbers that vary, and the largest relative deviation."""
    varied = [name for name in NUMBERS if len({row[name] for row in measured}) > 1]
    columns = [np.ones(len(measured)), *(np.log([row[name] for row in measured]) for name in varied)]
    terms, wanted = np.stack(columns, axis=1), np.log([row[figure] for row in measured])
    found = np.linalg.lstsq(terms, wanted, rcond=None)[0]
    deviation = float(np.abs(np.exp(terms @ found - wanted) - 1).max())
    return dict(zip(varied, found[1:].tolist(), strict=True)), deviation


def measured_in_turn(wanted: Sequence[Point], scenes: Sequence[str], args: argparse.Namespace) -> Iterator[Row]:
    """Encode each point's city in a process of its own; after so many seconds none is begun any more."""
    width, height = map(int, args.size.split("x"))
    began = time.monotonic()
    buildings = [building_of(scene) for scene in scenes]
    for splats, alike in groupby(wanted, key=lambda point: point[0]):
        with tempfile.TemporaryDirectory() as name:
            folder, city = Path(name), City(buildings, splats)
            for number, point in enumerate(alike):
                if args.limit is not None and time.monotonic() - began > args.limit:
                    return
                views = city.views(point[1], width, height)
                if number:
                    write_cameras(folder, views)
                else:
                    write_city(folder, city, views)
                yield in_process(measure, point, folder, args.iterations, args.memory)


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="as of tools.make.city")
    parser.add_argument("--splats", type=float, nargs="+", default=[1e6, 2e6, 4e6], metavar="N")
    parser.add_argument("--views", type=int, nargs="+", default=[50, 100, 200], metavar="N")
    parser.add_argument("--workers", type=int, nargs="+", default=[1], metavar="N")
    parser.add_argument("--size", default="1600x1064", metavar="WxH")
    parser.add_argument("--iterations", type=int, metavar="N", help="of pruning; default: the preset's")
    parser.add_argument("--memory", type=float, metavar="GB", help="as encode's")
    parser.add_argument("--limit", type=float, metavar="S", help="begin no encode after so many seconds")
    args = parser.parse_args()
    results = Results(Device().info, args.json)
    title = f"Encodes of cities, views of {args.size}, preset best without views between"
    table, measured = results.table("points", title, _COLUMNS), []
    for row in measured_in_turn(points([int(n) for n in args.splats], args.views, args.workers), args.scenes, args):
        measured.append(row)
        table.add(*row.values())
    fitted = results.table(
        "exponents", "Exponents that fit them",
        "figure", *(Column(name, format=".2f") for name in NUMBERS), "largest deviation|%|.0f",
    )  # fmt: skip
    for figure in FIGURES:
        powers, deviation = exponents(measured, figure)
        fitted.add(figure, *(powers.get(name) for name in NUMBERS), 100 * deviation)


if __name__ == "__main__":
    main()
