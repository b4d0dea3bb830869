"""The command encode: a scene to a .potr file, or to one that viewers open; with --ladder, to several files."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from potr_cl.api.choices import DEFAULT, PRESETS, PURPOSE, encode_options, encode_target
from potr_cl.api.encoder import Encoder, ladder_files
from potr_cl.cli.batch import Row, add_batch_options, for_each_scene, jobs
from potr_cl.cli.guard import CamerasBeside, StandardInput, StandardOutput, WrittenFolder, check_files, read_file
from potr_cl.cli.options import (
    SEVERAL,
    Commands,
    add_cameras_options,
    add_cluster_option,
    add_device_options,
    add_memory_option,
    given_cameras,
)
from potr_cl.cli.outputs import WrittenEncoded, WrittenPage, place, writing
from potr_cl.cli.parser import number_or_auto, whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import (
    ANTIALIASED,
    add_antialiased_option,
    add_format_options,
    add_from_option,
    add_trust_option,
    as_file,
    format_choices,
)
from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.cli.terminal import note, say_document, say_done, say_line
from potr_cl.errors import UsageError
from potr_cl.formats.ladder import Ladder, qualities
from potr_cl.formats.registry import cameras_beside, extensions, suffixes_read
from potr_cl.outputs.output import Output
from potr_cl.outputs.registry import OUTPUTS, encoded_suffix, output_of, output_of_suffix, suffixes_encoded
from potr_cl.report.summary import decibels


def _encoder(args: argparse.Namespace, output: Output) -> Encoder:
    """What the arguments ask for, checked before anything is read."""
    options = encode_options(
        None, args.preset, stage_choices(args), output=output, q=args.quality, background=args.background,
        memory=args.memory, threads=args.threads, cameras_anyway=args.cameras_anyway, levels=args.levels,
    )  # fmt: skip
    target = encode_target(None, args.max_size, args.min_psnr)
    beside = isinstance(args.cameras, CamerasBeside)
    return Encoder(
        options, target, None if beside else given_cameras(args), beside=beside, virtual_views=args.virtual_views,
        device=args.device, cluster=args.cluster, judge=not args.no_quality, trust=args.trust,
        antialiased=ANTIALIASED[args.antialiased],
    )  # fmt: skip


def _choices(args: argparse.Namespace) -> dict[str, Any]:
    """What only some kinds of files leave to choose; None where it is not given."""
    chunks = {"lod_chunk_count": args.lod_chunk_count, "lod_chunk_extent": args.lod_chunk_extent}
    return format_choices(args) | chunks


def _encode(args: argparse.Namespace) -> None:
    if args.ladder is not None:
        _ladder(args)
        return
    works = jobs(args, WrittenEncoded, OUTPUTS[0].suffixes()[0])
    if not works:
        return
    if args.report is None and args.report_view is not None:
        raise UsageError("--report-view needs --report, the page that shows it")
    if args.report is not None and len(works) > 1:
        raise UsageError("--report is about one scene: encode one at a time")
    choices, first = _choices(args), works[0]
    streamed = isinstance(first.output, StandardOutput)
    output = output_of_suffix(first.to, **choices) if streamed else output_of(first.output, **choices)
    several = len(works) > 1
    with _encoder(args, output) as encoder:
        if several:
            _ = encoder.workers  # no scene can do without what computes
        for_each_scene(works, lambda one: _encode_one(one, encoder, several), args.json)


def _encode_one(args: argparse.Namespace, encoder: Encoder, several: bool) -> Row:
    if isinstance(args.cameras, CamerasBeside):
        encoder.look_from(given_cameras(args))
    streamed = isinstance(args.output, StandardOutput)
    with as_file(args.scene) as scene, Progress() as progress:
        encoded = encoder(
            scene, None if streamed else args.output, name=args.scene, report=args.report, report_view=args.report_view,
            progress=progress, command=args.typed,
        )  # fmt: skip
    report = encoded.report
    if streamed:
        report["file"] = str(args.output)
        with writing(args.output) as result:
            result.write(encoded.data)
    if args.json:
        (say_line if several else say_document)(report)
    elif several:
        note(report, "detail")
    else:
        say_done(report)
    judged = report["quality"]
    psnr = "not judged" if isinstance(judged, str) else f"PSNR {decibels(judged['psnr'])}"
    return Row(report["source"]["bytes"], report["bytes"], psnr)


def _ladder(args: argparse.Namespace) -> None:
    """One scene at several qualities, into a folder."""
    steps = qualities(args.ladder)
    if args.report is not None:
        raise UsageError("--report is about one file: leave out --ladder")
    if len(args.scenes) > 1:
        raise UsageError("--ladder is of one scene: encode one at a time")
    args.scene = args.scenes[0]
    if isinstance(args.output, StandardOutput):
        raise UsageError("--ladder writes several files: give -o a folder")
    named_as_file = args.output.exists() or args.output.suffix.lower() in extensions()
    if not isinstance(args.output, WrittenFolder) and named_as_file:
        raise UsageError(f"--ladder writes several files: give -o a folder instead of '{args.output}'")
    output = output_of_suffix(args.to or OUTPUTS[0].suffixes()[0], **_choices(args))
    name = Path("scene") if isinstance(args.scene, StandardInput) else Path(args.scene)
    check_files(args, ladder_files(args.output, name, steps, output.suffix))
    with _encoder(args, output) as encoder, as_file(args.scene) as scene, Progress() as progress:
        if isinstance(args.cameras, CamerasBeside):
            encoder.look_from(given_cameras(args))
        ladder = encoder.ladder(scene, steps, Path(args.output), name=name, progress=progress)
    if args.json:
        say_document(ladder.document())
    else:
        say_done(f"{_table(ladder)}\nlook at them: {_view_command(args)}")


def _view_command(args: argparse.Namespace) -> str:
    """What shows a ladder, with the cameras that it was encoded with."""
    scene = "SCENE" if isinstance(args.scene, StandardInput) else str(args.scene)
    cameras = cameras_beside(args.scene) if isinstance(args.cameras, CamerasBeside) else args.cameras
    given = [] if cameras is None else ["--cameras", str(cameras)]
    return shlex.join(["potr-cl", "view", scene, str(args.output), *given])


def _table(ladder: Ladder) -> str:
    rows = [f"{'q':>8}{'bytes':>14}{'splats':>12}{'PSNR':>12}{'SSIM':>9}"]
    for rung in ladder.rungs:
        judged = rung.ssim is not None
        psnr, ssim = (decibels(rung.psnr), f"{rung.ssim:.4f}") if judged else ("–", "–")
        rows.append(f"{rung.q:>8g}{rung.bytes:>14,}{rung.splats:>12,}{psnr:>12}{ssim:>9}")
    if ladder.judged_by:
        rows.append(f"judged by {ladder.judged_by}")
    return "\n".join(rows)


def add_encode(commands: Commands) -> None:
    p = commands.add_parser(
        "encode", help="a scene (.ply) to a .potr file or one that viewers open, or several into a folder"
    )
    p.add_argument(
        "scenes",
        type=read_file,
        nargs="+",
        metavar="SCENE.ply",
        help=f'{suffixes_read()}, or "-" for standard input; several scenes share the cameras',
    )
    p.add_argument(
        "-o",
        "--output",
        type=place,
        required=True,
        metavar="OUT.potr",
        help=f'{suffixes_encoded()}, a folder, or "-" for standard output; .potr is the smallest',
    )
    add_batch_options(p)
    add_format_options(p)
    goal = p.add_mutually_exclusive_group()
    goal.add_argument(
        "-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (smallest) to 1 (best); default 0.5"
    )
    goal.add_argument(
        "--max-size", metavar="SIZE", help="find the quality that fills this size: 8MB, 8MiB, 800k, or bytes"
    )
    goal.add_argument(
        "--min-psnr",
        type=float,
        metavar="DB",
        help="find the quality that just reaches this mean PSNR against the uncompressed scene, on the judging views",
    )
    goal.add_argument(
        "--ladder",
        metavar="Q,Q,…",
        help="one file per quality, such as 0.1,0.3,0.5, and a ladder.json with sizes and PSNR, into the folder -o; "
        "view then has a slider to choose among them",
    )
    p.add_argument(
        "--preset",
        choices=tuple(PRESETS),
        default=DEFAULT,
        help="; ".join(f"{name}: {purpose}" for name, purpose in PURPOSE.items()) + f"; default: {DEFAULT}",
    )
    p.add_argument(
        "--levels",
        type=number_or_auto,
        metavar="N|auto",
        help="levels of detail in the file, each with half the splats of the one before, made for views half as large; "
        "auto: until one has fewer than 30,000, at most 6; default: 1 in .potr files, auto in lod-meta.json "
        "and tileset.json",
    )
    p.add_argument(
        "--lod-chunk-count",
        type=whole_number,
        metavar="K",
        help="of lod-meta.json and tileset.json: most splats of a leaf of the tree, in thousands (1024); default 512, "
        "and 128",
    )
    p.add_argument(
        "--lod-chunk-extent",
        type=float,
        metavar="UNITS",
        help="of the same: the largest side of a leaf, in world units; default 16",
    )
    add_cameras_options(p)
    p.add_argument("--no-quality", action="store_true", help="skip judging the result; saves time")
    p.add_argument("--json", action="store_true", help="print the summary as JSON; one line per scene")
    p.add_argument(
        "--report",
        type=WrittenPage,
        metavar="OUT.html",
        help="write a page with sizes, quality by view, pictures before and after, and the course of pruning",
    )
    p.add_argument("--report-view", metavar="NAME", help="an additional judging view to show in the report")
    add_stage_flags(p)
    p.add_argument(
        "--threads", type=whole_number, default=0, metavar="T", help="host threads (default: one per processor)"
    )
    add_from_option(p)
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p, " and the re-fit; larger scenes use temporary files")
    add_device_options(p, SEVERAL)
    add_cluster_option(p)
    p.set_defaults(run=_encode, checked_suffix=encoded_suffix)
