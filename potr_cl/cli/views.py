"""The views that a command looks at: those of a file, or virtual ones."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from potr_cl.api.inputs import placed_beside_cameras
from potr_cl.cli.guard import CamerasBeside, ReadCameras, StandardInput, check_photographs
from potr_cl.cli.options import CAMERAS_HELP
from potr_cl.cli.parser import whole_number
from potr_cl.cli.terminal import note
from potr_cl.formats import load_cameras
from potr_cl.formats.registry import cameras_beside
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import describe
from potr_cl.opencl.device import Device
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.evidence import evidence_of
from potr_cl.stages.stage import Progress

#: What ``--cameras`` takes in the place of a path.
BESIDE = "beside"


def add_cameras_options(p: argparse.ArgumentParser) -> None:
    """``--cameras``, and what to do without."""
    p.add_argument(
        "--cameras",
        type=cameras_to_read,
        metavar="PATH",
        help=f'{CAMERAS_HELP}; "beside": those in the folder of each scene, or of its training. Without '
        "--cameras, virtual ones are placed",
    )
    p.add_argument(
        "--virtual-views",
        type=whole_number,
        metavar="N",
        help="number of virtual views without --cameras (default: 200 to 1600, more for larger scenes)",
    )
    p.add_argument(
        "--cameras-anyway",
        action="store_true",
        help="use the cameras even if they do not seem to be in the scene's frame",
    )


def cameras_to_read(text: str) -> Path:
    """A type of arguments: cameras that the command reads."""
    return CamerasBeside(text) if text == BESIDE else ReadCameras(text)


def given_cameras(args: argparse.Namespace) -> list[Camera] | None:
    """The cameras of the file that ``--cameras`` names, or those beside the scene; None where there are none.

    Raises:
        UsageError: virtual ones are asked for besides; and as :func:`read_cameras`.
    """
    if args.cameras is None:
        return None
    if args.virtual_views is not None:
        raise placed_beside_cameras("--virtual-views")
    if not isinstance(args.cameras, CamerasBeside):
        return read_cameras(args)
    folder = None if isinstance(args.scene, StandardInput) else cameras_beside(args.scene)
    if folder is None:
        return None
    found = argparse.Namespace(**{**vars(args), "cameras": ReadCameras(folder)})
    cameras = read_cameras(found)
    note(f"{len(cameras)} views of '{folder}'")
    return cameras


def read_cameras(args: argparse.Namespace) -> list[Camera]:
    """The cameras of ``--cameras``; no output may be a photograph of theirs.

    Raises:
        UsageError: an output is one; and as :func:`potr_cl.formats.load_cameras`.
    """
    cameras = load_cameras(args.cameras)
    check_photographs(args, cameras)
    return cameras


def warn_of_frame(path: Path, scene: Scene, views: Sequence[Camera]) -> None:
    """Say so if the views of a file do not seem to be in a scene's frame; for commands that throw nothing away."""
    judged = judge_cameras(scene, views, evidence_of(scene, views))
    said = judged.finding if judged.suspicious else judged.doubt
    if said is not None:
        note(f"warning: {path}: {said}", "warning")


def virtual_cameras(args: argparse.Namespace, scene: Scene, progress: Progress, device: Device) -> list[Camera]:
    """Virtual cameras, and a line that says so."""
    progress("place cameras", 0.0)
    cameras = place_cameras(scene, args.virtual_views, device=device)
    progress("place cameras", 1.0)
    scene_file = getattr(args, "scene", None)
    folder = None if scene_file is None or isinstance(scene_file, StandardInput) else cameras_beside(scene_file)
    better = (
        f"--cameras beside takes those in '{folder}'" if folder else "with the real cameras the file would be smaller"
    )
    if getattr(args, "cameras", None) is not None:  # "beside", where there are none
        note(f"no cameras beside '{scene_file}': {describe(cameras)}; {better}", "warning")
    else:
        note(f"no --cameras given: {describe(cameras)}; {better}")
    return cameras
