"""Time and memory of whole commands against splats, views and devices: by part, fitted, and foretold for more devices.

    python -m tools.bench.scaling SCENE … [--cities SPLATSxVIEWS …] [--devices N …] [--encode OPTIONS] [--size WxH]
        [--limit S] [--json FILE]

Each city of the scenes (tools.make.city) is encoded by the first so many devices of the best one's kind, in a process
of its own, and judged by ten test views. The host's peak is of that process; on CPUs the device's memory is in it. GPU
figures are nvidia-smi's, twice a second: how busy the devices are on the average, and the fullest one's memory. Two
files are the same if the first digits of their SHA-256 are. Each figure y is fitted by

    y = constant · splats^a · views^b · devices^c

and the time of a city on n devices is foretold from the two smallest numbers of devices as

    t(n) = a + b / n + x (n - 1)

where a is what one device or the host does, b what is shared out, and x what one more device sends to the first one,
through the host, in seconds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby, product
from pathlib import Path

import numpy as np

from potr_cl.errors import DeviceError
from potr_cl.opencl.discovery import choose_device, choose_devices
from tools.make.city import City, building_of, write_city
from tools.results import Column, Results
from tools.workloads import log, plain_parser

#: What is varied, and what is fitted with it.
NUMBERS = ("splats", "views", "devices")
FIGURES = ("all", "pruning", "re-fit", "host peak", "splats left")
_SENT = "sent to the first"
#: The parts of a command by the stages that the encoder times; the rest is the first one.
PARTS: Mapping[str, Sequence[str]] = {
    "start, reading, proof": (),
    "views between": ("views between",),
    "preparing": ("prepare views",),
    "pruning": ("prune",),
    "re-fit": ("refit",),
    "fit": ("fit",),
    "coding": ("octree", "entropy coding"),
    "judging": ("evaluate",),
}
_COLUMNS = (
    "splats||,.0f; views||.0f; devices||.0f; all|s|.1f; "
    + "; ".join(f"{part}|s|.1f" for part in PARTS)
    + f"; {_SENT}|GB|.1f; busy|%|.0f; device peak|GB|.1f; host peak|GB|.1f; splats left||,.0f; PSNR|dB|.2f"
    + "; file"
)
#: Bytes a second that come to a device from another one, through the host's memory (H100, PCIe 5).
_RELAY = 40e9
_TEST_VIEWS = 10
#: Splats, views, devices.
Point = tuple[int, int, int]
Row = dict[str, float | str | None]


@contextmanager
def watched_gpus() -> Iterator[list[tuple[int, int, int]]]:
    """(GPU, busy %, MiB) of all NVIDIA GPUs twice a second; there once the block is left."""
    found: list[tuple[int, int, int]] = []
    if shutil.which("nvidia-smi") is None:
        yield found
        return
    query = [
        "nvidia-smi",
        "--query-gpu=index,utilization.gpu,memory.used",
        "--format=csv,noheader,nounits",
        "-lms",
        "500",
    ]
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(query, stdout=said)
        try:
            yield found
        finally:
            process.terminate()
            process.wait()
            said.seek(0)
            for line in said.read().splitlines():
                words = line.split(",")
                if len(words) == 3 and all(word.strip().isdigit() for word in words):
                    found.append((int(words[0]), int(words[1]), int(words[2])))


def measure(folder: Path, point: Point, options: Sequence[str]) -> Row:
    """The whole command for the city that lies in a folder.

    Raises:
        DeviceError: the command failed.
    """
    devices = ",".join(str(info.index) for info in choose_devices("all")[: point[2]])
    output = folder / "city.potr"
    command = [
        sys.executable, "-m", "potr_cl", "encode", str(folder / "point_cloud.ply"), "-o", str(output), "--json",
        "--cameras", str(folder / "cameras.json"), "--cameras-anyway", "--device", devices, *options,
    ]  # fmt: skip
    with watched_gpus() as gpus, tempfile.TemporaryFile() as said:
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=said)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - began
        if process.returncode:
            raise DeviceError(f"'{shlex.join(command)}' failed")
        said.seek(0)
        report = json.loads(said.read())
    stages = report["seconds"]
    parts = {name: sum(stages.get(stage, 0.0) for stage in of) for name, of in PARTS.items()}
    parts["start, reading, proof"] = seconds - sum(parts.values())
    used = [(busy, mebibytes) for gpu, busy, mebibytes in gpus if gpu < point[2]]
    shared, quality = report["shared"], report["quality"]
    return {
        **dict(zip(NUMBERS, point, strict=True)), "all": seconds, **parts,
        _SENT: None if shared is None else shared["received"] / 1e9,
        "busy": float(np.mean([busy for busy, _ in used])) if used else None,
        "device peak": max(mebibytes for _, mebibytes in used) * 2**20 / 1e9 if used else None,
        "host peak": usage.ru_maxrss * 1024 / 1e9, "splats left": report["splats"],
        "PSNR": None if quality is None else quality["psnr"],
        "file": hashlib.sha256(output.read_bytes()).hexdigest()[:8],
    }  # fmt: skip


def exponents(measured: Sequence[Mapping[str, float]], figure: str) -> tuple[dict[str, float], float]:
    """The exponents that fit a figure, of the numbers that vary, and the largest relative deviation."""
    varied = [name for name in NUMBERS if len({row[name] for row in measured}) > 1]
    columns = [np.ones(len(measured)), *(np.log([row[name] for row in measured]) for name in varied)]
    terms, wanted = np.stack(columns, axis=1), np.log([row[figure] for row in measured])
    found = np.linalg.lstsq(terms, wanted, rcond=None)[0]
    deviation = float(np.abs(np.exp(terms @ found - wanted) - 1).max())
    return dict(zip(varied, found[1:].tolist(), strict=True)), deviation


def foretold(measured: Mapping[int, tuple[float, float]], devices: int) -> float:
    """Seconds of a city on so many devices.

    Args:
        measured: by the number of devices, at least two of them, seconds and the bytes that came to the first device.
        devices: how many.
    """
    few, more = sorted(measured)[:2]
    one_more = measured[more][1] / (more - 1) / _RELAY
    few_s, more_s = (measured[n][0] - one_more * (n - 1) for n in (few, more))
    shared = max((few_s - more_s) / (1 / few - 1 / more), 0.0)
    return few_s - shared / few + shared / devices + one_more * (devices - 1)


def measured_in_turn(args: argparse.Namespace) -> Iterator[Row]:
    """Encode each city by each number of devices; after so many seconds none is begun any more."""
    width, height = map(int, args.size.split("x"))
    cities = [(int(float(splats)), int(views)) for splats, _, views in (each.partition("x") for each in args.cities)]
    there = len(choose_devices("all"))
    for few in [count for count in args.devices if count > there]:
        log(f"{few} devices are asked for, {there} are there")
    counts = [count for count in args.devices if count <= there]
    began, buildings = time.monotonic(), [building_of(scene) for scene in args.scenes]
    for (splats, views), alike in groupby(product(cities, counts), key=lambda point: point[0]):
        with tempfile.TemporaryDirectory() as name:
            folder, city = Path(name), City(buildings, splats)
            cameras = city.views(views, width, height)
            write_city(folder, city, [*cameras, *city.views(_TEST_VIEWS, width, height, "test")])
            for _, count in alike:
                if args.limit is not None and time.monotonic() - began > args.limit:
                    return
                try:
                    yield measure(folder, (splats, views, count), shlex.split(args.encode))
                except DeviceError as error:
                    log(str(error))


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="as of tools.make.city")
    parser.add_argument("--cities", nargs="+", default=["1e6x100", "2e6x100", "4e6x100"], metavar="SPLATSxVIEWS")
    parser.add_argument("--devices", type=int, nargs="+", default=[1], metavar="N")
    parser.add_argument("--encode", default="", metavar="OPTIONS", help="more options of the command encode")
    parser.add_argument("--size", default="1600x1064", metavar="WxH")
    parser.add_argument("--limit", type=float, metavar="S", help="begin no encode after so many seconds")
    args = parser.parse_args()
    results = Results(choose_device(), args.json)
    title = f"Encodes of cities, views of {args.size}, {args.encode or 'preset best'}"
    table, measured = results.table("points", title, *_COLUMNS.split("; ")), []
    for row in measured_in_turn(args):
        measured.append(row)
        table.add(*row.values())
    report(results, measured)


def report(results: Results, measured: Sequence[Row]) -> None:
    """The tables of exponents, and of what is foretold."""
    numbers = [{name: float(row[name] or 0) for name in (*NUMBERS, *FIGURES, _SENT)} for row in measured]
    if len(numbers) > len(NUMBERS):
        fitted = results.table(
            "exponents", "Exponents that fit them",
            "figure", *(Column(name, format=".2f") for name in NUMBERS), "largest deviation|%|.0f",
        )  # fmt: skip
        for figure in FIGURES:
            powers, deviation = exponents(numbers, figure)
            fitted.add(figure, *(powers.get(name) for name in NUMBERS), 100 * deviation)
    if len({row["devices"] for row in numbers}) < 2:
        return
    table = results.table(
        "foretold", "Whole commands, measured and foretold from the two smallest numbers of devices",
        "splats||,.0f; views||.0f; devices||.0f; measured|s|.1f; times as fast as one||.2f; foretold|s|.1f; off|%|+.0f",
    )  # fmt: skip
    for (splats, views), alike in groupby(numbers, key=lambda row: (row["splats"], row["views"])):
        known = {int(row["devices"]): (row["all"], 1e9 * row[_SENT]) for row in alike}
        for n in sorted({*known, 8}) if len(known) > 1 else ():
            told, took = foretold(known, n), known[n][0] if n in known else None
            faster = None if took is None or 1 not in known else known[1][0] / took
            table.add(splats, views, n, took, faster, told, None if took is None else 100 * (told / took - 1))


if __name__ == "__main__":
    main()
