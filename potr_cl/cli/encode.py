"""The command encode: a scene to a .potr file."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
from pathlib import Path

from potr_cl.atomic_write import replacing
from potr_cl.bitstream import EntropyCoder
from potr_cl.cli.options import (
    Commands,
    add_compaction_options,
    add_pruning_options,
    compaction_choices,
    count,
    sweep_options,
)
from potr_cl.cli.progress import Progress
from potr_cl.device import Device
from potr_cl.encoder import encode
from potr_cl.errors import UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.images import parse_colour
from potr_cl.options import EncodeOptions


def _encode(args: argparse.Namespace) -> None:
    if args.threads < 0:
        raise UsageError(f"--threads is {args.threads}, it must be 0 or more")
    options = EncodeOptions(
        q=args.quality,
        delta_mse_max=args.delta_mse_max,
        **compaction_choices(args),
        prune=not args.no_prune,
        iterations=args.iterations,
        compact=not args.no_compact,
        compact_at=args.compact_at,
        sweep=sweep_options(args),
        background=parse_colour(args.background),
        beta=args.beta,
        gamma=args.gamma,
        sf_sh=args.sf_sh,
        sf_opacity=args.sf_opacity,
        sf_rotation=args.sf_rotation,
        sf_scale=args.sf_scale,
        entropy=EntropyCoder(args.entropy, args.zstd_level),
        threads=args.threads,
        source_bytes=args.scene.stat().st_size if args.scene.is_file() else None,
    )
    _ = options.parameters  # a wrong option is told before a gigabyte is read
    cameras = load_cameras(args.cameras) if args.cameras is not None else None
    if cameras is None and (args.keep is not None or args.count is not None):
        raise UsageError("--keep and --count need --cameras, the views that show which splats matter")
    scene = load_scene(args.scene)
    options = dataclasses.replace(options, count=count(args, len(scene)))
    device = Device(args.device) if (options.prune or options.compact) and cameras is not None else None
    with replacing(args.output) as file, contextlib.closing(Progress()) as progress:
        encoded = encode(scene, cameras, options, progress, device)
        for piece in encoded.pieces:
            file.write(piece)
    if (options.prune or options.compact) and cameras is None:
        print("every splat and colour was kept: give --cameras to remove what no view misses", file=sys.stderr)
    before = options.source_bytes or scene.nbytes
    kept = len(encoded.order)
    print(
        f"{args.output}: {kept} of {len(scene)} splats, {encoded.nbytes} bytes, "
        f"{encoded.nbytes / kept:.2f} bytes a splat, {before / encoded.nbytes:.1f} times smaller"
    )


def add_encode(commands: Commands) -> None:
    p = commands.add_parser("encode", help="a scene (.ply) to a .potr file")
    p.add_argument("scene", type=Path, metavar="SCENE.ply")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.potr")
    p.add_argument(
        "-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (smallest) to 1 (best); default 0.5"
    )
    p.add_argument(
        "--cameras",
        type=Path,
        metavar="PATH",
        help="cameras.json, transforms.json, or a COLMAP model's folder: with them, splats that no view misses are "
        "removed, and far ones placed more coarsely",
    )
    p.add_argument("--no-prune", action="store_true", help="keep every splat")
    add_pruning_options(p)
    p.add_argument("--no-compact", action="store_true", help="keep the colours' coefficients as they are")
    p.add_argument(
        "--compact-at",
        type=float,
        default=EncodeOptions.compact_at,
        metavar="PART",
        help=f"of the pruning iterations after which colours are compacted; default {EncodeOptions.compact_at:g}",
    )
    p.add_argument(
        "--entropy", choices=("zstd", "npz"), default="zstd", help="npz: deflate, as NumPy's compressed files use"
    )
    p.add_argument("--zstd-level", type=int, default=19, metavar="L", help="1 (fast) to 22 (small); default 19")
    p.add_argument("--threads", type=int, default=0, metavar="T", help="default: one a processor")
    single = p.add_argument_group("single parameters (each is set by -q otherwise)")
    single.add_argument("--gamma", type=float, metavar="UNITS", help="least distance a centre may move, world units")
    single.add_argument(
        "--beta", type=float, metavar="PART", help="the same as a part of the nearest camera's distance"
    )
    for name, what in (
        ("sh", "SH coefficients"),
        ("opacity", "opacities"),
        ("rotation", "quaternions"),
        ("scale", "standard deviations"),
    ):
        single.add_argument(f"--sf-{name}", type=float, metavar="SF", help=f"steps a unit for {what}")
    add_compaction_options(single)
    p.set_defaults(run=_encode)
