"""The commands that render: render, compare."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from potr_cl.api.budgets import compare_budgets
from potr_cl.api.comparing import compare, compare_sizes
from potr_cl.api.pictures import render_to_files
from potr_cl.api.views import AXES, SIZE, VIEWS, ViewChoices, Viewpoints
from potr_cl.cli.guard import ReadCameras, ReadFile, ReadPhotographs, WrittenFolder, check_files, check_photographs
from potr_cl.cli.options import (
    CAMERAS_HELP,
    SEVERAL,
    Commands,
    add_cluster_option,
    add_rendering_options,
    add_view_options,
    read_cameras,
)
from potr_cl.cli.outputs import WrittenPage, WrittenPicture
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import ANTIALIASED, add_antialiased_option, add_trust_option
from potr_cl.cli.terminal import note, say, say_document, say_done
from potr_cl.errors import UsageError
from potr_cl.formats.registry import suffixes_read
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera


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


def _views(args: argparse.Namespace) -> ViewChoices:
    choices = ViewChoices(
        views=args.views, split=args.split, virtual_views=args.virtual_views, turntable=args.turntable, up=args.up,
        size=args.size,
    )  # fmt: skip
    if args.cameras is not None:
        Viewpoints(**choices).refuse_with_cameras()
    return choices


def _render(args: argparse.Namespace) -> None:
    def check(cameras: Sequence[Camera], files: Sequence[Path]) -> None:
        check_files(args, files)
        check_photographs(args, cameras, files)

    views = _views(args)
    cameras = None if args.cameras is None else read_cameras(args)
    with Progress() as progress:
        done = render_to_files(
            args.scene, args.output, cameras, args.device, args.rules, args.background, points=Viewpoints(**views),
            trust=args.trust, antialiased=ANTIALIASED[args.antialiased], check=check,
            progress=progress,
        )  # fmt: skip
    say_done(f"{args.output}: {done}")


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
    if args.budget is not None:
        _compare_budgets(args)
        return
    if args.more:
        raise UsageError("several scenes to judge: give --budget too, to compare their levels of detail")
    if args.curve is not None:
        raise UsageError("--curve is of levels of detail: give --budget too, or leave it out")
    views = _views(args)
    given = [args.views, args.split, args.output, args.device, args.cluster]
    pictures_asked_for = any(each is not None for each in given) or Viewpoints(**views).asked_for
    cameras = None if args.cameras is None else read_cameras(args)
    read = {"trust": args.trust, "antialiased": ANTIALIASED[args.antialiased]}
    if cameras is None and args.truth is None and not pictures_asked_for:
        # Sizes need no device, and may be all that is wanted of a machine without one.
        sizes = compare_sizes(args.a, args.b, **read)
        if sizes is not None:
            _tell(args, *sizes)
            note("warning: sizes only: there is no OpenCL device to compare pictures on", "warning")
            return
    comparison = None
    try:
        with ExitStack() as stack:
            # A folder that takes no file is reported before the work.
            picture = None if args.output is None else stack.enter_context(replacing(args.output))
            progress = stack.enter_context(Progress())
            comparison = compare(
                args.a, args.b, cameras, truth=args.truth, lpips=args.lpips, device=args.device,
                cluster=args.cluster, rules=args.rules, background=args.background, progress=progress, **read, **views,
            )  # fmt: skip
            if picture is not None:
                comparison.write_picture(picture)
        if picture is not None:
            comparison.notes.append(f"{args.output}: {comparison.caption}")
    finally:
        if comparison is not None:
            _tell(args, comparison.report(), str(comparison))  # the figures are not lost with the picture


def _compare_budgets(args: argparse.Namespace) -> None:
    views = _views(args)
    for name in ("truth", "lpips", "cluster"):
        if getattr(args, name):
            raise UsageError(f"--{name} does not go with --budget, which compares with the uncompressed scene, here")
    cameras = None if args.cameras is None else read_cameras(args)
    with ExitStack() as stack:
        picture, page = (
            None if path is None else stack.enter_context(replacing(path)) for path in (args.output, args.curve)
        )
        progress = stack.enter_context(Progress())
        comparison = compare_budgets(
            args.a, [args.b, *args.more], args.budget, cameras, device=args.device, rules=args.rules,
            background=args.background, trust=args.trust, antialiased=ANTIALIASED[args.antialiased], progress=progress,
            **views,
        )  # fmt: skip
        if picture is not None:
            comparison.write_picture(picture)
            comparison.notes.append(f"{args.output}: {comparison.caption}")
        if page is not None:
            comparison.write_page(page)
    _tell(args, comparison.report(), str(comparison))


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
    p.add_argument("more", type=ReadFile, nargs="*", metavar="MORE", help="more of them, with --budget")
    p.add_argument(
        "--budget",
        type=whole_number,
        nargs="+",
        metavar="N",
        help="judge levels of detail: render what PlayCanvas' engine would show of B for a budget of N splats",
    )
    p.add_argument(
        "--curve", type=WrittenPage, metavar="OUT.html", help="with --budget: a page with PSNR by splats shown"
    )
    p.add_argument("--cameras", type=ReadCameras, metavar="PATH", help=f"{CAMERAS_HELP}; without it, views are placed")
    p.add_argument(
        "--truth", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views: judge A and B by them"
    )
    p.add_argument(
        "--lpips", action="store_true", help='also compute LPIPS; needs pip install "potr_cl[lpips]" and its weights'
    )
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
