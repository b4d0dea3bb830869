"""The command convert: scenes from one format to another, as they are."""

from __future__ import annotations

import argparse

from potr_cl.cli.batch import add_batch_options, for_each_scene, jobs
from potr_cl.cli.guard import StandardOutput, read_file
from potr_cl.cli.options import Commands
from potr_cl.cli.outputs import WrittenScene, place
from potr_cl.cli.scenes import (
    add_antialiased_option,
    add_format_options,
    add_from_option,
    add_trust_option,
    as_file,
    format_choices,
    read_scene,
    size_of_file,
    write_scene,
)
from potr_cl.cli.terminal import say_done
from potr_cl.errors import UsageError
from potr_cl.formats import scene_writer
from potr_cl.formats.registry import extras_needed, suffixes_read, suffixes_written
from potr_cl.formats.scenes import page


def _arrange(args: argparse.Namespace) -> None:
    """Without -o the last name is the output's."""
    if args.output is not None:
        return
    if len(args.scenes) != 2:
        raise UsageError("usage: convert IN OUT, or convert IN … --to .spz -o FOLDER")
    args.output = place(str(args.scenes.pop()))


def _convert(args: argparse.Namespace) -> None:
    works = jobs(args, WrittenScene, None)
    for work in works:  # a choice that the format has not is reported before anything is read
        name = f"scene{work.to}" if isinstance(work.output, StandardOutput) else work.output
        scene_writer(name, **format_choices(args))
    for_each_scene(works, _convert_one)


def _convert_one(args: argparse.Namespace) -> None:
    before = size_of_file(args.scene)
    scene = read_scene(args, args.scene)
    with as_file(args.scene) as source:
        kept = source if args.antialiased == "auto" else None
        after = write_scene(args.output, scene, args.to, **format_choices(args), source=kept)
    said = f"{len(scene):,} splats of SH degree {scene.sh_degree}, {after:,} bytes"
    if args.output.suffix.lower() in page.FORMAT.suffixes:
        said += f" ({page.TEMPLATE.stat().st_size:,} of them the viewer)"
    say_done(f"{args.output}: {said}; {args.scene} has {before:,}")


def add_convert(commands: Commands) -> None:
    p = commands.add_parser(
        "convert",
        help="a scene from one format to another, for other tools",
        usage="potr-cl convert IN OUT [options]\n       potr-cl convert IN [IN ...] -o FOLDER --to SUFFIX [options]",
        description=f"Read a scene ({suffixes_read()}) and write it as {suffixes_written()}. Nothing but what the "
        "format itself rounds is changed; axes are kept. All may be gzipped (.ply.gz). SOG is read "
        f"from folders too (meta.json, lod-meta.json), level N of streamed SOG by FOLDER#N; {extras_needed()}.",
    )
    p.add_argument(
        "scenes",
        type=read_file,
        nargs="+",
        metavar="IN",
        help='scenes, or "-" for standard input; without -o the last name is the one to write, "-" for standard output',
    )
    p.add_argument("-o", "--output", type=place, metavar="OUT", help='a file, a folder, or "-" for standard output')
    add_batch_options(p)
    add_from_option(p)
    add_format_options(p)
    add_trust_option(p)
    add_antialiased_option(p)
    p.set_defaults(run=_convert, arrange=_arrange)
