"""Whole encodes by two checkouts of the package, in turns: is one faster than the other?

Two processes stay alive, one for each checkout; each reads the scene once and encodes it when it is told to. They take
turns, and who begins alternates, so that whatever slows the machine down meets both alike. What counts is the median of
the ratios of the pairs.

    git worktree add ../before COMMIT
    python -m tools.bench.paired ../before --scene point_cloud.ply --cameras cameras.json --preset best --rounds 20
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

#: What each process runs. It uses only names that every version of the package has had.
_WORKER = """
import hashlib, json, sys, time
import potr_cl
scene = potr_cl.load_scene(sys.argv[1])
cameras = potr_cl.load_cameras(sys.argv[2]) if sys.argv[2] else None
options = potr_cl.EncodeOptions.for_preset(sys.argv[3])
device = None
for _ in sys.stdin:
    begin, worked = time.perf_counter(), time.process_time()
    encoded = potr_cl.encode(scene, cameras, options, None, device)
    seconds, worked = time.perf_counter() - begin, time.process_time() - worked
    device = encoded.device
    digest = hashlib.sha256(b"".join(bytes(piece) for piece in encoded.pieces)).hexdigest()
    print(json.dumps({"wall": seconds, "processor": worked, "bytes": encoded.nbytes, "sha256": digest}), flush=True)
"""


class _Checkout:
    """A process that encodes with the package of one checkout."""

    def __init__(self, folder: Path, arguments: list[str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _WORKER, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])},
        )

    def encode(self) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        said = self._process.stdout.readline()
        if not said:
            sys.exit(f"the process of a checkout ended with {self._process.wait()}")
        measured: dict[str, Any] = json.loads(said)
        return measured

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--preset", default="best")
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()

    cameras = str(args.cameras.resolve()) if args.cameras else ""
    arguments = [str(args.scene.resolve()), cameras, args.preset]
    folders = {"before": args.before.resolve(), "now": Path(__file__).resolve().parents[2]}
    checkouts = {name: _Checkout(folder, arguments) for name, folder in folders.items()}
    measured: dict[str, list[dict[str, Any]]] = {name: [] for name in checkouts}
    warm = {name: checkout.encode() for name, checkout in checkouts.items()}  # builds its kernels
    for number in range(args.rounds):
        for name in ("before", "now") if number % 2 else ("now", "before"):
            measured[name].append(checkouts[name].encode())
    for checkout in checkouts.values():
        checkout.close()

    for clock in ("wall", "processor"):
        pairs = [(b[clock], n[clock]) for b, n in zip(measured["before"], measured["now"], strict=True)]
        ratios = sorted(now / before for before, now in pairs)
        low, _, high = statistics.quantiles(ratios, n=4)
        before, now = (statistics.median(times) for times in zip(*pairs, strict=True))
        print(
            f"{clock}: before {before:.3f} s, now {now:.3f} s (medians of {len(pairs)}); "
            f"ratio of pairs: median {statistics.median(ratios):.4f}, middle half {low:.4f} to {high:.4f}"
        )
    print(f"bytes: {warm['before']['bytes']} before, {warm['now']['bytes']} now")
    print(f"same file: {warm['before']['sha256'] == warm['now']['sha256']}")


if __name__ == "__main__":
    main()
