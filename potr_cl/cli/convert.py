"""The command convert: a scene from one format to another, as it is."""

from __future__ import annotations

import argparse
from pathlib import Path

from potr_cl.cli.options import Commands
from potr_cl.errors import UsageError
from potr_cl.formats import load_scene, scene_writer
from potr_cl.formats.registry import extras_needed, suffixes_read, suffixes_written


def _convert(args: argparse.Namespace) -> None:
    write = scene_writer(args.output)  # a wrong name is told before anything is read
    if args.output.resolve() == args.scene.resolve():
        raise UsageError(f"'{args.scene}' would be replaced by itself: give another name for the output")
    before = args.scene.stat().st_size if args.scene.is_file() else 0
    scene = load_scene(args.scene)
    write(scene)
    after = args.output.stat().st_size
    print(
        f"{args.output}: {len(scene)} splats of SH degree {scene.sh_degree}, {after} bytes; {args.scene} has {before}"
    )


def add_convert(commands: Commands) -> None:
    p = commands.add_parser(
        "convert",
        help="a scene from one format to another, for other tools",
        description=f"Read a scene ({suffixes_read()}) and write it as {suffixes_written()}. Nothing but what the "
        f"format itself rounds is changed; axes are kept. {extras_needed()}.",
    )
    p.add_argument("scene", type=Path, metavar="IN")
    p.add_argument("output", type=Path, metavar="OUT")
    p.set_defaults(run=_convert)
