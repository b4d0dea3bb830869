"""What tools measure on: scenes named on the command line, their views and renders, work that is repeated."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, resized
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.code import Code
from potr_cl.stages.stage import State

#: Whole scenes, for tools that take none on the command line: folders lego and plush.
SCENES = Path(__file__).parents[2] / "shared" / "scenes"
_TEST_DATA = Path(__file__).parents[1] / "tests" / "data"


def excerpt(folder: Path) -> Path:
    """The bundled excerpt as a scene's folder."""
    folder.mkdir()
    shutil.copy(_TEST_DATA / "plush_excerpt.ply", folder / "point_cloud.ply")
    shutil.copy(_TEST_DATA / "plush_excerpt_cameras.json", folder / "cameras.json")
    return folder


def scene_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line of scenes' folders, a device and a file for the results."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE", help="point_cloud.ply and cameras.json in it")
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--json", type=Path, help="also keep the results here")
    return parser


def study_parser(
    description: str | None, measure: Callable[[argparse.Namespace], None], report: Callable[[argparse.Namespace], None]
) -> tuple[argparse.ArgumentParser, argparse.ArgumentParser, argparse.ArgumentParser]:
    """A command line of two commands: ``measure SCENE … --json FILE`` and ``report FILE``.

    Returns:
        The parser, whose arguments' ``run`` is the function to call with them; and the commands', for more options.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    measuring = commands.add_parser("measure")
    measuring.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    measuring.add_argument("--json", type=Path, required=True)
    measuring.add_argument("--device", help="as for potr-cl")
    measuring.set_defaults(run=measure)
    reporting = commands.add_parser("report")
    reporting.add_argument("results", type=Path, help="the JSON that measure wrote")
    reporting.set_defaults(run=report)
    return parser, measuring, reporting


def read(folder: Path) -> tuple[Scene, list[Camera]]:
    """The scene and all cameras of a folder."""
    return load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")


def reduced(scene: Scene, views: Sequence[Camera], options: EncodeOptions, device: Device | None = None) -> Scene:
    """What all stages but the coder leave of a scene; device: the best one there is by default."""
    return reduced_state(scene, views, options, device).scene


def reduced_state(scene: Scene, views: Sequence[Camera], options: EncodeOptions, device: Device | None = None) -> State:
    """The same with what else the stages have found, and the views that they have looked at."""
    before_coding = [type(stage) for stage in options.stages if not isinstance(stage, Code)]
    return Run(options, Stopwatch(), device).stages(State.of(scene, views), before_coding)


def pictures(device: Device, scene: Scene, views: Sequence[Camera]) -> list[FloatArray]:
    """Renders, (H, W, 3) float32, clamped to [0, 1]."""
    with Rasterizer(device, scene) as rasterizer:
        return [np.clip(rasterizer.render(view)[0], 0, 1) for view in views]


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view at another resolution, at least one pixel; its photograph does not fit any more."""
    width, height = max(int(camera.width * factor), 1), max(int(camera.height * factor), 1)
    return resized(camera, width, height)


def best_of(repeats: int, work: Callable[[], Any]) -> float:
    """Seconds by the clock, the least of so many runs, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)
