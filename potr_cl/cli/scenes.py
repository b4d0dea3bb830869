"""The scenes that a command reads."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from potr_cl.formats import load_scene
from potr_cl.formats.scene_size import bytes_of_scene
from potr_cl.model.scene import Scene

_ANTIALIASED = {"yes": True, "no": False, "auto": None}


def add_trust_option(p: argparse._ActionsContainer) -> None:
    """``--trust``, for every command that reads scenes."""
    p.add_argument(
        "--trust",
        action="store_true",
        help="read scene files that take far more memory than their size lets expect: only from who means well",
    )


def add_antialiased_option(p: argparse._ActionsContainer) -> None:
    """``--antialiased``, for every command that renders, encodes or writes the scenes that it reads."""
    p.add_argument(
        "--antialiased",
        choices=tuple(_ANTIALIASED),
        default="auto",
        help="whether the scene was trained with antialiasing (gsplat's antialiased mode, Mip-Splatting) and is to be "
        "rendered so; default auto: as its file says, which PLY files of gsplat and nerfstudio do not: give yes",
    )


def trust(args: argparse.Namespace) -> dict[str, Any]:
    """What the readers of scenes are told because of ``--trust``."""
    return {"trust": True} if args.trust else {}


def read_scene(args: argparse.Namespace, path: Path) -> Scene:
    """The scene of a file that the command line names.

    Raises:
        As :func:`potr_cl.formats.load_scene`.
    """
    return load_scene(path, **trust(args), antialiased=_ANTIALIASED[args.antialiased])


def size_of_file(path: Path) -> int | None:
    """Bytes of a file, or of a scene's folder; None where there is none, which whoever reads it will say."""
    return bytes_of_scene(path)
