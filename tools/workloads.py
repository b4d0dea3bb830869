"""What tools share: command lines, scenes named on them, their views and renders, work that is repeated or measured."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, resized
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch
from potr_cl.stages.code import Code
from potr_cl.stages.stage import State

P = ParamSpec("P")
T = TypeVar("T")
K = TypeVar("K")

#: Whole scenes, for tools that take none on the command line: folders lego and plush.
SCENES = Path(__file__).parents[2] / "shared" / "scenes"
TEST_DATA = Path(__file__).parents[1] / "tests" / "data"


# --------------------------------------------------------------------------------------------- command lines


def plain_parser(description: str | None) -> argparse.ArgumentParser:
    """A command line that shows a module's text as it stands, with a file for the results."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also keep the figures here")
    return parser


def scene_parser(description: str | None, number: str | int = "+") -> argparse.ArgumentParser:
    """The same with a device, and scenes' folders: a number of them as argparse has it."""
    parser = plain_parser(description)
    parser.add_argument(
        "scenes", nargs=number, type=Path, metavar="SCENE", help="holds point_cloud.ply and cameras.json"
    )
    parser.add_argument("--device", help="as for potr-cl")
    return parser


def log(text: str) -> None:
    """Progress, to standard error."""
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


# ---------------------------------------------------------------------------------------------------- scenes


def excerpt(folder: Path) -> Path:
    """The bundled excerpt as a scene's folder."""
    folder.mkdir()
    shutil.copy(TEST_DATA / "plush_excerpt.ply", folder / "point_cloud.ply")
    shutil.copy(TEST_DATA / "plush_excerpt_cameras.json", folder / "cameras.json")
    return folder


def read(folder: Path) -> tuple[Scene, list[Camera]]:
    """The scene and all cameras of a folder."""
    return load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")


def camera_entry(number: int, camera: Camera) -> dict[str, Any]:
    """One element of the original implementation's cameras.json; ``split`` is what this package adds."""
    return {
        "id": number, "img_name": camera.name, "width": camera.width, "height": camera.height,
        "position": camera.centre.tolist(), "rotation": camera.rotation.T.tolist(), "fx": camera.fx, "fy": camera.fy,
        "split": camera.split,
    }  # fmt: skip


def reduced(scene: Scene, views: Sequence[Camera], options: EncodeOptions, device: Device | None = None) -> State:
    """What all stages but the coder leave of a scene, and the views that they have looked at."""
    before_coding = [type(stage) for stage in options.stages if not isinstance(stage, Code)]
    return Run(options, Stopwatch(), device).stages(State.of(scene, views), before_coding)


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view at another resolution, at least one pixel; its photograph does not fit any more."""
    width, height = max(int(camera.width * factor), 1), max(int(camera.height * factor), 1)
    return resized(camera, width, height)


# ------------------------------------------------------------------------------------------ time and memory


def in_turn(works: Mapping[K, Callable[[], Any]], runs: int) -> dict[K, tuple[list[float], list[float]]]:
    """Wall and processor times, seconds, of some works that are done in turn, after one round that is not counted."""
    times: dict[K, tuple[list[float], list[float]]] = {name: ([], []) for name in works}
    for number in range(runs + 1):
        for name, work in works.items():
            wall, used = time.perf_counter(), processor_time()
            work()
            if number:
                times[name][0].append(time.perf_counter() - wall)
                times[name][1].append(processor_time() - used)
    return times


def best_of(repeats: int, work: Callable[[], Any]) -> float:
    """Seconds by the clock, the least of so many runs, after one that is not counted."""
    return min(in_turn({"": work}, repeats)[""][0])


def processor_time() -> float:
    """Of this process and of those that it has waited for, seconds."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def resident(field: str, pid: int | str = "self") -> int:
    """Bytes of a process: "VmHWM", the peak since the last reset, or now, "VmRSS". Linux only."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"/proc/{pid}/status has no {field}")


def growth(work: Callable[[], Any]) -> int:
    """By how many bytes the resident set grows at most while something is done; Linux only."""
    Path("/proc/self/clear_refs").write_text("5")
    before = resident("VmRSS")
    work()
    return resident("VmHWM") - before


def in_process(work: Callable[P, T], *arguments: P.args, **more: P.kwargs) -> T:
    """What a function gives in a process of its own.

    Raises:
        BrokenProcessPool: the process has ended, as a driver that crashes ends it.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments, **more).result()
