"""The command encode: a scene to a .potr file."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import time
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
from potr_cl.cli.views import add_cameras_options, given_cameras, virtual_cameras
from potr_cl.compare import Comparison
from potr_cl.decoder import PotrFile, decode
from potr_cl.device import Device
from potr_cl.encoder import Stopwatch, encode, needs_views
from potr_cl.errors import DeviceError, UsageError
from potr_cl.formats import load_scene
from potr_cl.images import parse_colour
from potr_cl.judging import Judge, JudgingViews
from potr_cl.options import EncodeOptions
from potr_cl.scene import Scene
from potr_cl.summary import encode_report, format_encode_report


def _options(args: argparse.Namespace) -> EncodeOptions:
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
    return options


def _encode(args: argparse.Namespace) -> None:
    began = time.perf_counter()
    options = _options(args)
    cameras = given_cameras(args)
    scene = load_scene(args.scene)
    options = dataclasses.replace(options, count=count(args, len(scene)))
    device = Device(args.device) if needs_views(scene, options) else None
    with contextlib.closing(Progress()) as progress:
        placing = Stopwatch(progress)
        with replacing(args.output) as file:
            if cameras is None and device is not None:
                cameras = virtual_cameras(args, scene, placing)
            encoded = encode(scene, cameras, options, progress, device)
            for piece in encoded.pieces:
                file.write(piece)
        written = PotrFile.from_bytes(b"".join(encoded.pieces))
        watch = Stopwatch(progress)
        quality: tuple[JudgingViews, Comparison] | str
        if args.no_quality:
            quality = "not judged, as asked"
        elif cameras is None:
            quality = "not judged: there are no cameras to look from"
        else:
            quality = _judge(args, scene, written, JudgingViews.of(cameras), encoded.device or device, watch)
    seconds = placing.seconds | encoded.seconds | watch.seconds | {"total": time.perf_counter() - began}
    report = encode_report(args.scene, scene, args.output, written, encoded, options, quality, seconds)
    print(json.dumps(report, indent=1, allow_nan=False) if args.json else format_encode_report(report))


def _judge(
    args: argparse.Namespace,
    scene: Scene,
    written: PotrFile,
    views: JudgingViews,
    device: Device | None,
    watch: Stopwatch,
) -> tuple[JudgingViews, Comparison] | str:
    """The figures, or why there are none: a device that fails now must not take the finished file with it."""
    watch("judge", 0.0)
    try:
        judge = Judge(device or Device(args.device), scene, views, parse_colour(args.background))
        try:
            return views, judge.compare(decode(written.data), lambda _, done: watch("judge", done))
        finally:
            judge.free()
    except DeviceError as error:
        return f"not judged: {error}"


def add_encode(commands: Commands) -> None:
    p = commands.add_parser("encode", help="a scene (.ply) to a .potr file")
    p.add_argument("scene", type=Path, metavar="SCENE.ply")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.potr")
    p.add_argument(
        "-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (smallest) to 1 (best); default 0.5"
    )
    add_cameras_options(p)
    p.add_argument("--no-quality", action="store_true", help="do not judge the result; saves time")
    p.add_argument("--json", action="store_true", help="the summary for programs")
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
