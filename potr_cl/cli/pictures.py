"""The commands that render: render, compare."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from potr_cl.api.comparing import SceneComparison, coded_for, compare_scenes, named
from potr_cl.api.inputs import chosen_views
from potr_cl.api.pictures import make_folder, picture_files, written_pictures
from potr_cl.api.views import Viewpoints, told
from potr_cl.cli.guard import (
    ReadCameras,
    ReadFile,
    ReadPhotographs,
    StandardInput,
    WrittenFolder,
    check_files,
    check_photographs,
)
from potr_cl.cli.options import (
    CAMERAS_HELP,
    SEVERAL,
    Commands,
    add_cluster_option,
    add_rendering_options,
    add_view_options,
)
from potr_cl.cli.outputs import WrittenPicture
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import ANTIALIASED, add_antialiased_option, add_trust_option, read_scene, read_to_draw
from potr_cl.cli.terminal import note, say, say_document, say_done
from potr_cl.cli.views import read_cameras, warn_of_frame
from potr_cl.errors import UsageError, WriteError
from potr_cl.formats.images import parse_colour
from potr_cl.formats.registry import suffixes_read
from potr_cl.host.atomic_write import replacing
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.outputs.coded_scene import CodedScene
from potr_cl.placement.viewpoints import AXES, SIZE, VIEWS
from potr_cl.quality.compare import format_sizes, size_report
from potr_cl.raster.rules import RULES
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.views.pictures import rasterizer_for
from potr_cl.workers.opening import Workers, open_workers


def _add_viewpoints(p: argparse.ArgumentParser) -> None:
    """What to look from without ``--cameras``."""
    where = p.add_argument_group("views without --cameras")
    which = where.add_mutually_exclusive_group()
    which.add_argument(
        "--virtual-views",
        type=whole_number,
        metavar="N",
        help=f"number of virtual views without --cameras; default {VIEWS}",
    )
    which.add_argument(
        "--turntable", type=whole_number, metavar="N", help="place N views on a circle around the scene instead"
    )
    where.add_argument(
        "--up",
        metavar="AXIS",
        help=f"which way is up in these views: {', '.join(AXES)} (write --up=-y), X,Y,Z or auto; default auto, a guess",
    )
    where.add_argument(
        "--size", type=whole_number, metavar="PIXELS", help=f"side of their square pictures; default {SIZE}"
    )


def _viewpoints(args: argparse.Namespace) -> Viewpoints:
    points = Viewpoints(args.virtual_views, args.turntable, args.up, args.size)
    if args.cameras is not None:
        points.refuse_with_cameras()
    return points


def _render(args: argparse.Namespace) -> None:
    background = parse_colour(args.background)  # a wrong option is told before anything is read
    points = _viewpoints(args)
    cameras = None if args.cameras is None else read_cameras(args)
    scene, device = None, Device(args.device)
    if cameras is None:
        scene = read_scene(args, args.scene)
        cameras = points.placed(scene, device)
        note(f"no --cameras given: {told(cameras)}")
    views = chosen_views(cameras, args.views, None if args.views is not None else args.split or "all")
    written = picture_files(args.output, views)
    check_files(args, written)
    check_photographs(args, cameras, written)
    make_folder(args.output)
    stage = f"rendering {len(views)} view{'s' if len(views) > 1 else ''}"
    with contextlib.ExitStack() as stack:
        if scene is not None:
            drawable: Drawable = scene
        else:
            drawable, judged = stack.enter_context(read_to_draw(args, args.scene, device))
            warn_of_frame(args.scene, judged, views)
        rasterizer = rasterizer_for(device, drawable, views, RULES[args.rules], background)
        stack.callback(rasterizer.close)
        progress = stack.enter_context(Progress())
        progress(stage, 0.0)
        for done, _ in enumerate(written_pictures(rasterizer, views, written), 1):
            progress(stage, done / len(views))
    say_done(f"{args.output}: {len(views)} image{'s' if len(views) > 1 else ''}, rendered on {device.info}")


def add_render(commands: Commands) -> None:
    p = commands.add_parser("render", help="pictures (.png) of a scene from its cameras, or from all around")
    p.add_argument("scene", type=ReadFile, metavar="SCENE", help="the scene to draw")
    p.add_argument("--cameras", type=ReadCameras, metavar="PATH", help=f"{CAMERAS_HELP}; without it, views are placed")
    p.add_argument(
        "-o", "--output", type=WrittenFolder, required=True, metavar="DIR", help="one file per view, named after it"
    )
    add_view_options(p, "all")
    _add_viewpoints(p)
    add_trust_option(p)
    add_antialiased_option(p)
    add_rendering_options(p)
    p.set_defaults(run=_render)


def _compare(args: argparse.Namespace) -> None:
    background = parse_colour(args.background)
    points = _viewpoints(args)
    if args.cameras is None and args.truth is not None:
        raise UsageError("--truth needs --cameras, the views that the photographs show")
    given = [args.views, args.split, args.output, args.device, args.cluster]
    pictures_asked_for = any(each is not None for each in given) or points.asked_for
    cameras = None if args.cameras is None else read_cameras(args)
    if cameras is None and not pictures_asked_for and not list_devices():
        # Sizes need no device, and may be all that is wanted of a machine without one.
        files = [named(path, read_scene(args, path)) for path in (args.a, args.b)]
        _tell(args, size_report(*files), format_sizes(*files))
        note("warning: sizes only: there is no OpenCL device to compare pictures on", "warning")
        return
    comparison: SceneComparison | None = None
    try:
        with contextlib.ExitStack() as stack:
            drawables: list[Drawable] = []
            coded: list[CodedScene | None] = []
            if cameras is None:
                scenes = [read_scene(args, path) for path in (args.a, args.b)]
                workers = stack.enter_context(open_workers(args.device, args.cluster))
                cameras = points.judging(scenes[0], workers.device)
                note(f"no --cameras given: {told(cameras)}. A scene encoded with cameras looks best from those.")
                drawables += scenes
                views = chosen_views(cameras, args.views, args.split)
                coded += [_coded(args, path, workers) for path in (args.a, args.b)]
            else:
                views = chosen_views(cameras, args.views, args.split)
                workers = stack.enter_context(open_workers(args.device, args.cluster))
                for path in (args.a, args.b):
                    coded.append(_coded(args, path, workers))
                    drawable, judged = stack.enter_context(read_to_draw(args, path, workers.device, coded[-1]))
                    warn_of_frame(path, judged, views)
                    drawables.append(drawable)
            a, b = drawables
            picture = stack.enter_context(replacing(args.output)) if args.output is not None else None
            progress = stack.enter_context(Progress())
            comparison = compare_scenes(
                (named(args.a, a), a), (named(args.b, b), b), views,
                workers=workers, rules=RULES[args.rules], background=background, truth=args.truth, lpips=args.lpips,
                progress=progress,
                coded=coded,
            )  # fmt: skip
            if picture is not None:
                comparison.write_picture(picture)
    except WriteError:
        if comparison is not None:  # the figures are not lost with the picture
            _tell(args, comparison.report(), str(comparison))
        raise
    if args.output is not None:
        comparison.notes.append(f"{args.output}: {comparison.caption}")
    _tell(args, comparison.report(), str(comparison))


def _coded(args: argparse.Namespace, path: Path, workers: Workers) -> CodedScene | None:
    """The file for other computers, where it may be sent to them as it is."""
    as_it_says = ANTIALIASED[args.antialiased] is None and not isinstance(path, StandardInput)
    return coded_for(workers, path, args.trust) if as_it_says else None


def _tell(args: argparse.Namespace, report: dict[str, object], text: str) -> None:
    if args.json:
        say_document(report)
    else:
        say(text)


def add_compare(commands: Commands) -> None:
    p = commands.add_parser(
        "compare",
        help="what compression costs: PSNR and SSIM of one scene's pictures against another's, and sizes",
        description="Render two scenes from the same views and compare. A PSNR is in decibels, a mean is over views. "
        "In JSON a PSNR of null means identical pictures.",
    )
    p.add_argument("a", type=ReadFile, metavar="A", help=f"the uncompressed scene: {suffixes_read()}")
    p.add_argument("b", type=ReadFile, metavar="B", help="the scene to judge")
    p.add_argument("--cameras", type=ReadCameras, metavar="PATH", help=f"{CAMERAS_HELP}; without it, views are placed")
    p.add_argument(
        "--truth", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views: judge A and B by them"
    )
    p.add_argument("--lpips", action="store_true", help="also compute LPIPS; needs the extra lpips and its weights")
    add_view_options(p, "test views if there are any, else all")
    p.add_argument(
        "-o",
        "--output",
        type=WrittenPicture,
        metavar="OUT.png",
        help="the worst view: A, B, and their difference, labelled",
    )
    _add_viewpoints(p)
    p.add_argument("--json", action="store_true", help="print JSON")
    add_trust_option(p)
    add_antialiased_option(p)
    add_rendering_options(p, SEVERAL)
    add_cluster_option(p)
    p.set_defaults(run=_compare)
