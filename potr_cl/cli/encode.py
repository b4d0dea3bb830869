"""The command encode: a scene to a .potr file, or to one that viewers open."""

from __future__ import annotations

import argparse
import contextlib
import time
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

from potr_cl.api.encoding import (
    Judge,
    by_photographs,
    check_photographs_have_cameras,
    encode_options,
    encode_target,
)
from potr_cl.cli.batch import Row, add_batch_options, for_each_scene, jobs
from potr_cl.cli.forecasts import tell_what_is_ahead
from potr_cl.cli.guard import CamerasBeside, StandardOutput, read_file
from potr_cl.cli.ladder import encode_ladder
from potr_cl.cli.options import SEVERAL, Commands, add_cluster_option, add_device_options, add_memory_option
from potr_cl.cli.outputs import WrittenEncoded, WrittenPage, place, writing
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import (
    add_antialiased_option,
    add_format_options,
    add_from_option,
    add_trust_option,
    format_choices,
    read_scene,
    size_of_file,
)
from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.cli.terminal import note, say_document, say_done, say_line
from potr_cl.cli.views import add_cameras_options, given_cameras, virtual_cameras
from potr_cl.errors import DeviceError, PotrError, UsageError
from potr_cl.formats.images import parse_colour
from potr_cl.formats.registry import suffixes_read
from potr_cl.host.atomic_write import replacing
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output
from potr_cl.outputs.registry import OUTPUTS, encoded_suffix, output_of, output_of_suffix, suffixes_encoded
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded, SharedOut
from potr_cl.pipeline.frame import frame_checked_beside
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import DEFAULT, PRESETS, PURPOSE
from potr_cl.pipeline.proof import Proved, proved
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.stopwatch import Stopwatch, added_up
from potr_cl.pipeline.target import Target
from potr_cl.quality.evaluator import EvaluationViews
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.report.html import PicturePair, html_report
from potr_cl.report.summary import decibels, encode_report, format_encode_report, search_report
from potr_cl.stages.refit import Refit
from potr_cl.workers.opening import Workers, open_workers
from potr_cl.workers.pool import Pool, Traffic


def _options(args: argparse.Namespace, source_bytes: int | None = None, output: Output | None = None) -> EncodeOptions:
    return encode_options(
        None, args.preset, stage_choices(args), output=output or _output(args), q=args.quality,
        background=args.background,
        memory=args.memory, threads=args.threads, source_bytes=source_bytes, cameras_anyway=args.cameras_anyway,
    )  # fmt: skip


def _output(args: argparse.Namespace) -> Output:
    """The kind of file that is made of one scene."""
    choices = format_choices(args)
    if isinstance(args.output, StandardOutput):
        return output_of_suffix(args.to, **choices)
    return output_of(args.output, **choices)


def _output_of_ladder(args: argparse.Namespace) -> Output:
    """The kind of file that a ladder has for each quality: what ``-o`` names is a folder."""
    return output_of_suffix(args.to or OUTPUTS[0].suffixes()[0], **format_choices(args))


def _looks(args: argparse.Namespace, options: EncodeOptions) -> bool:
    """Whether anything may be rendered: to encode, or to judge what was encoded."""
    wanted = any(s.asked_for and s.needs_views and not s.serves_others for s in options.stages)
    return wanted or not (args.cameras is None or args.no_quality)


@dataclass(frozen=True)
class _Shared:
    """What is asked for and read once, however many scenes there are.

    Attributes:
        target: a size or a PSNR to reach, if one is asked for.
        opened: what computes, which is opened while the first scene is read; None where none is needed.
        cameras: of the file that ``--cameras`` names; those beside a scene are its own.
        ground_truth: the photographs that ``--photos`` names.
    """

    target: Target | None
    opened: Future[Workers] | None
    cameras: list[Camera] | None
    ground_truth: GroundTruth | None


def _encode(args: argparse.Namespace) -> None:
    if args.ladder is not None:
        encode_ladder(args, _options(args, output=_output_of_ladder(args)))
        return
    works = jobs(args, WrittenEncoded, OUTPUTS[0].suffixes()[0])
    if not works:
        return
    options, target = _options(works[0]), encode_target(None, args.max_size, args.min_psnr)
    check_photographs_have_cameras(options, args.cameras is not None)
    if args.report is None and args.report_view is not None:
        raise UsageError("--report-view needs --report, the page that shows it")
    if args.report is not None and len(works) > 1:
        raise UsageError("--report is about one scene: encode one at a time")
    with contextlib.ExitStack() as stack:
        opened = stack.enter_context(thread_pool(1)).submit(_opened, args) if _looks(args, options) else None
        if opened is not None:
            stack.callback(_leave, opened)
        shared = _Shared(target, opened, None, None)
        if not isinstance(args.cameras, CamerasBeside):
            shared = _with_cameras(args, shared, options)
        if opened is not None and len(works) > 1:
            opened.result()  # no scene can do without it
        for_each_scene(works, lambda one: _encode_one(one, shared, several=len(works) > 1), args.json)


def _with_cameras(args: argparse.Namespace, shared: _Shared, options: EncodeOptions) -> _Shared:
    cameras, photographs = given_cameras(args), options.stage(Refit).ground_truth
    if photographs is None:
        return replace(shared, cameras=cameras)
    check_photographs_have_cameras(options, cameras is not None)
    assert cameras is not None
    cameras = within_photographs(cameras)
    return replace(shared, cameras=cameras, ground_truth=GroundTruth(photographs, cameras, options.background))


def _opened(args: argparse.Namespace) -> Workers:
    """What computes; the devices begin to load what the last encode with this preset has needed."""
    workers = open_workers(args.device, args.cluster)
    for device in workers.devices:
        device.prepare_for(f"encode {args.preset}")
    return workers


def _leave(opened: Future[Workers]) -> None:
    with contextlib.suppress(PotrError):
        opened.result().close()


def _encode_one(args: argparse.Namespace, shared: _Shared, several: bool) -> Row:
    began = time.perf_counter()
    options = _options(args, size_of_file(args.scene))
    if isinstance(args.cameras, CamerasBeside):
        shared = _with_cameras(args, shared, options)
    target, opened, cameras = shared.target, shared.opened, shared.cameras
    with contextlib.ExitStack() as stack:
        stack.enter_context(bounded(options.memory))
        progress = stack.enter_context(Progress())
        scene = read_scene(args, args.scene)
        with frame_checked_beside(scene, cameras, options.cameras_anyway):
            workers = opened.result() if opened is not None and options.look_at_views(scene) else None
            device, pool = (None, None) if workers is None else (workers.device, workers.pool)
            before = Traffic() if pool is None else replace(pool.traffic)
            kept = (
                None
                if device is None or target is not None
                else stack.enter_context(KeptScene(device, scene, options.memory, () if pool is None else pool.devices))
            )
        page = stack.enter_context(replacing(args.report)) if args.report is not None else None
        placing = Stopwatch(progress)
        search: dict[str, Any] | None = None
        with writing(args.output) as file:
            if cameras is None and device is not None:
                cameras = virtual_cameras(args, scene, placing, device)
            if device is not None and cameras is not None:
                tell_what_is_ahead(device, scene, cameras, options, kept)
            views = EvaluationViews.of(cameras) if cameras is not None and not args.no_quality else None
            if args.report_view is not None:
                _ = views and views.named(args.report_view)  # an unknown name is told before the work
            if target is None:
                encoded = encode(
                    scene, cameras, options, progress, device, kept=kept, in_frame=True, tell=progress.tell, pool=pool
                )
            else:
                found = encode_to_target(scene, cameras, target, options, progress, device, progress.tell, pool=pool)
                encoded, options, search = found.encoded, found.options, search_report(target, found)
            judged_on = None if views is None else encoded.device
            watch = Stopwatch(progress)
            if views is not None:
                watch("evaluate", 0.0)  # what is judged is what is read
            # What cannot be decoded must not replace what can.
            written = stack.enter_context(proved(encoded, args.trust, judged_on))
            file.write(written.data)
        pictures: list[PicturePair] = []
        quality: dict[str, Any] | str = "not judged, as asked"
        if views is not None:
            quality, pictures = _evaluate(
                args, scene, written, views, encoded.device, opened, watch, shared.ground_truth, kept
            )
        elif cameras is None:
            quality = "not judged: there are no cameras to look from"
        seconds = added_up(placing.seconds, encoded.seconds, watch.seconds) | {"total": time.perf_counter() - began}
        photographs = None
        if shared.ground_truth is not None and cameras is not None:
            photographs = _photographs(
                args, shared.ground_truth, cameras, (kept or scene, written.scene), encoded, device, pool
            )
        if pool is not None:
            encoded = replace(encoded, shared=SharedOut.by(pool, before))  # with what judging has added
        report = encode_report(
            args.scene, scene, args.output, written, encoded, options, search, quality, seconds, photographs,
            args.typed,
        )  # fmt: skip
        if page is not None:
            page.write(html_report(report, pictures).encode())
    if args.json:
        (say_line if several else say_document)(report)
    elif several:
        note(format_encode_report(report), "detail")
    else:
        say_done(format_encode_report(report))
    judged = report["quality"]
    psnr = "not judged" if isinstance(judged, str) else f"PSNR {decibels(judged['psnr'])}"
    return Row(report["source"]["bytes"], report["bytes"], psnr)


def _evaluate(
    args: argparse.Namespace,
    scene: Scene,
    written: Proved,
    views: EvaluationViews,
    device: Device | None,
    opened: Future[Workers] | None,
    watch: Stopwatch,
    ground_truth: GroundTruth | None,
    kept: KeptScene | None,
) -> tuple[dict[str, Any] | str, list[PicturePair]]:
    """The figures, or why there are none: a device that fails now must not take the finished file with it.

    With pictures for the report, if there is to be one.
    """
    watch("evaluate", 0.0)
    try:
        workers = None if opened is None else opened.result()
        judge = Judge(
            views,
            device or (Device(args.device) if workers is None else workers.device),
            parse_colour(args.background),
            ground_truth,
            kept,
            None if workers is None else workers.pool,
        )
        return judge(scene, written, watch, args.report_view, pictures=args.report is not None)
    except DeviceError as error:
        return f"not judged: {error}", []


def _photographs(
    args: argparse.Namespace,
    ground_truth: GroundTruth,
    cameras: list[Camera],
    scenes: tuple[Scene | KeptScene, Drawable],
    encoded: Encoded,
    device: Device | None,
    pool: Pool | None,
) -> dict[str, Any] | None:
    """What photographs say; a device that fails now must not take the finished file with it."""
    try:
        found = by_photographs(
            ground_truth, cameras, encoded, scenes, encoded.device or device or Device(args.device),
            parse_colour(args.background), pool,
        )  # fmt: skip
    except DeviceError as error:
        note(f"warning: not judged by photographs: {error}", "warning")
        return None
    if found["missing"] is not None:
        note(f"warning: {found['missing']}", "warning")
    if found["file"] < found["uncompressed"] and encoded.photographs is not None and encoded.photographs.kept:
        lost = found["uncompressed"] - found["file"]
        note(
            f"warning: on {found['kind']} photographs the file is {lost:.2f} dB worse than the uncompressed scene",
            "warning",
        )
    return found


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
