"""The same splats coded and decoded by two checkouts of the package: bytes, times and memory of both.

    git worktree add ../before COMMIT && (cd ../before && python -m tools.make.native)
    python -m tools.bench.recoded ../before SCENE [SCENE …] [--preset P …] [--q Q …] [--runs R] [--device] [--json FILE]

Nothing is pruned or fitted: what differs is the coder. SCENEs are .ply files, such as decoded .potr files: so their
splats and colours are those that an encode keeps; cameras lie beside each, with the ending .json. The checkouts take
turns, and who begins alternates; times are the least of R, in processor time on one thread, which other work on the
machine disturbs least.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tools.results import Column, Results

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
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", _WORKER, *arguments], cwd=folder, env=environment, stdout=subprocess.PIPE, check=True
    )
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--preset", action="append", dest="presets")
    parser.add_argument("--q", action="append", dest="qualities", type=float)
    parser.add_argument("--runs", type=int, default=5, metavar="R")
    parser.add_argument("--device", action="store_true", help="decode to the memory of the default device, too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()

    results = Results(None, args.json)
    table = results.table(
        "recoded", "The same splats, coded and decoded by an earlier state and by this one",
        Column("scene"), Column("splats", format=","), Column("preset"), Column("q", format="g"),
        Column("bytes before", format=","), Column("bytes", format=","), Column("change", "%", "+.2f"),
        Column("same values"),
        Column("decode before", "ms", ".0f"), Column("decode", "ms", ".0f"),
        Column("to a device before", "ms", ".0f"), Column("to a device", "ms", ".0f"),
        Column("memory before, times the arrays", format=".2f"), Column("memory, times the arrays", format=".2f"),
    )  # fmt: skip
    folders = [args.before.resolve(), Path(__file__).resolve().parents[2]]
    turn = 0
    for scene in args.scenes:
        for preset in args.presets or ["best"]:
            for q in args.qualities or [0.5]:
                cameras = scene.with_suffix(".json").resolve()
                arguments = [scene.resolve(), cameras, preset, q, args.runs, int(args.device)]
                turn += 1
                found = {
                    folder: _measured(folder, list(map(str, arguments))) for folder in folders[:: 1 if turn % 2 else -1]
                }
                before, now = (found[folder] for folder in folders)
                table.add(
                    scene.stem, now["splats"], preset, q, before["bytes"], now["bytes"],
                    100 * (now["bytes"] / before["bytes"] - 1),
                    "yes" if before["sha256"] == now["sha256"] else "no",
                    *(_ms(each, "decode") for each in (before, now)), *(_ms(each, "device") for each in (before, now)),
                    before["memory"], now["memory"],
                )  # fmt: skip


def _ms(measured: dict[str, Any], name: str) -> float | None:
    return 1e3 * measured[name] if name in measured else None


if __name__ == "__main__":
    main()
