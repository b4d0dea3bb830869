"""Host memory of an encode, stage by stage.

    python -m tools.bench.memory SCENE.ply CAMERAS.json [--iterations N] …

The peak of every stage is the kernel's own (Linux only): it is reset when a stage begins. Of it, anonymous memory is
what the system can only keep; pages of files, as --memory has large arrays lie in, it can drop. That, and what is
allocated on the device, is looked at ten times a second. On CPU devices the device's memory is the host's and counts.
Prints Markdown. tools.make.large_scene and tools.make.city make scenes of any size.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from pathlib import Path

from potr_cl.codec.quantize import PRESETS
from potr_cl.formats import load_cameras, load_scene
from potr_cl.host.mapped import bounded
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.results import Column, Results, Table


def resident(field: str) -> float:
    """Gigabytes of this process: "VmHWM", the peak since the last reset; now, "VmRSS", or "RssAnon": of no file."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024 / 1e9
    raise OSError(f"/proc/self/status has no {field}")


def reset_peak() -> None:
    """Let "VmHWM" begin again at what is resident now."""
    Path("/proc/self/clear_refs").write_text("5")


class Sampler(threading.Thread):
    """Looks at this process and its device now and then.

    Attributes:
        anonymous, device: the most gigabytes that were seen since :meth:`begin`.
    """

    def __init__(self, device: Device) -> None:
        super().__init__(daemon=True)
        self._device = device
        self._lock = threading.Lock()  # what was seen before a stage began is not of it
        self.begin()
        self.start()

    def begin(self) -> None:
        """Forget what was seen."""
        with self._lock:
            self.anonymous = self.device = 0.0
        self._look()

    def _look(self) -> None:
        with self._lock:
            self.anonymous = max(self.anonymous, resident("RssAnon"))
            self.device = max(self.device, self._device.allocated / 1e9)

    def run(self) -> None:
        """Until the process ends."""
        while True:
            time.sleep(0.1)
            self._look()


class StagePeaks:
    """Notes the peak of each stage; called as an encoder's progress.

    Attributes:
        rows: stage; its peak, the most of anonymous memory, the most on the device, and what was resident when it
            ended, in gigabytes; its seconds, and those of all processors.
    """

    def __init__(self, first: str, table: Table, sampler: Sampler) -> None:
        self._table, self._sampler = table, sampler
        self.rows: list[tuple[str, float, float, float, float, float, float]] = []
        self._begin(first)

    def _begin(self, stage: str) -> None:
        self._stage, self._began, self._processors = stage, time.perf_counter(), sum(os.times()[:2])
        reset_peak()
        self._sampler.begin()

    def __call__(self, stage: str, done: float = 0.0) -> None:
        if stage == self._stage:
            return
        peaks = resident("VmHWM"), self._sampler.anonymous, self._sampler.device, resident("VmRSS")
        seconds = time.perf_counter() - self._began, sum(os.times()[:2]) - self._processors
        self.rows.append((self._stage, *peaks, *seconds))
        self._table.add(*self.rows[-1])
        self._begin(stage)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("--iterations", type=int, help="of pruning; default: the preset's")
    parser.add_argument("--preset", choices=PRESETS, default=EncodeOptions.preset)
    parser.add_argument("--views", type=int, metavar="N", help="the first so many only")
    parser.add_argument("--memory", type=float, metavar="GB", help="as encode's")
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path, help="also keep the results here")
    args = parser.parse_args()
    device = Device(args.device)
    table = Results(device.info, args.json).table(
        "stages",
        f"Host memory of an encode of {args.scene.name}, preset {args.preset}, {args.iterations} iterations",
        Column("stage"),
        Column("peak", "GB", ".2f"),
        Column("of it anonymous", "GB", ".2f"),
        Column("device", "GB", ".2f"),
        Column("at its end", "GB", ".2f"),
        Column("time", "s", ".0f"),
        Column("processors", "s", ".0f"),
    )
    peaks = StagePeaks("read", table, Sampler(device))
    memory = None if args.memory is None else int(args.memory * 2**30)
    with bounded(memory):
        scene = load_scene(args.scene)
    cameras = load_cameras(args.cameras)[: args.views]
    options = EncodeOptions.for_preset(args.preset, memory=memory)
    if args.iterations is not None:
        options = options.changed(prune={"iterations": args.iterations})
    encoded = encode(scene, cameras, options, peaks, device)
    peaks("end")
    most = max(row[1] for row in peaks.rows)
    print(
        f"\n{len(scene)} splats, {len(cameras)} views of {cameras[0].width} x {cameras[0].height}, {args.iterations} "
        f"iterations: {len(encoded.order)} splats in {encoded.nbytes} bytes, peak {most:.2f} GB"
    )


if __name__ == "__main__":
    main()
