"""How busy the device is during an encode, stage by stage.

    python -m tools.bench.busy --scene SCENE.ply --cameras PATH

The device is busy while at least one of its kernels runs, by the timestamps of a run that records them; the stages'
wall times are the medians of runs that do not. Everything has been built and used once before. Prints Markdown.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

import pyopencl as cl

from potr_cl.codec.quantize import PRESETS
from potr_cl.formats import load_cameras, load_scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.make.large_scene import DEFAULT_SCENE, EXCERPT, cameras_beside
from tools.results import Column, Results


class StageEvents:
    """Takes an encode's progress, and notes which launches belong to which stage."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._running: str | None = None
        self._noted = 0
        self.events: dict[str, list[cl.Event]] = {}

    def __call__(self, stage: str, done: float) -> None:
        new = self._device.timings[self._noted :]
        self._noted += len(new)
        self.events.setdefault(self._running or stage, []).extend(event for _, event in new)
        self.events.setdefault(stage, [])
        self._running = stage if done < 1 else None


def busy(events: list[cl.Event]) -> float:
    """Seconds in which at least one of them ran."""
    spans = sorted((event.profile.start, event.profile.end) for event in events)
    total, until = 0, 0
    for start, end in spans:
        total += max(end - max(start, until), 0)
        until = max(until, end)
    return total * 1e-9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=DEFAULT_SCENE if DEFAULT_SCENE.exists() else EXCERPT)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--preset", choices=PRESETS, default="best")
    parser.add_argument("--device")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also keep the results here")
    args = parser.parse_args()
    scene, _ = load_scene(args.scene).cleaned()
    cameras = load_cameras(args.cameras or cameras_beside(args.scene))
    options = EncodeOptions.for_preset(args.preset)
    device = Device(args.device)
    encode(scene, cameras, options, device=device)
    runs = [encode(scene, cameras, options, device=device) for _ in range(args.repeats)]
    watching = Device(args.device, profiling=True)
    encode(scene, cameras, options, device=watching)
    watching.queue.finish()
    watching.timings.clear()
    stages = StageEvents(watching)
    encode(scene, cameras, options, stages, watching)
    watching.queue.finish()
    results = Results(device.info, args.json)
    what = f"{args.scene.parent.name}, {len(scene):,} splats, preset {args.preset}, {runs[0].nbytes:,} bytes"
    table = results.table(
        "stages",
        f"An encode's stages: {what}",
        Column("stage"),
        Column("wall", "ms", ".0f"),
        Column("device busy", "ms", ".0f"),
        Column("share", format=".0%"),
        Column("launches"),
    )
    for stage, events in stages.events.items():
        wall = statistics.median(run.seconds[stage] for run in runs)
        ran = busy(events)
        table.add(stage, 1e3 * wall, 1e3 * ran, ran / wall, len(events))
    table.add("all", 1e3 * statistics.median(sum(run.seconds.values()) for run in runs), None, None, None)
    names: dict[str, float] = {}
    for name, event in watching.timings:
        names[name] = names.get(name, 0.0) + (event.profile.end - event.profile.start) * 1e-9
    table = results.table(
        "kernels",
        f"Its kernels, launches that overlap counted each: {what}",
        Column("kernel"),
        Column("time", "ms", ".1f"),
    )
    for name, seconds in sorted(names.items(), key=lambda item: -item[1]):
        table.add(name, 1e3 * seconds)


if __name__ == "__main__":
    main()
