"""How far off is what an encode says beforehand of its time and memory, and what are the units that it is made of?

    python -m tools.bench.forecast SCENE … [--views 3] [--scale 0.5] [--presets fast best] [--memory 0.5]
        [--device NAME] [--json FILE]

Each encode runs in a process of its own, whose peak of memory is looked at. The units
(:class:`potr_cl.pipeline.forecast.Units`) are worked out from processor time where the device is a CPU, which other
work on the machine changes less than wall time; there, a table compares what is forecast by that clock with what was
taken by it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.pipeline import sampled_views
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.forecast import forecast
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from tools.results import Column, Results

_STAGES = ("prepare views", "prune", "compact", "refit")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help="point_cloud.ply and cameras.json in it")
    parser.add_argument("--presets", nargs="+", default=["fast", "best"])
    parser.add_argument("--views", type=int, default=1, metavar="N", help="take every N-th training view")
    parser.add_argument("--scale", type=float, default=1, help="of the views' width and height")
    parser.add_argument("--memory", type=float, metavar="GB", help="as for potr-cl encode, of 1e9 bytes")
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--json", type=Path, help="also keep the results here")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(_one(args)))
        return
    results = Results(choose_device(args.device), args.json)
    ahead = results.table(
        "errors", "What was forecast, and what it took", Column("scene"), Column("preset"), Column("views", "", "d"),
        Column("pixels", "", ",d"), Column("time, forecast", "s", ".1f"), Column("time", "s", ".1f"),
        Column("work, forecast", "pictures' times", ".0f"), Column("work", "pictures' times", ".0f"),
        Column("memory, forecast", "GB", ".2f"), Column("memory", "GB", ".2f"),
    )  # fmt: skip
    found = []
    for scene in args.scenes:
        for preset in args.presets:
            command = [sys.executable, "-m", "tools.bench.forecast", str(scene), "--one", "--presets", preset]
            command += ["--views", str(args.views), "--scale", str(args.scale)]
            command += [] if args.device is None else ["--device", args.device]
            command += [] if args.memory is None else ["--memory", str(args.memory)]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            one = json.loads(done.stdout.splitlines()[-1])
            found.append(one)
            ahead.add(
                one["scene"], preset, one["views"], one["pixels"], one["seconds"], one["took"],
                one["pictures"], sum(one["units"]) * one["views"], one["memory"] / 1e9, one["peak"] / 1e9,
            )  # fmt: skip
    units = results.table(
        "units", "Stages in units of the time of one picture, once a view", Column("scene"), Column("preset"),
        *(Column(stage, "", ".2f") for stage in _STAGES), Column("the rest, a splat", "µs", ".1f"),
    )  # fmt: skip
    for one in found:
        units.add(one["scene"], one["preset"], *one["units"], one["rest"])
    on_cpu = [one for one in found if one["processors"] is not None]
    if not on_cpu:
        return
    processor = results.table(
        "processor", "Seconds of the processors: what was forecast, and what encodes took", Column("scene"),
        Column("preset"), Column("splats", "", ",d"), Column("views", "", "d"), Column("size"),
        Column("memory given", "GB", ".2f"), Column("forecast", "s", ".0f"), Column("took", "s", ".0f"),
    )  # fmt: skip
    for one in on_cpu:
        processor.add(
            one["scene"], one["preset"], one["splats"], one["views"], one["size"], args.memory, *one["processors"]
        )


def _one(args: argparse.Namespace) -> dict[str, Any]:
    """One encode in this process."""
    (folder,), (preset,) = args.scenes, args.presets
    scene = load_scene(folder / "point_cloud.ply")
    views = [_scaled(view, args.scale) for view in train_views(load_cameras(folder / "cameras.json"))[:: args.views]]
    device, options = Device(args.device), EncodeOptions.for_preset(preset)
    if args.memory is not None:
        options = options.changed(memory=int(1e9 * args.memory))
    on_cpu = device.info.kind == "cpu"

    def now() -> float:
        return time.process_time() if on_cpu else time.perf_counter()

    ahead = forecast(scene, views, options, device)
    by_processors = _by_processors(scene, views, options, device) if on_cpu else 0.0
    with Rasterizer(device, scene) as rasterizer:
        chosen = [views[round(place)] for place in np.linspace(0, len(views) - 1, min(12, len(views)))]
        rasterizer.render_device(chosen[0])
        device.queue.finish()
        began = now()
        for view in chosen:
            rasterizer.render_device(view)
        device.queue.finish()
        picture = (now() - began) / len(chosen)
    spent = dict.fromkeys(("", *_STAGES), 0.0)
    running, last, most = "", now(), 0

    def watch(stage: str, done: float) -> None:
        nonlocal running, last, most
        spent[running if running in spent else ""] += now() - last
        most = max(most, device.allocated)
        running, last = stage if done < 1 else "", now()

    began, worked = time.perf_counter(), now()
    encoded = encode(scene, views, options, watch, device)
    took, worked = time.perf_counter() - began, now() - worked
    spent[""] += now() - last
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "scene": folder.name, "preset": preset, "views": len(views), "pixels": views[0].width * views[0].height,
        "seconds": ahead.seconds, "took": took, "pictures": ahead.pictures,
        "memory": ahead.memory, "peak": host if on_cpu else most,
        "units": [spent[stage] / picture / len(views) for stage in _STAGES],
        "rest": 1e6 * spent[""] / len(encoded.order),
        "splats": len(scene), "size": f"{views[0].width}x{views[0].height}",
        "processors": [by_processors, worked] if on_cpu else None,
    }  # fmt: skip


def _by_processors(scene: Scene, views: list[Camera], options: EncodeOptions, device: Device) -> float:
    """What is forecast where the clock is that of the processors, so that it does not see what else they do."""
    clock = SimpleNamespace(
        perf_counter=time.process_time, process_time=time.process_time, get_clock_info=time.get_clock_info
    )
    with mock.patch.object(sampled_views, "time", clock):
        return forecast(scene, views, options, device).seconds


def _scaled(view: Camera, factor: float) -> Camera:
    width, height = round(view.width * factor), round(view.height * factor)
    return dataclasses.replace(
        view, width=width, height=height, fx=view.fx * factor, fy=view.fy * factor, cx=width / 2, cy=height / 2
    )


if __name__ == "__main__":
    main()
