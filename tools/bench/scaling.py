"""Time and memory of an encode against splats, views and workers, with the exponents that fit them.

    python -m tools.bench.scaling SCENE … [--splats N …] [--views N …] [--workers N …] [--size WxH]
        [--limit S] [--json FILE]

Cities of the scenes (tools.make.city) are encoded, each in a process of its own; those of one size one after the other,
so that one city at a time lies on the disk. One number at a time is varied, the
others have the middle ones of theirs. Workers are the devices that are there, the first so many; where there are fewer,
the first is opened several times, which says what sharing out costs and not what it brings. Peaks are the kernel's
figure of the process (Linux only), on CPU devices less the device's memory, which is the host's; and what was
allocated on all devices at most. Each figure y is fitted by

    y = constant · splats^a · views^b · workers^c

Prints Markdown; --json keeps the figures.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.workers.host import HostPool
from tools.make.city import City, building_of, write_cameras, write_city
from tools.results import Column, Results
from tools.workloads import growth, in_process, plain_parser, resident

#: What is fitted, with what the table calls it, and the numbers that it is fitted with.
FIGURES = {
    "seconds": "time",
    "pruning": "pruning",
    "refit": "re-fit",
    "host": "host peak",
    "device": "device peak",
    "left": "splats left",
}
NUMBERS = ("splats", "views", "workers")


@dataclasses.dataclass(frozen=True)
class Point:
    """One encode.

    Attributes:
        splats, views, workers: of it.
        seconds: of the encode alone.
        host, device: peaks, bytes.
        left: splats in the file.
        stages: seconds by stage.
    """

    splats: int
    views: int
    workers: int
    seconds: float = 0.0
    host: float = 0.0
    device: float = 0.0
    left: int = 0
    stages: dict[str, float] = dataclasses.field(default_factory=dict)

    def of(self, *stages: str) -> float:
        """Seconds of some stages."""
        return sum(self.stages.get(stage, 0.0) for stage in stages)

    @property
    def pruning(self) -> float:
        """Seconds of preparing views and of pruning."""
        return self.of("prepare views", "prune")

    @property
    def refit(self) -> float:
        """Seconds of the re-fit."""
        return self.of("refit")


def devices(workers: int) -> list[Device]:
    """So many opened devices: the best one, others of its name, and it again where there are no more."""
    first = Device()
    others = [info for info in list_devices() if info.name == first.info.name and info != first.info]
    return [first, *(Device(others[n]) if n < len(others) else Device(first.info) for n in range(workers - 1))]


def measure(point: Point, folder: Path, rounds: int | None, memory: float | None) -> Point:
    """The encode of a city that lies in a folder, in this process."""
    scene, cameras = load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")
    opened = devices(point.workers)
    options = EncodeOptions.for_preset("best", between=False)
    options = dataclasses.replace(options, cameras_anyway=True)
    if rounds is not None:
        options = options.changed(prune={"iterations": rounds})
    if memory is not None:
        options = options.changed(memory=int(memory * 2**30))
    taken = 0

    def progress(_stage: str, _done: float) -> None:
        nonlocal taken
        taken = max(taken, sum(device.allocated for device in opened))

    pool = HostPool(opened) if point.workers > 1 else None
    before, began = resident("VmRSS"), time.perf_counter()
    encoded: Any = None

    def work() -> None:
        nonlocal encoded
        encoded = encode(scene, train_views(cameras), options, progress, opened[0], pool=pool)

    host = before + growth(work) - (taken if opened[0].info.kind == "cpu" else 0)
    seconds = time.perf_counter() - began
    return dataclasses.replace(
        point, seconds=seconds, host=host, device=taken, left=len(encoded.order), stages=encoded.seconds
    )


def points(splats: Sequence[int], views: Sequence[int], workers: Sequence[int]) -> list[Point]:
    """Those to measure, by splats: of each number all values, with the middle ones of the others."""
    middle = [sorted(each)[(len(each) - 1) // 2] for each in (splats, views, workers)]
    keys = [(n, middle[1], middle[2]) for n in splats]
    keys += [(middle[0], n, middle[2]) for n in views]
    keys += [(middle[0], middle[1], n) for n in workers]
    return [Point(*key) for key in sorted(dict.fromkeys(keys), key=lambda key: key[0])]


def exponents(measured: Sequence[Point], figure: str) -> tuple[dict[str, float], float]:
    """The exponents that fit a figure, of the numbers that vary, and the largest relative deviation."""
    varied = [name for name in NUMBERS if len({getattr(point, name) for point in measured}) > 1]
    columns = [np.ones(len(measured)), *(np.log([getattr(p, name) for p in measured]) for name in varied)]
    terms, wanted = np.stack(columns, axis=1), np.log([getattr(p, figure) for p in measured])
    found = np.linalg.lstsq(terms, wanted, rcond=None)[0]
    deviation = float(np.abs(np.exp(terms @ found - wanted) - 1).max())
    return dict(zip(varied, found[1:].tolist(), strict=True)), deviation


def measured_in_turn(wanted: Sequence[Point], scenes: Sequence[str], args: argparse.Namespace) -> Iterator[Point]:
    """Encode each point's city in a process of its own; after so many seconds none is begun any more."""
    width, height = map(int, args.size.split("x"))
    began = time.monotonic()
    buildings = [building_of(scene) for scene in scenes]
    for splats, alike in groupby(wanted, key=lambda point: point.splats):
        with tempfile.TemporaryDirectory() as name:
            folder, city, written = Path(name), City(buildings, splats), False
            for point in alike:
                if args.limit is not None and time.monotonic() - began > args.limit:
                    return
                views = city.views(point.views, width, height)
                if written:
                    write_cameras(folder, views)
                else:
                    write_city(folder, city, views)
                    written = True
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
    table = results.table(
        "points", f"Encodes of cities, views of {args.size}, preset best without views between",
        "splats||,.0f; views||.0f; workers||.0f; time|s|.1f; pruning|s|.1f; re-fit|s|.1f; coding|s|.1f; "
        "host peak|GB|.2f; device peak|GB|.2f; splats left||,.0f",
    )  # fmt: skip
    measured = []
    wanted = points([int(n) for n in args.splats], args.views, args.workers)
    for found in measured_in_turn(wanted, args.scenes, args):
        measured.append(found)
        table.add(
            found.splats, found.views, found.workers, found.seconds, found.pruning, found.refit,
            found.of("octree", "quantise and code"),
            found.host / 1e9, found.device / 1e9, found.left,
        )  # fmt: skip
    fitted = results.table(
        "exponents", "Exponents that fit them",
        "figure", *(Column(name, format=".2f") for name in NUMBERS), "largest deviation|%|.0f",
    )  # fmt: skip
    for figure, called in FIGURES.items():
        powers, deviation = exponents(measured, figure)
        fitted.add(called, *(powers.get(name) for name in NUMBERS), 100 * deviation)


if __name__ == "__main__":
    main()
