"""Options that several commands share."""

from __future__ import annotations

import argparse
from typing import TypeAlias

from potr_cl.api.views import DEVICE_VARIABLE, RULES

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
