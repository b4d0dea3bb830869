"""The commands about files: decode, info, convert."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from potr_cl.api.files import decode, decode_block_by_block
from potr_cl.cli.batch import add_batch_options, for_each_scene, jobs
from potr_cl.cli.guard import StandardOutput, read_file
from potr_cl.cli.outputs import WrittenScene, place
from potr_cl.cli.parser import whole_number
from potr_cl.cli.scenes import (
    add_antialiased_option,
    add_format_options,
    add_from_option,
    add_trust_option,
    as_file,
    format_choices,
    read_scene,
    size_of_file,
    trust,
    write_scene,
)
from potr_cl.cli.terminal import say, say_document, say_done
from potr_cl.errors import UsageError
from potr_cl.formats import scene_writer
from potr_cl.formats.registry import suffixes_read, suffixes_written
from potr_cl.formats.scenes import page
from potr_cl.model.scene import SH_COEFFICIENTS

if TYPE_CHECKING:
    from potr_cl.cli.options import Commands


def _decode(args: argparse.Namespace) -> None:
    for_each_scene(jobs(args, WrittenScene, ".ply"), _decode_one)


def _decode_one(args: argparse.Namespace) -> None:
    started = time.perf_counter()
    with as_file(args.scene) as file:
        if args.box is None and not isinstance(args.output, StandardOutput):
            splats = decode_block_by_block(
                file, args.output, args.trust, args.sh_degree, args.level, args.splats
            )  # fmt: skip
            if splats is not None:
                seconds = time.perf_counter() - started
                say_done(f"{args.output}: {splats:,} splats, decoded and written in {seconds:.2f} s")
                return
        scene = decode(file, args.trust, args.sh_degree, box=args.box, level=args.level, splats=args.splats)
    decoded = time.perf_counter()
    write_scene(args.output, scene, args.to)
    written = time.perf_counter()
    say_done(
        f"{args.output}: {len(scene):,} splats, decoded in {decoded - started:.2f} s, "
        f"written in {written - decoded:.2f} s"
    )


def add_decode(commands: Commands) -> None:
    p = commands.add_parser("decode", help="a .potr file to a .ply that every viewer opens, or to another format")
    p.add_argument(
        "scenes", type=read_file, nargs="+", metavar="IN.potr", help='.potr files, or "-" for standard input'
    )
    p.add_argument(
        "-o",
        "--output",
        type=place,
        required=True,
        metavar="OUT.ply",
        help=f'{suffixes_written()}, a folder, or "-" for standard output',
    )
    add_batch_options(p)
    p.add_argument(
        "--sh-degree", type=int, choices=range(len(SH_COEFFICIENTS)), metavar="N",
        help="skip SH degrees above N, 0 to 3, without decoding them; default: none",
    )  # fmt: skip
    p.add_argument(
        "--box", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="skip splats whose centres lie outside this box, in world units; of a file of blocks only those "
        "that meet the box are read; default: none",
    )  # fmt: skip
    size = p.add_mutually_exclusive_group()
    size.add_argument(
        "--level", type=whole_number, metavar="K", help="the level of detail, 0 is the finest; default: 0"
    )
    size.add_argument(
        "--splats", type=whole_number, metavar="N", help="the finest level of detail with at most N splats"
    )
    add_trust_option(p)
    p.set_defaults(run=_decode)


def _info(args: argparse.Namespace) -> None:
    # Imported here: to decode takes less time than to import what this needs.
    from potr_cl.api.describing import info

    with as_file(args.file) as file:
        found = info(file, **trust(args))
    if args.json:
        say_document(found.facts | {"file": str(args.file)})  # standard input is kept in a file of another name
    else:
        say(found)


def add_info(commands: Commands) -> None:
    p = commands.add_parser(
        "info",
        help="what a scene holds and what looks wrong with it; of a .potr file also where its bytes are",
        description=f"Reads every kind of scene: {suffixes_read()}. Says how many splats it has, how large it is, how "
        "its opacities and scales are spread, and what looks suspicious.",
    )
    p.add_argument("file", type=read_file, metavar="SCENE", help='a scene in any format, or "-" for standard input')
    p.add_argument("--json", action="store_true", help="print JSON")
    add_from_option(p)
    add_trust_option(p)
    p.set_defaults(run=_info)


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
        "from folders too (meta.json, lod-meta.json, tileset.json), level N of streamed SOG by FOLDER#N.",
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
