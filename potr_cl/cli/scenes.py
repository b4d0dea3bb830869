"""The scenes that a command reads and writes: in files, or through standard input and output."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from potr_cl.api.inputs import scene_of
from potr_cl.cli.guard import StandardInput, StandardOutput
from potr_cl.cli.outputs import not_streamed
from potr_cl.errors import UsageError
from potr_cl.formats import scene_writer
from potr_cl.formats.registry import bytes_of_scene
from potr_cl.formats.scenes import spz
from potr_cl.formats.streams import received, send
from potr_cl.host.process import closed
from potr_cl.model.scene import Scene

FROM_HELP = 'format of "-", standard input: .ply, .spz …; default: detected'
TO_HELP = "output format if the file name does not give it: .ply, .spz …"
ANTIALIASED = {"yes": True, "no": False, "auto": None}


def add_trust_option(p: argparse._ActionsContainer) -> None:
    """``--trust``, for every command that reads scenes."""
    p.add_argument(
        "--trust",
        action="store_true",
        help="read files that expand to far more memory than their size suggests; only for files you trust",
    )


def add_from_option(p: argparse._ActionsContainer) -> None:
    """``--from``, for every command that reads a scene from standard input."""
    p.add_argument("--from", dest="from_suffix", metavar="SUFFIX", help=FROM_HELP)


def add_antialiased_option(p: argparse._ActionsContainer) -> None:
    """``--antialiased``, for every command that renders, encodes or writes the scenes that it reads."""
    p.add_argument(
        "--antialiased",
        choices=tuple(ANTIALIASED),
        default="auto",
        help="whether the scene was trained with antialiasing (gsplat's antialiased, Mip-Splatting); default auto: "
        "what the file says. PLY files of gsplat and nerfstudio do not say: pass yes",
    )


def add_format_options(p: argparse._ActionsContainer) -> None:
    """What some formats leave to choose, for commands that write scenes in formats of other programs."""
    p.add_argument(
        "--spz-version",
        type=int,
        choices=sorted(spz.FORMAT.versions),
        metavar="V",
        help=f"of .spz files: {', '.join(f'{version}, {what}' for version, what in spz.VERSIONS.items())}; default "
        f"{spz.FORMAT.versions[0]}",
    )
    p.add_argument("--title", metavar="TEXT", help="of .html pages: shown on the page")
    p.add_argument("--author", metavar="TEXT", help="of .html pages: shown on the page")


def format_choices(args: argparse.Namespace) -> dict[str, Any]:
    """What the options of :func:`add_format_options` say, None where they are not given."""
    return {"version": args.spz_version, "title": args.title, "author": args.author}


def trust(args: argparse.Namespace) -> dict[str, Any]:
    """What the readers of scenes are told because of ``--trust``."""
    return {"trust": True} if args.trust else {}


def read_scene(args: argparse.Namespace, path: Path) -> Scene:
    """The scene of a file that the command line names, or of standard input.

    Raises:
        As :func:`potr_cl.formats.load_scene`.
    """
    with as_file(path) as file:
        return scene_of(file, args.trust, ANTIALIASED[args.antialiased])


def write_scene(path: Path, scene: Scene, to: str | None = None, **choices: Any) -> int:
    """Write a scene to a file, in the format that its suffix tells, or to standard output.

    Args:
        path: of the file, or standard output.
        scene: to write.
        to: the suffix of the format for standard output; ".ply" by default.
        choices: of the format, as of :func:`potr_cl.formats.scene_writer`.

    Returns:
        The number of bytes, of all files where the format has several.

    Raises:
        As :func:`potr_cl.formats.save_scene`.
    """
    if isinstance(path, StandardOutput):
        suffix = to or ".ply"
        return send(path.stream, suffix, lambda file: scene_writer(file, **choices)(scene))
    scene_writer(path, **choices)(scene)
    return bytes_of_scene(path) or os.stat(path).st_size


def write_result(path: Path, scene: Scene, to: str | None = None) -> None:
    """As :func:`write_scene`, for what takes long to make: also a reader that has gone is an error.

    Raises:
        WriteError: it cannot be written.
    """
    try:
        write_scene(path, scene, to)
    except OSError as error:
        raise not_streamed(error) from error


def size_of_file(path: Path) -> int | None:
    """Bytes of a file, or of a scene's folder; None where there is none, which whoever reads it will say."""
    with as_file(path) as file:
        return bytes_of_scene(file)


def as_file(path: Path) -> contextlib.AbstractContextManager[Path]:
    """A file that is read; of standard input, the one that holds what it brought."""
    return path.as_file() if isinstance(path, StandardInput) else contextlib.nullcontext(path)


@contextlib.contextmanager
def standard_input(args: argparse.Namespace) -> Iterator[None]:
    """Of a command: if it reads standard input, that is kept in a temporary file from its first use to the end.

    Raises:
        UsageError: two arguments are standard input, or it is a terminal; or ``--from`` is of no use.
    """
    inputs = [path for path in _paths(args) if isinstance(path, StandardInput)]
    suffix = getattr(args, "from_suffix", None)
    if len(inputs) > 1:
        raise UsageError("standard input brings one scene only: '-' is given twice")
    if suffix is not None and not inputs:
        raise UsageError("--from is the format of standard input: give '-' as the scene")
    with contextlib.ExitStack() as stack:
        for path in inputs:
            if 0 in closed:
                raise UsageError("standard input is closed: pipe a scene into it, or give a name")
            with contextlib.suppress(OSError, ValueError, AttributeError):
                if sys.stdin.isatty():
                    raise UsageError("standard input is a terminal: pipe a scene into it, or give a name")
            path.source = lambda: received(sys.stdin.buffer, suffix)
            path.until = stack
        yield


def _paths(args: argparse.Namespace) -> Iterable[Any]:
    for value in vars(args).values():
        yield from value if isinstance(value, (list, tuple)) else [value]
