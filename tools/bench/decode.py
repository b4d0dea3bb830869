"""How fast does a file decode, by the native path and by NumPy?

    python -m tools.bench.decode [FILE.potr …] [--splats N] [--runs R] [--part PART …] [--device DEVICE …] [--json FILE]

FILEs are .potr files; without any, a scene of N splats (default: a million) is drawn from a real one and coded without
pruning by the presets best and fast. Parts (default: all but device):

speed    decodes in this process, in turn by NumPy and by the native path, with one thread and with one a processor;
         wall time and processor time
memory   host memory that a decode takes at most, beside what it makes; a process each
command  `decode FILE -o scene.ply` as a fresh process; the decoded scene is written as PLY too. Python finds its
         modules compiled, as `pip install` leaves them
device   from the file's bytes to buffers of a device, in turn by way of a scene on the host and straight, on the
         devices given (default: the best one)
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from potr_cl.codec.decoder import open_file
from potr_cl.codec.native.library import VARIABLE
from potr_cl.formats import load_cameras, load_scene
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.scene_buffers import uploaded
from tools.bench.memory import reset_peak, resident
from tools.make.large_scene import DEFAULT_SCENE, EXCERPT, large_scene
from tools.results import ROOT, Column, Results
from tools.results import threads as processors

K = TypeVar("K")
PATHS = {"NumPy": "0", "native": "1"}


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(_growth(Path(sys.argv[2]), int(sys.argv[3]))))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--splats", type=int, default=10**6, metavar="N")
    parser.add_argument("--runs", type=int, default=9, metavar="R", help="of each; default 9")
    parser.add_argument("--part", action="append", choices=list(PARTS), dest="parts")
    parser.add_argument("--device", action="append", dest="devices", default=[], help="for device; more than one")
    parser.add_argument(
        "--threads", action="append", type=int, metavar="T", help="to decode with; default: 1, 2 and one a processor"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    results = Results(None, args.json)
    with tempfile.TemporaryDirectory() as folder:
        files = args.files or made_files(args.splats, Path(folder))
        for part in args.parts or [name for name in PARTS if name != "device"]:
            PARTS[part](results, files, args)


def made_files(splats: int, folder: Path) -> list[Path]:
    """A large scene as files of the presets best and fast."""
    source = DEFAULT_SCENE if DEFAULT_SCENE.exists() else EXCERPT
    cameras = source.with_name("cameras.json")
    scene = large_scene(load_scene(source), splats)
    views = load_cameras(cameras) if cameras.exists() else None
    files = []
    for preset in ("best", "fast"):
        options = EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False)
        files.append(folder / f"{splats}-{preset}.potr")
        files[-1].write_bytes(b"".join(encode(scene, views, options).pieces))
    return files


def in_turn(works: Mapping[K, Callable[[], Any]], runs: int) -> dict[K, tuple[list[float], list[float]]]:
    """Wall and processor times, seconds, of some works that are done in turn."""
    times: dict[K, tuple[list[float], list[float]]] = {name: ([], []) for name in works}
    for _ in range(runs):
        for name, work in works.items():
            wall, used = time.perf_counter(), _processor_time()
            work()
            times[name][0].append(time.perf_counter() - wall)
            times[name][1].append(_processor_time() - used)
    return times


def _processor_time() -> float:
    """Of this process and of those that it has waited for, seconds."""
    usages = [resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _decode(path: Path, way: str, threads: int) -> None:
    os.environ[VARIABLE] = PATHS[way]
    open_file(path).scene(threads=threads)


def speed(results: Results, files: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "speed",
        "Decoding in a process that has decoded before, medians",
        Column("file"),
        Column("splats", format=","),
        Column("threads"),
        Column("NumPy, wall", "ms", ".1f"),
        Column("native, wall", "ms", ".1f"),
        Column("NumPy, processor time", "ms", ".1f"),
        Column("native, processor time", "ms", ".1f"),
        Column("times as fast", format=".1f"),
        Column("native, rate", "million splats/s", ".2f"),
        Column("native, best rate", "million splats/s", ".2f"),
        Column("native, rate of a processor at work", "million splats/s", ".2f"),
    )
    for path in files:
        splats = open_file(path).header.splats
        for threads in args.threads or _threads():
            works = {way: partial(_decode, path, way, threads) for way in PATHS}
            in_turn(works, 1)
            times = in_turn(works, args.runs)
            wall = {way: statistics.median(times[way][0]) for way in PATHS}
            used = {way: statistics.median(times[way][1]) for way in PATHS}
            ratio = statistics.median(a / b for a, b in zip(times["NumPy"][0], times["native"][0], strict=True))
            table.add(
                path.stem, splats, threads, *(round(1e3 * wall[way], 2) for way in PATHS),
                *(round(1e3 * used[way], 2) for way in PATHS), round(ratio, 2),
                round(splats / wall["native"] / 1e6, 3), round(splats / min(times["native"][0]) / 1e6, 3),
                round(splats / used["native"] / 1e6, 3),
            )  # fmt: skip


def _threads() -> list[int]:
    return sorted({1, min(2, processors()), processors()})


def memory(results: Results, files: Iterable[Path], _: argparse.Namespace) -> None:
    table = results.table(
        "memory",
        "Host memory that a decode takes at most, in sizes of the decoded arrays",
        Column("file"),
        Column("splats", format=","),
        Column("threads"),
        Column("NumPy", format=".2f"),
        Column("native", format=".2f"),
    )
    for path in files:
        for threads in sorted({1, processors()}):
            found = {}
            for way, value in PATHS.items():
                command = [sys.executable, "-m", "tools.bench.decode", "--child", str(path), str(threads)]
                environment = {**os.environ, VARIABLE: value, "PYTHONPATH": str(ROOT)}
                output = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
                found[way] = json.loads(output)
            table.add(path.stem, open_file(path).header.splats, threads, *(round(found[w], 3) for w in PATHS))


def _growth(path: Path, threads: int) -> float:
    """In a process of its own: by how much memory grows at most, in sizes of what a decode makes."""
    reset_peak()
    before = resident("VmRSS")
    scene = open_file(path).scene(threads=threads)
    return 1e9 * (resident("VmHWM") - before) / scene.nbytes


def command(results: Results, files: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "command",
        "`decode FILE -o scene.ply` as a fresh process, medians",
        Column("file"),
        Column("splats", format=","),
        Column("NumPy, wall", "s", ".2f"),
        Column("native, wall", "s", ".2f"),
        Column("NumPy, processor time", "s", ".2f"),
        Column("native, processor time", "s", ".2f"),
    )
    for path in files:
        with tempfile.TemporaryDirectory() as folder:
            works = {way: partial(_whole_command, path, way, Path(folder)) for way in PATHS}
            in_turn(works, 1)
            times = in_turn(works, args.runs)
        wall, used = ({way: statistics.median(times[way][k]) for way in PATHS} for k in (0, 1))
        table.add(
            path.stem, open_file(path).header.splats, *(round(wall[way], 3) for way in PATHS),
            *(round(used[way], 3) for way in PATHS),
        )  # fmt: skip


def _whole_command(path: Path, way: str, folder: Path) -> None:
    compiled = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(folder / "compiled")}
    environment = {**os.environ, **compiled, VARIABLE: PATHS[way], "PYTHONPATH": str(ROOT)}
    output = folder / "scene.ply"
    whole = [sys.executable, "-m", "potr_cl", "decode", str(path), "-o", str(output)]
    subprocess.run(whole, check=True, capture_output=True, env=environment)
    output.unlink()


def device(results: Results, files: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "device",
        "From a file's bytes to a device's buffers, in a process that has done so before, medians of wall times",
        Column("file"),
        Column("splats", format=","),
        Column("device"),
        Column("decoding on the host", "ms", ".1f"),
        Column("uploading that scene", "ms", ".1f"),
        Column("both", "ms", ".1f"),
        Column("straight to the device", "ms", ".1f"),
        Column("the same, fastest", "ms", ".1f"),
        Column("of it busy on the device", "ms", ".1f"),
    )
    for name in args.devices or [None]:
        opened, timed = Device(name), Device(name, profiling=True)
        for path in files:
            data = path.read_bytes()
            works = {
                "host": partial(_on_host, data),
                "both": partial(_by_way_of_the_host, data, opened),
                "straight": partial(_straight, data, opened),
            }
            in_turn(works, 2)
            walls = {way: times[0] for way, times in in_turn(works, args.runs).items()}
            medians = {way: 1e3 * statistics.median(times) for way, times in walls.items()}
            _straight(data, timed)
            timed.stage_times()
            _straight(data, timed)
            table.add(
                path.stem, open_file(data, True).header.splats, opened.info.name,
                *(round(each, 2) for each in (medians["host"], medians["both"] - medians["host"], medians["both"])),
                round(medians["straight"], 2), round(1e3 * min(walls["straight"]), 2),
                round(1e3 * sum(timed.stage_times().values()), 3),
            )  # fmt: skip


def _on_host(data: bytes) -> None:
    open_file(data, trust=True).scene()


def _by_way_of_the_host(data: bytes, opened: Device) -> None:
    with uploaded(opened, open_file(data, trust=True).scene()):
        opened.queue.finish()


def _straight(data: bytes, opened: Device) -> None:
    decode_to_device(open_file(data, trust=True), opened).close()


PARTS: dict[str, Callable[[Results, Iterable[Path], argparse.Namespace], None]] = {
    "speed": speed,
    "memory": memory,
    "command": command,
    "device": device,
}


if __name__ == "__main__":
    main()
