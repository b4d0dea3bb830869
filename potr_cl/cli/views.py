"""The views that a command looks at: those of a file, or virtual ones."""

from __future__ import annotations

import argparse
from pathlib import Path

from potr_cl.api.inputs import placed_beside_cameras
from potr_cl.cli.guard import CamerasBeside, ReadCameras, StandardInput, check_photographs
from potr_cl.cli.options import CAMERAS_HELP
from potr_cl.cli.parser import whole_number
from potr_cl.cli.terminal import note
from potr_cl.formats import load_cameras
from potr_cl.formats.registry import cameras_beside
from potr_cl.model.camera import Camera

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
        note(f"no cameras beside '{args.scene}'", "warning")
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
