"""Options that several commands share."""

from __future__ import annotations

import argparse
import contextlib
import re
from typing import TypeAlias

from potr_cl.errors import UsageError
from potr_cl.opencl.discovery import DEVICE_VARIABLE
from potr_cl.plain_text import plain
from potr_cl.raster.rules import GSPLAT, INRIA

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

#: More than any device has; beyond it someone has typed bytes.
_MOST_GIGABYTES = 1e6
#: More than any file has.
_MOST_BYTES = 1e18

RULES = {"inria": INRIA, "gsplat": GSPLAT}
CAMERAS_HELP = "cameras.json, transforms.json, or a COLMAP model's folder"


def as_bytes(gigabytes: float | None) -> int | None:
    """Bytes of what ``--memory`` says.

    Raises:
        UsageError: no machine has that much, or it is no amount at all.
    """
    if gigabytes is None:
        return None
    if not 0 <= gigabytes <= _MOST_GIGABYTES:
        raise UsageError(f"--memory is {gigabytes:g}, it must lie between 0 and {_MOST_GIGABYTES:g} GiB")
    return int(gigabytes * 2**30)


def size_in_bytes(text: str) -> int:
    """Bytes of a size as people write it: 8MB (10⁶), 8 MiB (2²⁰), 800k, 1.5e6.

    Raises:
        UsageError: it is none.
    """
    match = re.fullmatch(r"\s*([0-9][0-9._]*(?:e[0-9]+)?)\s*(?:([kmg])(i?))?b?\s*", text, re.IGNORECASE)
    if match is not None:
        with contextlib.suppress(ValueError):
            power = " kmg".index((match[2] or " ").lower())
            size = float(match[1]) * (1024 if match[3] else 1000) ** power
            if size <= _MOST_BYTES:
                return int(size)
    raise UsageError(f"'{plain(text, 40)}' is no size: give bytes, or a number with k, MB, GB, KiB, MiB or GiB")


def add_memory_option(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--memory",
        type=float,
        metavar="GB",
        help="GiB of device memory to keep views in; default: half of it, 0.3 of a CPU's",
    )


def add_device_options(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--background",
        default="black",
        metavar="COLOUR",
        help="R,G,B from 0 to 1, a name, or #rrggbb; default black",
    )
    p.add_argument(
        "--device",
        metavar="DEVICE",
        help="index, part of a name, cpu or gpu, as the command devices lists them; "
        f"default: ${DEVICE_VARIABLE}, else the one that should be fastest",
    )


def add_rendering_options(p: argparse.ArgumentParser) -> None:
    """What every command that renders understands."""
    add_device_options(p)
    p.add_argument(
        "--rules",
        choices=tuple(RULES),
        default="inria",
        help="whose rasterizer to follow; default inria, the original",
    )


def add_view_options(p: argparse.ArgumentParser, default: str) -> None:
    which = p.add_mutually_exclusive_group()
    which.add_argument("--views", nargs="+", metavar="VIEW", help="names, or indices from 0 in the cameras' order")
    which.add_argument("--split", choices=("train", "test", "all"), help=f"default: {default}")
