"""The commands that render: render, compare."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from potr_cl.cli.guard import (
    ReadCameras,
    ReadFile,
    ReadPhotographs,
    WrittenFile,
    WrittenFolder,
    check_files,
    check_photographs,
)
from potr_cl.cli.options import CAMERAS_HELP, RULES, Commands, add_rendering_options, add_view_options
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import add_antialiased_option, add_trust_option, read_scene
from potr_cl.cli.terminal import note, say, say_document
from potr_cl.cli.views import read_cameras
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.images import parse_colour, to_8_bits, write_png
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.plain_text import plain
from potr_cl.quality.compare import (
    SceneFile,
    compare,
    comparison_report,
    find_ground_truth,
    format_comparison,
    format_sizes,
    side_by_side,
    size_report,
)
from potr_cl.quality.metrics import Lpips
from potr_cl.raster.rasterizer import Rasterizer


def _select(cameras: list[Camera], wanted: list[str] | None, split: str | None) -> list[Camera]:
    """The views that ``--views`` or ``--split`` ask for; without either the test views, or all if there are none."""
    if wanted is not None:
        by_name = {camera.name: camera for camera in cameras}
        by_name = {str(index): camera for index, camera in enumerate(cameras)} | by_name
        for name in wanted:
            if name not in by_name:
                raise UsageError(
                    f"there is no view '{name}': the cameras hold {len(cameras)} views, from 0 ('{cameras[0].name}') "
                    f"to {len(cameras) - 1} ('{cameras[-1].name}')"
                )
        return list(dict.fromkeys(by_name[name] for name in wanted))
    if split == "all":
        return cameras
    if split == "train":
        return train_views(cameras)
    views = test_views(cameras)
    if split == "test" and not views:
        raise UsageError("none of the cameras is a test view: use --split all, or name views with --views")
    return views or cameras


def _rasterizer(args: argparse.Namespace, path: Path, device: Device) -> tuple[SceneFile, Rasterizer]:
    scene = read_scene(args, path)
    rasterizer = Rasterizer(device, scene, RULES[args.rules], parse_colour(args.background))
    return SceneFile.of(path, scene), rasterizer


def _render(args: argparse.Namespace) -> None:
    parse_colour(args.background)  # a wrong option is told before anything is read
    cameras = read_cameras(args)
    views = _select(cameras, args.views, args.split or "all")
    files = {view.name.replace("/", "_") + ".png": view for view in views}
    if len(files) < len(views):
        raise DataError(f"'{args.cameras}': two views would be written to one file: render them with --views")
    written = [args.output / name for name in files]
    check_files(args, written)
    check_photographs(args, cameras, written)
    device = Device(args.device)
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{args.output}': {error.strerror}") from None
    _, rasterizer = _rasterizer(args, args.scene, device)
    stage = f"rendering {len(views)} view{'s' if len(views) > 1 else ''}"
    with contextlib.closing(Progress()) as progress:
        progress(stage, 0.0)
        for done, (name, view) in enumerate(files.items(), 1):
            image, _ = rasterizer.render(view)
            with replacing(args.output / name) as file:
                write_png(file, to_8_bits(image))
            progress(stage, done / len(files))
    say(f"{args.output}: {len(files)} image{'s' if len(files) > 1 else ''}, rendered on {device.info}")


def add_render(commands: Commands) -> None:
    p = commands.add_parser("render", help="pictures (.png) of a scene from its cameras")
    p.add_argument("scene", type=ReadFile, metavar="SCENE", help=".ply or .potr")
    p.add_argument("--cameras", type=ReadCameras, required=True, metavar="PATH", help=CAMERAS_HELP)
    p.add_argument(
        "-o", "--output", type=WrittenFolder, required=True, metavar="DIR", help="one file a view, named after it"
    )
    add_view_options(p, "all")
    add_trust_option(p)
    add_antialiased_option(p)
    add_rendering_options(p)
    p.set_defaults(run=_render)


def _compare(args: argparse.Namespace) -> None:
    if args.cameras is None:
        for option in ("truth", "views", "split", "output"):
            if getattr(args, option) is not None:
                raise UsageError(f"--{option} needs --cameras, the views to compare from")
        a, b = (SceneFile.of(path, read_scene(args, path)) for path in (args.a, args.b))
        if args.json:
            say_document(size_report(a, b))
        else:
            say(format_sizes(a, b))
        note("sizes only: give --cameras to compare pictures")
        return
    parse_colour(args.background)
    views = _select(read_cameras(args), args.views, args.split)
    ground_truth = find_ground_truth(args.truth, views) if args.truth is not None else None
    lpips, notes = None, []
    try:
        lpips = Lpips()
    except UsageError as missing:
        notes.append(str(missing))
    device = Device(args.device)
    with contextlib.ExitStack() as stack:
        picture = stack.enter_context(replacing(args.output)) if args.output is not None else None
        a, rasterizer_a = _rasterizer(args, args.a, device)
        b, rasterizer_b = _rasterizer(args, args.b, device)
        if a.antialiased != b.antialiased:
            ways = " and ".join(
                f"{name} is rendered {'with' if each.antialiased else 'without'} antialiasing"
                for name, each in (("A", a), ("B", b))
            )
            notes.append(f"warning: {ways}, as the files say: give --antialiased yes or no to render both alike")
        progress = stack.enter_context(contextlib.closing(Progress()))
        comparison = compare(rasterizer_a, rasterizer_b, views, ground_truth, lpips, progress)
        if picture is not None:
            worst = views[comparison.worst]
            pixels, factor = side_by_side(*(each.render(worst)[0] for each in (rasterizer_a, rasterizer_b)))
            text = f"view {worst.name}: A, B and their difference times {factor}"
            write_png(picture, pixels, plain(f"{text}; A is {args.a.name}, B is {args.b.name}"))
            notes.append(f"{args.output}: {text}")
    if args.json:
        settings = {"device": device.info.name, "rules": args.rules, "background": rasterizer_a.background}
        report = {**size_report(a, b), **settings, **comparison_report(comparison), "notes": notes}
        say_document(report)
    else:
        say("\n\n".join([format_sizes(a, b), format_comparison(comparison), "\n".join(notes)]))


def add_compare(commands: Commands) -> None:
    p = commands.add_parser(
        "compare",
        help="what compression cost: PSNR and SSIM of one scene's pictures against another's, and sizes",
        description="Render two scenes from the same views and compare. A PSNR is in decibels, a mean is over views. "
        "In JSON a PSNR of null means identical pictures.",
    )
    p.add_argument("a", type=ReadFile, metavar="A", help="the uncompressed scene, .ply or .potr")
    p.add_argument("b", type=ReadFile, metavar="B", help="the one to judge, .ply or .potr")
    p.add_argument(
        "--cameras", type=ReadCameras, metavar="PATH", help=f"{CAMERAS_HELP}; without, only sizes are compared"
    )
    p.add_argument(
        "--truth", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views: judge A and B by them"
    )
    add_view_options(p, "test views if there are any, else all")
    p.add_argument(
        "-o", "--output", type=WrittenFile, metavar="OUT.png", help="the worst view: A, B, and their difference"
    )
    p.add_argument("--json", action="store_true", help="for programs")
    add_trust_option(p)
    add_antialiased_option(p)
    add_rendering_options(p)
    p.set_defaults(run=_compare)
