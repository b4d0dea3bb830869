"""Time and memory of reading and writing PLY files, beside plain reads and writes of the same bytes.

    python -m tools.bench.ply [--splats N] [--degree D] [--folder FOLDER]

The scene is random. Each figure is the least of five runs; files are in the page cache when they are read. Peak memory
is the resident set of a process that does nothing else, less what it holds after importing (Linux only).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from potr_cl.formats.scenes import ply
from potr_cl.model.scene import SH_COEFFICIENTS, Scene

_RUNS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--degree", type=int, default=3, choices=range(4))
    parser.add_argument("--folder", type=Path, help="where to write (default: the system's temporary folder)")
    parser.add_argument("--peak-of", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.peak_of:
        _print_peaks(options.peak_of)
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        _run(Path(folder), _random_scene(options.splats, options.degree))


def _run(folder: Path, scene: Scene) -> None:
    path, copy = folder / "a.ply", folder / "b.ply"
    ply.save(path, scene)
    content = path.read_bytes()
    planar = Scene(
        scene.means,
        scene.log_scales,
        scene.quaternions,
        scene.opacity_logits,
        np.ascontiguousarray(scene.sh.transpose(1, 2, 0)).transpose(2, 0, 1),
    )
    sizes = f"file {len(content) / 1e6:.0f} MB, arrays {scene.nbytes / 1e6:.0f} MB"
    print(f"{len(scene)} splats, SH degree {scene.sh_degree}: {sizes}")
    for name, action in {
        "load": lambda: ply.load(path),
        "  of that Scene.cleaned": scene.cleaned,
        "read the same bytes": path.read_bytes,
        "save, SH splat by splat": lambda: ply.save(copy, scene),
        "save, SH coefficient by coefficient": lambda: ply.save(copy, planar),
        "write the same bytes": lambda: copy.write_bytes(content),
    }.items():
        seconds = _least(action)
        print(f"{name:37} {seconds:7.3f} s  {len(content) / seconds / 1e6:7.0f} MB/s")
    child = [sys.executable, "-m", "tools.bench.ply", "--peak-of", str(path)]
    print(subprocess.run(child, check=True, capture_output=True, text=True).stdout, end="")


def _least(action: Callable[[], object]) -> float:
    seconds = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        action()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def _print_peaks(path: Path) -> None:
    before = _peak()
    scene = ply.load(path)
    loaded = _peak()
    print(f"peak memory of load: {(loaded - before) / 1e6:.0f} MB, {(loaded - before) / scene.nbytes:.2f} x the arrays")
    ply.save(path.with_name("c.ply"), scene)
    print(f"save on top of that: {(_peak() - loaded) / 1e6:.0f} MB")


def _peak() -> int:
    # Not getrusage: its peak counts what the parent held when it forked.
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024


def _random_scene(splats: int, degree: int) -> Scene:
    rng = np.random.default_rng(0)
    shapes = ((splats, 3), (splats, 3), (splats, 4), (splats,), (splats, SH_COEFFICIENTS[degree], 3))
    return Scene(*(rng.standard_normal(shape, dtype=np.float32) for shape in shapes))


if __name__ == "__main__":
    main()
