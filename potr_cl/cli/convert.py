"""The command convert: a scene from one format to another, as it is."""

from __future__ import annotations

import argparse

from potr_cl.cli.guard import ReadFile, WrittenFile
from potr_cl.cli.options import Commands
from potr_cl.cli.scenes import add_antialiased_option, add_trust_option, read_scene, size_of_file
from potr_cl.cli.terminal import say
from potr_cl.formats import scene_writer
from potr_cl.formats.registry import extras_needed, suffixes_read, suffixes_written


def _convert(args: argparse.Namespace) -> None:
    write = scene_writer(args.output)  # a wrong name is told before anything is read
    before = size_of_file(args.scene)
    scene = read_scene(args, args.scene)
    write(scene)
    after = size_of_file(args.output)
    say(f"{args.output}: {len(scene)} splats of SH degree {scene.sh_degree}, {after} bytes; {args.scene} has {before}")


def add_convert(commands: Commands) -> None:
    p = commands.add_parser(
        "convert",
        help="a scene from one format to another, for other tools",
        description=f"Read a scene ({suffixes_read()}) and write it as {suffixes_written()}. Nothing but what the "
        f"format itself rounds is changed; axes are kept. {extras_needed()}. All may be gzipped (.ply.gz). SOG is read "
        "from folders too (meta.json, lod-meta.json), level N of streamed SOG by FOLDER#N.",
    )
    p.add_argument("scene", type=ReadFile, metavar="IN")
    p.add_argument("output", type=WrittenFile, metavar="OUT")
    add_trust_option(p)
    add_antialiased_option(p)
    p.set_defaults(run=_convert)
