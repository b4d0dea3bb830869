"""How fast are encoding, without pruning and with every colour kept, and decoding, and in how much memory?

    python -m tools.bench.codec [FILE.potr …] [--splats N] [--runs R] [--part PART …] [--device DEVICE …] [--json FILE]

FILEs are .potr files; without any, a scene of N splats (default: a million) is drawn from a real one and coded without
pruning by the presets best and fast. Parts (default: all but device):

encode   of such a scene, by entropy coders: stages, size, and memory at most, a process each
speed    decodes in this process, in turn by NumPy and by the native path; wall time and processor time
memory   host memory that a decode takes at most, beside what it makes; a process each
device   from the file's bytes to buffers of a device, in turn by way of a scene on the host and straight, on the
         devices given (default: the best one)

``potr-cl info`` says how large each section is.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import open_file
from potr_cl.codec.quantize import Preset
from potr_cl.formats import load_cameras, load_scene
from potr_cl.native.library import VARIABLE
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode as encode_scene
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.scene_buffers import uploaded
from tools.make.large_scene import cameras_beside, default_scene, large_scene
from tools.results import Cell, Results
from tools.results import threads as processors
from tools.workloads import growth, in_process, in_turn, plain_parser

PATHS = {"NumPy": "0", "native": "1"}
_MADE: tuple[Preset, ...] = ("best", "fast")
#: Entropy coders that encode, and whether with cameras.
CODERS = tuple((EntropyCoder("zstd", level), views) for level, views in ((1, True), (9, True), (9, False), (19, True)))
CODERS = (*CODERS, (EntropyCoder("bundles"), True))
Times = Mapping[str, tuple[list[float], list[float]]]


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    parser.add_argument("--splats", type=int, default=10**6, metavar="N")
    parser.add_argument("--runs", type=int, default=9, metavar="R", help="of each; default 9")
    parser.add_argument("--part", action="append", choices=list(PARTS), dest="parts")
    parser.add_argument("--device", action="append", dest="devices", default=[], help="for device; more than one")
    parser.add_argument("--threads", action="append", type=int, metavar="T", help="default: 1, 2 and one a processor")
    args = parser.parse_args()
    args.threads = args.threads or sorted({1, min(2, processors()), processors()})
    results = Results(None, args.json)
    with tempfile.TemporaryDirectory() as folder:
        files = args.files or made_files(args.splats, Path(folder))
        for part in args.parts or [name for name in PARTS if name != "device"]:
            PARTS[part](results, files, args)


def as_it_is(preset: Preset) -> EncodeOptions:
    """Options that keep every splat and every colour."""
    return EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False, cameras_anyway=True)


def made_files(splats: int, folder: Path) -> list[Path]:
    """A large scene as files of the presets best and fast."""
    source = default_scene()
    scene, views = large_scene(load_scene(source), splats), load_cameras(cameras_beside(source))
    files = []
    for preset in _MADE:
        files.append(folder / f"{splats}-{preset}.potr")
        files[-1].write_bytes(b"".join(encode_scene(scene, views, as_it_is(preset)).pieces))
    return files


def encode(results: Results, _: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "encode", f"Encode without pruning, {args.splats} splats of SH degree 3",
        "coder; cameras; octree|s|.2f; quantise and code|s|.2f; all|s|.2f; size|MB|.1f; peak / arrays||.2f",
    )  # fmt: skip
    for coder, views in CODERS:
        name = f"{coder.name} {coder.level}" if coder.name == "zstd" else coder.name
        table.add(name, "yes" if views else "no", *in_process(_encode, args.splats, views, coder))


def _encode(splats: int, with_views: bool, coder: EntropyCoder) -> list[Cell]:
    """Seconds by stage and of all, megabytes, and the peak in sizes of the scene."""
    source = default_scene()
    scene, rows = large_scene(load_scene(source), splats), list[Cell]()
    views = load_cameras(cameras_beside(source)) if with_views else None
    options = as_it_is("best" if coder.name == "bundles" else "paper")
    options = options.changed(code={"entropy": coder.name, "zstd_level": coder.level})

    def work() -> None:
        began = time.perf_counter()
        encoded = encode_scene(scene, views, options)
        rows.extend(encoded.seconds[stage] for stage in ("octree", "entropy coding"))
        rows.extend((time.perf_counter() - began, encoded.nbytes / 1e6))

    peak = growth(work)
    return [*rows, 1 + peak / scene.nbytes]


def _medians(times: Times, clock: int) -> list[float]:
    """Milliseconds of the wall (0) or of the processors (1), for NumPy and the native path."""
    return [1e3 * statistics.median(times[way][clock]) for way in PATHS]


def _decode(path: Path, way: str, threads: int) -> None:
    os.environ[VARIABLE] = PATHS[way]
    open_file(path).scene(threads=threads)


def speed(results: Results, files: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "speed", "Decoding in a process that has decoded before, medians",
        "file; splats||,; threads; NumPy, wall|ms|.1f; native, wall|ms|.1f; NumPy, processor time|ms|.1f; "
        "native, processor time|ms|.1f; times as fast||.1f; native, rate|million splats/s|.2f; "
        "native, best rate|million splats/s|.2f; native, rate of a processor at work|million splats/s|.2f",
    )  # fmt: skip
    for path in files:
        splats = open_file(path).header.splats
        for threads in args.threads:
            times = in_turn({way: partial(_decode, path, way, threads) for way in PATHS}, args.runs)
            wall, used = _medians(times, 0), _medians(times, 1)
            ratio = statistics.median(a / b for a, b in zip(times["NumPy"][0], times["native"][0], strict=True))
            rates = [1e-3 * splats / each for each in (wall[1], 1e3 * min(times["native"][0]), used[1])]
            table.add(path.stem, splats, threads, *wall, *used, ratio, *rates)


def memory(results: Results, files: Iterable[Path], _: argparse.Namespace) -> None:
    table = results.table(
        "memory", "Host memory that a decode takes at most, in sizes of the decoded arrays",
        "file; splats||,; threads; NumPy||.2f; native||.2f",
    )  # fmt: skip
    for path in files:
        size = open_file(path).scene().nbytes
        for threads in sorted({1, processors()}):
            found = [in_process(_growth, path, way, threads) / size for way in PATHS]
            table.add(path.stem, open_file(path).header.splats, threads, *found)


def _growth(path: Path, way: str, threads: int) -> int:
    return growth(partial(_decode, path, way, threads))


def device(results: Results, files: Iterable[Path], args: argparse.Namespace) -> None:
    table = results.table(
        "device", "From a file's bytes to a device's buffers, when it was done before, medians of wall times",
        "file; splats||,; device; decoding on the host|ms|.1f; uploading that scene|ms|.1f; both|ms|.1f; "
        "straight to the device|ms|.1f; the same, fastest|ms|.1f; of it busy on the device|ms|.1f",
    )  # fmt: skip
    for name in args.devices or [None]:
        opened, timed = Device(name), Device(name, profiling=True)
        for path in files:
            data = path.read_bytes()
            works: dict[str, Callable[[], object]] = {
                "host": partial(_on_the_host, data),
                "both": partial(_by_way_of_the_host, data, opened),
                "straight": partial(_straight, data, opened),
            }
            walls = {way: times[0] for way, times in in_turn(works, args.runs).items()}
            host, both, straight = (1e3 * statistics.median(times) for times in walls.values())
            for _ in range(2):  # the first builds the kernels
                timed.stage_times()
                _straight(data, timed)
            table.add(
                path.stem, open_file(data, True).header.splats, opened.info.name, host, both - host, both, straight,
                1e3 * min(walls["straight"]), 1e3 * sum(timed.stage_times().values()),
            )  # fmt: skip


def _on_the_host(data: bytes) -> object:
    return open_file(data, trust=True).scene()


def _by_way_of_the_host(data: bytes, opened: Device) -> None:
    with uploaded(opened, open_file(data, trust=True).scene()):
        opened.queue.finish()


def _straight(data: bytes, opened: Device) -> None:
    decode_to_device(open_file(data, trust=True), opened).close()


_ALL = (encode, speed, memory, device)
PARTS: dict[str, Callable[[Results, Iterable[Path], argparse.Namespace], None]] = {part.__name__: part for part in _ALL}


if __name__ == "__main__":
    main()
