"""An encode on a device that is told to be small and watched: does it fit, how long are its kernels, same bytes?

    python -m tools.stress.limits SCENE … [--device NAME] [--family gpu] [--preset best] [--iterations N] [--json FILE]

Each scene is encoded twice, in processes of their own: on the device as it is, and with no more memory than --memory GB
(default 4), --buffer GB (1) in one buffer, kernels of at most --kernel seconds (0.25), no profiling, and memory that it
shares with the host. ``--only limited`` leaves the first out. ``--busy`` takes processor time for a kernel's time, at
least as much on a CPU: on one that others use too, the clock says how long they were at it.
"""

from __future__ import annotations

import hashlib
import os
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pyopencl as cl

from potr_cl.model.camera import train_views
from potr_cl.opencl import pieces
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.opencl.limits import LIMITS_VARIABLE
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.results import Results
from tools.workloads import in_process, log, read, scene_parser


@dataclass
class Encode:
    """What an encode took: seconds, most bytes of the device, the longest piece of each kernel, launches that were cut;
    and what it made."""

    seconds: float
    most: int
    device: str
    longest: dict[str, float]
    cut: dict[str, int]
    nbytes: int
    digest: str


def run(
    folder: Path, limits: str, name: str | None, family: Family | None, options: EncodeOptions, busy: bool
) -> Encode:
    """Encode a scene on a device with limits, see :mod:`potr_cl.opencl.limits`."""
    os.environ[LIMITS_VARIABLE] = limits
    device, most = Device(name, family=family), 0
    allocate = Device.allocate

    def counted(self: Device, nbytes: int, what: str) -> cl.Buffer:
        nonlocal most
        buffer = allocate(self, nbytes, what)
        most = max(most, self.allocated)
        return buffer

    scene, cameras = read(folder)
    with ExitStack() as patches:
        patches.enter_context(patch.object(Device, "allocate", counted))
        if busy:
            patches.enter_context(patch.object(pieces, "perf_counter", time.process_time))
        began = time.perf_counter()
        made = encode(scene, train_views(cameras), options, device=device)
        seconds = time.perf_counter() - began
    assert made.device is not None
    cutter = made.device.pieces
    return Encode(
        seconds, most, str(made.device.info),
        {} if cutter is None else cutter.longest, {} if cutter is None else cutter.cut,
        made.nbytes, hashlib.sha256(made.data).hexdigest(),
    )  # fmt: skip


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--family", choices=("gpu", "cpu"), help="kernels (default: the device's own)")
    parser.add_argument("--preset", default="best")
    parser.add_argument("-q", type=float, default=0.5)
    parser.add_argument("--iterations", type=int, help="of pruning")
    for what, given in (("memory", 4.0), ("buffer", 1.0), ("kernel", 0.25)):
        parser.add_argument(f"--{what}", type=float, default=given)
    parser.add_argument("--only", choices=("limited",), help="do not encode on the device as it is")
    parser.add_argument("--busy", action="store_true", help="count processor time")
    args = parser.parse_args()
    few = {} if args.iterations is None else {"prune": {"iterations": args.iterations}}
    options = EncodeOptions.for_preset(args.preset, q=args.q, cameras_anyway=True, **few)
    limits = f"memory={args.memory},buffer={args.buffer},kernel={args.kernel},profiling=no,shared=yes"
    table = Results(None, args.json).table(
        "limits", "Encodes on a device with limits",
        "scene; device; kernels; time|s|.0f; without limits|s|.0f; most memory|MB|.0f; longest piece|s|.3f; of; "
        "launches cut||,; same bytes",
    )  # fmt: skip
    for folder in args.scenes:
        log(f"{folder.name} with {limits}")
        small = in_process(run, folder, limits, args.device, args.family, options, args.busy)
        whole = None if args.only else in_process(run, folder, "", args.device, args.family, options, args.busy)
        kernel = max(small.longest, key=small.longest.__getitem__)
        same = None
        if whole is not None:
            same = "yes" if whole.digest == small.digest else f"NO: {small.nbytes}, {whole.nbytes}"
        table.add(
            folder.name, small.device, args.family or "own", small.seconds, None if whole is None else whole.seconds,
            small.most / 1e6, small.longest[kernel], kernel, sum(small.cut.values()), same,
        )  # fmt: skip
        for name, seconds in sorted(small.longest.items(), key=lambda each: -each[1])[:8]:
            log(f"{name}: at most {seconds:.3f} s, {small.cut[name]:,} launches cut")


if __name__ == "__main__":
    main()
