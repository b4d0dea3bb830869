"""Speed, memory and size of the codec without pruning.

    python -m tools.bench.codec [PART …] [--splats N]

Parts: decode, encode, octree, sizes (all by default). Prints Markdown for docs/benchmarks. Every measurement that
concerns memory runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.codec import octree
from potr_cl.codec.container import EntropyCoder, read_section
from potr_cl.codec.decoder import open_file
from potr_cl.codec.quantize import Preset
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.scenes import ply
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from tools.bench.memory import reset_peak, resident
from tools.make.large_scene import DEFAULT_SCENE, EXCERPT, large_scene
from tools.results import circumstances

SCENES = DEFAULT_SCENE.parents[1]


def as_it_is(preset: Preset, coder: EntropyCoder | None = None) -> EncodeOptions:
    """Options that keep every splat and every colour; coder: another than the preset's."""
    options = EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False)
    return options if coder is None else options.changed(code={"entropy": coder.name, "zstd_level": coder.level})


class _Peak:
    """By how many bytes the resident set has grown at most since this was made.

    Not what getrusage calls the peak: a child's begins with what its parent held.
    """

    def __init__(self) -> None:
        reset_peak()
        self._before = resident("VmRSS")

    def growth(self) -> float:
        return 1e9 * (resident("VmHWM") - self._before)


def _times(run: Callable[[], Any], runs: int) -> list[float]:
    times = []
    for _ in range(runs):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return times


def _child(part: str, *arguments: object) -> dict[str, Any]:
    command = [sys.executable, "-m", "tools.bench.codec", "--child", part, *map(str, arguments)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result: dict[str, Any] = json.loads(output)
    return result


# ---------------------------------------------------------------------------------------------- children


def _child_decode(path: str) -> dict[str, Any]:
    """Peak memory of one decode, and decode times with one and all threads."""
    peak = _Peak()
    scene = open_file(path).scene()
    growth = peak.growth()
    arrays = scene.nbytes
    del scene
    file = open_file(path)
    return {
        "growth": growth,
        "arrays": arrays,
        "splats": file.header.splats,
        "all": _times(lambda: open_file(path).scene(), 9),
        "one": _times(lambda: open_file(path).scene(threads=1), 5),
        "parts": {
            name: statistics.median(_times(getattr(file.body(0), name), 5))
            for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh")
        },
    }


def _child_write(path: str, output: str) -> dict[str, Any]:
    """Decode and write a PLY; and the same number of bytes written plainly."""
    scene = open_file(path).scene()
    block = bytes(1 << 20)

    def plain() -> None:
        with open(output + ".plain", "wb") as file:
            for _ in range(size >> 20):
                file.write(block)

    ply.save(output, scene)
    size = Path(output).stat().st_size
    times = _times(lambda: ply.save(output, scene), 5)
    plain_times = _times(plain, 5)
    os.unlink(output)
    os.unlink(output + ".plain")
    return {"bytes": size, "save": times, "plain": plain_times}


def _child_encode(scene_path: str, cameras: str, level: str) -> dict[str, Any]:
    """Time by stage and peak memory of one encode."""
    views = load_cameras(Path(cameras)) if cameras else None
    scene = load_scene(Path(scene_path))
    peak = _Peak()
    started = time.perf_counter()
    encoded = encode(scene, views, as_it_is("paper", EntropyCoder("zstd", int(level))))
    seconds = time.perf_counter() - started
    return {
        "seconds": seconds,
        "stages": encoded.seconds,
        "bytes": encoded.nbytes,
        "growth": peak.growth(),
        "arrays": scene.nbytes,
    }


# ------------------------------------------------------------------------------------------------- parts


def _like() -> tuple[Path, Path | None]:
    if DEFAULT_SCENE.exists():
        return DEFAULT_SCENE, DEFAULT_SCENE.with_name("cameras.json")
    return EXCERPT, None


def bench_decode(splats: int, folder: Path) -> None:
    plain = as_it_is("paper", EntropyCoder("zstd", 9))
    _bench_decode("paper's steps, zstd 9", plain, splats, folder)
    context = as_it_is("best")
    _bench_decode("preset best, bundles", context, splats, folder)


def _bench_decode(name: str, options: EncodeOptions, splats: int, folder: Path) -> None:
    scene_path, cameras = _like()
    scene = large_scene(load_scene(scene_path), splats)
    views = load_cameras(cameras) if cameras else None
    path = folder / "scene.potr"
    encoded = encode(scene, views, options)
    path.write_bytes(b"".join(encoded.pieces))
    del scene
    result = _child("decode", path)
    best, middle = min(result["all"]), statistics.median(result["all"])
    print(f"\n### Decode, {splats} splats of SH degree 3, {name}, {encoded.nbytes / 1e6:.1f} MB\n")
    print("| | median | best |\n|---|---|---|")
    print(f"| all threads | {middle * 1e3:.0f} ms | {best * 1e3:.0f} ms |")
    print(f"| million splats/s | {splats / middle / 1e6:.2f} | {splats / best / 1e6:.2f} |")
    one = result["one"]
    print(f"| one thread | {statistics.median(one) * 1e3:.0f} ms | {min(one) * 1e3:.0f} ms |")
    parts = ", ".join(f"{name} {seconds * 1e3:.0f} ms" for name, seconds in result["parts"].items())
    print(f"\nOne property at a time, one thread: {parts}.")
    print(
        f"Peak memory: {result['growth'] / result['arrays']:.2f} times the decoded arrays ({result['arrays']} bytes)."
    )
    written = _child("write", path, folder / "scene.ply")
    save, plain = statistics.median(written["save"]), statistics.median(written["plain"])
    rate = written["bytes"] / 1e6
    print(
        f"Writing the PLY ({rate:.0f} MB): {save:.2f} s, {rate / save:.0f} MB/s; the same number of zero bytes written "
        f"plainly: {plain:.2f} s, {rate / plain:.0f} MB/s. File to PLY: {middle + save:.2f} s."
    )


def bench_encode(splats: int, folder: Path) -> None:
    scene_path, cameras = _like()
    path = folder / "scene.ply"
    ply.save(path, large_scene(load_scene(scene_path), splats))
    print(f"\n### Encode without pruning, {splats} splats of SH degree 3\n")
    print("| zstd level | cameras | octree | quantise and code | all | MB | peak memory / arrays |")
    print("|---|---|---|---|---|---|---|")
    for level, views in ((9, cameras), (9, None), (19, cameras)):
        r = _child("encode", path, views or "", level)
        stages = r["stages"]
        print(
            f"| {level} | {'yes' if views else 'no'} | {stages['octree']:.2f} s | {stages['quantise and code']:.2f} s "
            f"| {r['seconds']:.2f} s | {r['bytes'] / 1e6:.1f} | {r['growth'] / r['arrays']:.2f} + 1 |"
        )


def bench_octree(_: int, __: Path) -> None:
    like = load_scene(_like()[0])
    print("\n### Octree alone: growth with the number of splats\n")
    print("| splats | build | parse | build ns/splat | parse ns/splat | levels | bytes a splat before coding |")
    print("|---|---|---|---|---|---|---|")
    rng = np.random.default_rng(0)
    tolerance = EncodeOptions().parameters.gamma
    for splats in (10**4, 10**5, 10**6, 10**7):
        source = rng.integers(0, len(like), splats)
        spread = np.exp(like.log_scales[source])
        means = (like.means[source] + spread * rng.normal(size=(splats, 3)).astype(np.float32)).astype(np.float32)
        runs = 5 if splats < 10**7 else 1
        streams, _order = octree.build(means, tolerance)
        build = min(_times(lambda m=means: octree.build(m, tolerance), runs))  # type: ignore[misc]
        parse = min(_times(lambda s=streams, n=splats: octree.parse(s, n), runs))  # type: ignore[misc]
        fields = (streams.occupancy, streams.several, streams.multiplicities, streams.leaf_levels, streams.tails)
        print(
            f"| {splats} | {build:.3f} s | {parse:.3f} s | {build / splats * 1e9:.0f} | {parse / splats * 1e9:.0f} "
            f"| {streams.depth} | {sum(f.nbytes for f in fields) / splats:.2f} |"
        )


def _as_npz(data: bytes) -> int:
    """Bytes of a file of plain streams, were they deflated at zlib's usual level, as the paper's npz column has it."""
    file = open_file(data)
    contents = [read_section(file.body(0).data, section) for section in file.blocks[0].sections]
    return file.header.start + sum(len(zlib.compress(content.tobytes())) for content in contents)


def bench_sizes(_: int, __: Path) -> None:
    for name in ("lego", "plush"):
        folder = SCENES / name
        if not folder.exists():
            print(f"\n({folder} is not here: skipped)")
            continue
        scene = load_scene(folder / "point_cloud.ply")
        cameras = load_cameras(folder / "cameras.json")
        print(f"\n### Bytes a splat, {name}, {len(scene)} splats, q = 0.5, nothing pruned\n")
        columns: dict[str, dict[str, Any]] = {}
        for label, coder in (
            ("zstd 9", EntropyCoder("zstd", 9)),
            ("zstd 19", EntropyCoder("zstd", 19)),
            ("zstd 22", EntropyCoder("zstd", 22)),
            ("best", None),
        ):
            options = as_it_is("best" if coder is None else "paper", coder)
            encoded = encode(scene, cameras, options)
            columns[label] = file_report(open_file(b"".join(encoded.pieces)))
            if label == "zstd 9":
                print(f"As .npz: {_as_npz(encoded.data) / len(scene):.2f} bytes.\n")
        first = columns["zstd 9"]
        print("| | serialised | " + " | ".join(columns) + " |\n|---|---|" + "---|" * len(columns))
        for section in first["sections"]:
            raw = first["sections"][section]["serialised_bytes"] / len(scene)
            cells = " | ".join(f"{c['sections'][section]['bytes'] / len(scene):.2f}" for c in columns.values())
            print(f"| {section} | {raw:.2f} | {cells} |")
        raw = sum(s["serialised_bytes"] for s in first["sections"].values()) / len(scene)
        print(f"| **all** | {raw:.2f} | " + " | ".join(f"{c['bytes_a_splat']:.2f}" for c in columns.values()) + " |")


PARTS = {"decode": bench_decode, "encode": bench_encode, "octree": bench_octree, "sizes": bench_sizes}
CHILDREN: dict[str, Callable[..., dict[str, Any]]] = {
    "decode": _child_decode,
    "write": _child_write,
    "encode": _child_encode,
}


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(CHILDREN[sys.argv[2]](*sys.argv[3:])))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], default=[])
    parser.add_argument("--splats", type=int, default=10**6)
    args = parser.parse_args()
    about = circumstances()
    print("{machine}, {date}, commit {commit}".format(**about), end=", ")
    print(f"Python {platform.python_version()}, numpy {np.__version__}; {about['command'][0]}")
    with tempfile.TemporaryDirectory() as folder:
        for part in args.parts or PARTS:
            PARTS[part](args.splats, Path(folder))


if __name__ == "__main__":
    main()
