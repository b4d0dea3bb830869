"""The scenes that a command reads."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from potr_cl.formats import load_scene
from potr_cl.formats.scene_size import bytes_of_scene
from potr_cl.model.scene import Scene


def add_trust_option(p: argparse._ActionsContainer) -> None:
    """``--trust``, for every command that reads scenes."""
    p.add_argument(
        "--trust",
        action="store_true",
        help="read scene files that take far more memory than their size lets expect: only from who means well",
    )


def trust(args: argparse.Namespace) -> dict[str, Any]:
    """What the readers of scenes are told because of ``--trust``."""
    return {"trust": True} if args.trust else {}


def read_scene(args: argparse.Namespace, path: Path) -> Scene:
    """The scene of a file that the command line names.

    Raises:
        As :func:`potr_cl.formats.load_scene`.
    """
    return load_scene(path, **trust(args))


def size_of_file(path: Path) -> int | None:
    """Bytes of a file, or of a scene's folder; None where there is none, which whoever reads it will say."""
    return bytes_of_scene(path)
