"""The same splats coded and decoded by two checkouts of the package: bytes, times and memory of both.

    git worktree add ../before COMMIT && (cd ../before && python -m tools.make.native)
    python -m tools.bench.recoded ../before SCENE [SCENE …] [--preset P …] [--q Q …] [--runs R] [--device] [--json FILE]

Nothing is pruned or fitted: what differs is the coder. SCENEs are .ply files, such as decoded .potr files: so their
splats and colours are those that an encode keeps; cameras lie beside each, with the ending .json. The checkouts take
turns, and who begins alternates; times are the least of R, in processor time on one thread, which other work on the
machine disturbs least.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tools.results import ROOT, Results
from tools.workloads import plain_parser

#: What a process of a checkout runs. It uses only names that every version of the package has had.
_WORKER = """
import hashlib, json, sys, time
import numpy as np
import potr_cl
scene, cameras, preset, q, runs, device = sys.argv[1:7]
options = potr_cl.EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False, fit=False, q=float(q))
encoded = potr_cl.encode(potr_cl.load_scene(scene), potr_cl.load_cameras(cameras), options)
file = b"".join(bytes(piece) for piece in encoded.pieces)
del encoded

def resident(field):
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(field + ":"))

def least(work):
    times = []
    for _ in range(int(runs)):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)

with open("/proc/self/clear_refs", "w") as refs:
    refs.write("5")
before = resident("VmRSS")
found = potr_cl.decode(file)
peak = resident("VmHWM") - before
digest, size = hashlib.sha256(), 0
for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
    array = np.ascontiguousarray(getattr(found, name))
    digest.update(array)
    size += array.nbytes
splats = len(found)
del found
import potr_cl.codec.decoder as decoder
opened = decoder.open_file if hasattr(decoder, "open_file") else decoder.PotrFile.open
said = {"bytes": len(file), "splats": splats, "sha256": digest.hexdigest(), "memory": peak / size}
said["decode"] = least(lambda: opened(file).scene(threads=1))
if device == "1":
    said["device"] = least(lambda: potr_cl.decode_to_device(file, threads=1))
print(json.dumps(said))
"""


def _measured(folder: Path, arguments: list[str]) -> dict[str, Any]:
    command, environment = [sys.executable, "-c", _WORKER, *arguments], {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, check=True)
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--preset", action="append", dest="presets")
    parser.add_argument("--q", action="append", dest="qualities", type=float)
    parser.add_argument("--runs", type=int, default=5, metavar="R")
    parser.add_argument("--device", action="store_true", help="decode to the memory of the default device, too")
    args = parser.parse_args()
    table = Results(None, args.json).table(
        "recoded", "The same splats, coded and decoded by an earlier state and by this one",
        "scene; splats||,; preset; q||g; bytes before||,; bytes||,; change|%|+.2f; same values; decode before|ms|.0f; "
        "decode|ms|.0f; to a device before|ms|.0f; to a device|ms|.0f; memory before, times the arrays||.2f; "
        "memory, times the arrays||.2f",
    )  # fmt: skip
    folders = [args.before.resolve(), ROOT.resolve()]
    kinds = itertools.product(args.scenes, args.presets or ["best"], args.qualities or [0.5])
    for turn, (scene, preset, q) in enumerate(kinds):
        cameras = scene.with_suffix(".json").resolve()
        arguments = list(map(str, (scene.resolve(), cameras, preset, q, args.runs, int(args.device))))
        found = {folder: _measured(folder, arguments) for folder in folders[:: -1 if turn % 2 else 1]}
        both = [found[folder] for folder in folders]
        sizes = [each["bytes"] for each in both]
        times = (1e3 * each[name] if name in each else None for name in ("decode", "device") for each in both)
        table.add(
            scene.stem, both[1]["splats"], preset, q, *sizes, 100 * (sizes[1] / sizes[0] - 1),
            "yes" if both[0]["sha256"] == both[1]["sha256"] else "no", *times, *(each["memory"] for each in both),
        )  # fmt: skip


if __name__ == "__main__":
    main()
