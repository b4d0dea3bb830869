"""Options that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

from potr_cl.api.inputs import placed_beside_cameras
from potr_cl.api.views import DEVICE_VARIABLE, RULES
from potr_cl.cli.guard import CamerasBeside, ReadCameras, StandardInput, check_photographs
from potr_cl.cli.parser import whole_number
from potr_cl.cli.terminal import note
from potr_cl.formats import load_cameras
from potr_cl.formats.registry import cameras_beside
from potr_cl.model.camera import Camera

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

CAMERAS_HELP = "cameras.json, transforms.json, or a COLMAP model's folder"


def add_memory_option(p: argparse._ActionsContainer, besides: str = "") -> None:
    """
    Args:
        besides: what else of memory a command bounds.
    """
    p.add_argument(
        "--memory",
        type=float,
        metavar="GB",
        help=f"memory limit in GiB for views{besides} (default: half of a GPU's memory, 0.3 of the RAM on a CPU)",
    )


#: What the help of ``--device`` says besides, where a command takes several.
SEVERAL = "; several devices share the views: all (of the best kind), or indices such as 0,1"


def add_cluster_option(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="address of the scheduler of a Dask cluster, tcp://HOST:8786: its workers share the views",
    )


def add_device_options(p: argparse._ActionsContainer, several: str = "") -> None:
    """
    Args:
        several: what the help says besides, where a command takes several devices.
    """
    p.add_argument(
        "--background",
        default="black",
        metavar="COLOUR",
        help="R,G,B from 0 to 1, a name, or #rrggbb; default black",
    )
    p.add_argument(
        "--device",
        metavar="DEVICE",
        help="index (see the command devices), part of a name, cpu or gpu; "
        f"default: ${DEVICE_VARIABLE}, else the one that should be fastest{several}",
    )


def add_rendering_options(p: argparse.ArgumentParser, several: str = "") -> None:
    """What every command that renders understands; ``several``: as of :func:`add_device_options`."""
    add_device_options(p, several)
    p.add_argument(
        "--rules",
        choices=tuple(RULES),
        default="inria",
        help="rasterizer to imitate; default inria, the original",
    )


def add_view_options(p: argparse.ArgumentParser, default: str) -> None:
    which = p.add_mutually_exclusive_group()
    which.add_argument("--views", nargs="+", metavar="VIEW", help="names, or indices from 0 in the cameras' order")
    which.add_argument("--split", choices=("train", "test", "all"), help=f"default: {default}")


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
        help="number of virtual views without --cameras (default: 120 to 1600, more for larger scenes)",
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
