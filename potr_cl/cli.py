"""The command line: arguments, progress, exit codes, and nothing else."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from potr_cl import __version__
from potr_cl.atomic_write import replacing
from potr_cl.bitstream import EntropyCoder
from potr_cl.cameras import Camera, test_views, train_views
from potr_cl.compare import (
    SceneFile,
    compare,
    comparison_report,
    find_photographs,
    format_comparison,
    format_sizes,
    side_by_side,
    size_report,
)
from potr_cl.decoder import PotrFile, decode
from potr_cl.device import DEVICE_VARIABLE, Device
from potr_cl.device_report import device_report, format_devices
from potr_cl.encoder import EncodeOptions, encode, reduce_scene
from potr_cl.errors import DataError, DeviceError, PotrError, UsageError
from potr_cl.formats import load_cameras, load_scene, ply
from potr_cl.images import parse_colour, to_8_bits, write_png
from potr_cl.metrics import Lpips
from potr_cl.quantize import ac_sparsity
from potr_cl.rasterizer import GSPLAT, INRIA, Rasterizer
from potr_cl.removal import SweepOptions
from potr_cl.report import file_report, format_report

_RULES = {"inria": INRIA, "gsplat": GSPLAT}
_CAMERAS_HELP = "cameras.json, transforms.json, or a COLMAP model's folder"


class _Progress:
    """A bar with the time left on a terminal; elsewhere a line when a stage begins and ends."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Any = None
        self._began = 0.0

    def __call__(self, stage: str, done: float) -> None:
        if stage != self._stage:
            self.close()
            self._stage, self._began = stage, time.perf_counter()
            if sys.stderr.isatty():
                form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} elapsed, {remaining} left"
                self._bar = tqdm(total=1.0, desc=stage, bar_format=form, leave=False)
            else:
                print(f"{stage} …", file=sys.stderr, flush=True)
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        if done >= 1:
            self.close()
            print(f"{stage}: {time.perf_counter() - self._began:.1f} s", file=sys.stderr, flush=True)
            self._stage = ""

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _count(args: argparse.Namespace, splats: int) -> int | None:
    """The number of splats that ``--keep`` or ``--count`` ask for."""
    if args.keep is None:
        return None if args.count is None else int(args.count)
    if not 0 < args.keep <= 1:
        raise UsageError(f"--keep is {args.keep:g}, it must be above 0 and at most 1")
    return max(round(float(args.keep) * splats), 1)


def _sweep_options(args: argparse.Namespace) -> SweepOptions:
    return SweepOptions(args.tolerance, args.turns, _bytes(args.memory))


def _bytes(gigabytes: float | None) -> int | None:
    return None if gigabytes is None else int(gigabytes * 2**30)


def _prune(args: argparse.Namespace) -> None:
    if args.order is not None and args.order.resolve() == args.output.resolve():
        raise UsageError("--order and --output name the same file")
    options = EncodeOptions(
        q=args.quality,
        delta_mse_max=args.delta_mse_max,
        iterations=args.iterations,
        compact=False,
        sweep=_sweep_options(args),
        background=parse_colour(args.background),
    )
    _ = options.parameters  # a wrong option is told before a gigabyte is read
    cameras = load_cameras(args.cameras)
    scene = load_scene(args.scene)
    options = dataclasses.replace(options, count=_count(args, len(scene)))
    device = Device(args.device)
    with contextlib.ExitStack() as stack:
        order = stack.enter_context(replacing(args.order)) if args.order is not None else None
        progress = stack.enter_context(contextlib.closing(_Progress()))
        kept, pruned = reduce_scene(scene, cameras, options, progress, device)
        assert pruned is not None
        ply.save(args.output, kept)
        if order is not None:
            np.save(order, pruned.order)
    print(
        f"{args.output}: kept {pruned.kept} of {len(scene)} splats "
        f"({100 * pruned.kept / len(scene):.1f} %) in {pruned.iterations} iterations on {device.info}"
    )


def _compact(args: argparse.Namespace) -> None:
    options = EncodeOptions(
        q=args.quality,
        lam=args.lam,
        alpha=args.alpha,
        sf_sh=args.sf_sh,
        prune=False,
        sweep=SweepOptions(memory=_bytes(args.memory)),
        background=parse_colour(args.background),
    )
    _ = options.parameters
    cameras = load_cameras(args.cameras)
    scene = load_scene(args.scene)
    device = Device(args.device)
    with contextlib.closing(_Progress()) as progress:
        compacted, _ = reduce_scene(scene, cameras, options, progress, device)
    ply.save(args.output, compacted)
    before, after = (100 * ac_sparsity(s.sh, options.parameters.sf_sh) for s in (scene, compacted))
    print(
        f"{args.output}: {len(scene)} splats, {after:.1f} % of the AC coefficients quantise to 0, {before:.1f} % before"
    )


def _encode(args: argparse.Namespace) -> None:
    options = EncodeOptions(
        q=args.quality,
        delta_mse_max=args.delta_mse_max,
        lam=args.lam,
        alpha=args.alpha,
        prune=not args.no_prune,
        iterations=args.iterations,
        compact=not args.no_compact,
        compact_at=args.compact_at,
        sweep=_sweep_options(args),
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
    options = dataclasses.replace(options, count=_count(args, len(scene)))
    device = Device(args.device) if (options.prune or options.compact) and cameras is not None else None
    with replacing(args.output) as file, contextlib.closing(_Progress()) as progress:
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


def _decode(args: argparse.Namespace) -> None:
    started = time.perf_counter()
    scene = decode(args.file)
    decoded = time.perf_counter()
    ply.save(args.output, scene)
    written = time.perf_counter()
    print(
        f"{args.output}: {len(scene)} splats, decoded in {decoded - started:.2f} s, "
        f"written in {written - decoded:.2f} s"
    )


def _info(args: argparse.Namespace) -> None:
    report = file_report(PotrFile.open(args.file))
    print(json.dumps(report, indent=1) if args.json else format_report(report))


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
    scene = load_scene(path)
    rasterizer = Rasterizer(device, scene, _RULES[args.rules], parse_colour(args.background))
    return SceneFile.of(path, scene), rasterizer


def _render(args: argparse.Namespace) -> None:
    parse_colour(args.background)  # a wrong option is told before anything is read
    views = _select(load_cameras(args.cameras), args.views, args.split or "all")
    files = {view.name.replace("/", "_") + ".png": view for view in views}
    if len(files) < len(views):
        raise DataError(f"'{args.cameras}': two views would be written to one file: render them with --views")
    device = Device(args.device)
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{args.output}': {error.strerror}") from None
    _, rasterizer = _rasterizer(args, args.scene, device)
    stage = f"rendering {len(views)} view{'s' if len(views) > 1 else ''}"
    with contextlib.closing(_Progress()) as progress:
        progress(stage, 0.0)
        for done, (name, view) in enumerate(files.items(), 1):
            image, _ = rasterizer.render(view)
            with replacing(args.output / name) as file:
                write_png(file, to_8_bits(image))
            progress(stage, done / len(files))
    print(f"{args.output}: {len(files)} image{'s' if len(files) > 1 else ''}, rendered on {device.info}")


def _compare(args: argparse.Namespace) -> None:
    if args.cameras is None:
        for option in ("truth", "views", "split", "output"):
            if getattr(args, option) is not None:
                raise UsageError(f"--{option} needs --cameras, the views to compare from")
        a, b = (SceneFile.of(path, load_scene(path)) for path in (args.a, args.b))
        print(json.dumps(size_report(a, b), indent=1) if args.json else format_sizes(a, b))
        print("sizes only: give --cameras to compare pictures", file=sys.stderr)
        return
    parse_colour(args.background)
    views = _select(load_cameras(args.cameras), args.views, args.split)
    photographs = find_photographs(args.truth, views) if args.truth is not None else None
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
        progress = stack.enter_context(contextlib.closing(_Progress()))
        comparison = compare(rasterizer_a, rasterizer_b, views, photographs, lpips, progress)
        if picture is not None:
            pixels, factor = side_by_side(comparison.worst_a, comparison.worst_b)
            worst = comparison.views[comparison.worst].name
            text = f"view {worst}: A, B and their difference times {factor}"
            write_png(picture, pixels, f"{text}; A is {args.a.name}, B is {args.b.name}")
            notes.append(f"{args.output}: {text}")
    if args.json:
        settings = {"device": device.info.name, "rules": args.rules, "background": rasterizer_a.background}
        report = {**size_report(a, b), **settings, **comparison_report(comparison), "notes": notes}
        print(json.dumps(report, indent=1, allow_nan=False))
    else:
        print(format_sizes(a, b), format_comparison(comparison), "\n".join(notes), sep="\n\n")


def _devices(args: argparse.Namespace) -> None:
    report = device_report(args.check)
    print(json.dumps(report, indent=1) if args.json else format_devices(report))
    failed = [entry["name"] for entry in report if entry.get("check", "passed") != "passed"]
    if failed:
        raise DeviceError(f"{len(failed)} of {len(report)} devices failed the self-check: {', '.join(failed)}")


def _add_pruning_options(p: argparse.ArgumentParser) -> None:
    """What every command that prunes understands."""
    group = p.add_argument_group("pruning")
    how_many = group.add_mutually_exclusive_group()
    how_many.add_argument("--keep", type=float, metavar="FRACTION", help="of the splats, exactly, instead of -q's")
    how_many.add_argument("--count", type=int, metavar="N", help="splats to keep, exactly, instead of -q's")
    how_many.add_argument(
        "--delta-mse-max", type=float, metavar="X", help="remove a splat if the mean squared error grows by less"
    )
    group.add_argument("--iterations", type=int, default=48, metavar="N", help="default 48")
    group.add_argument(
        "--tolerance",
        type=float,
        default=SweepOptions.tolerance,
        metavar="X",
        help="part of a tile that must have been removed before it is looked at again; 0: any; default "
        f"{SweepOptions.tolerance:g}",
    )
    group.add_argument(
        "--turns",
        type=int,
        default=SweepOptions.turns,
        metavar="N",
        help=f"look at a view again in every N-th iteration only; default {SweepOptions.turns}",
    )
    _add_memory_option(group)
    _add_device_options(group)


def _add_memory_option(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--memory", type=float, metavar="GB", help="GiB of device memory to keep views in; default: half of it"
    )


def _add_compaction_options(p: argparse._ActionsContainer) -> None:
    p.add_argument("--lambda", dest="lam", type=float, metavar="X", help="how strongly AC coefficients are pulled to 0")
    p.add_argument(
        "--alpha", type=float, metavar="X", help="cosine above which two coefficients count as one; 1: never"
    )


def _add_rendering_options(p: argparse.ArgumentParser) -> None:
    """What every command that renders understands."""
    _add_device_options(p)
    p.add_argument(
        "--rules",
        choices=tuple(_RULES),
        default="inria",
        help="whose rasterizer to follow; default inria, the original",
    )


def _add_device_options(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--background",
        default="black",
        metavar="COLOUR",
        help="R,G,B from 0 to 1, a name, or #rrggbb; default black",
    )
    p.add_argument(
        "--device",
        metavar="DEVICE",
        help="index, part of a name, cpu or gpu, as the command devices lists them; "
        f"default: ${DEVICE_VARIABLE}, else the one that should be fastest",
    )


def _add_view_options(p: argparse.ArgumentParser, default: str) -> None:
    which = p.add_mutually_exclusive_group()
    which.add_argument("--views", nargs="+", metavar="VIEW", help="names, or indices from 0 in the cameras' order")
    which.add_argument("--split", choices=("train", "test", "all"), help=f"default: {default}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="potr-cl", description="Compress trained 3D Gaussian Splatting scenes without retraining."
    )
    parser.add_argument("--version", action="version", version=f"potr-cl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

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
    _add_pruning_options(p)
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
    _add_compaction_options(single)
    p.set_defaults(run=_encode)

    p = commands.add_parser("prune", help="remove the splats that no view misses; nothing else changes")
    p.add_argument("scene", type=Path, metavar="SCENE", help=".ply or .potr")
    p.add_argument("--cameras", type=Path, required=True, metavar="PATH", help=_CAMERAS_HELP)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (fewest splats) to 1; default 0.5")
    p.add_argument(
        "--order",
        type=Path,
        metavar="FILE.npy",
        help="also write the order of removal: the scene's splat numbers, first removed first, kept ones last",
    )
    _add_pruning_options(p)
    p.set_defaults(run=_prune)

    p = commands.add_parser("compact", help="make the colours' coefficients sparse; nothing else changes")
    p.add_argument("scene", type=Path, metavar="SCENE", help=".ply or .potr")
    p.add_argument("--cameras", type=Path, required=True, metavar="PATH", help=_CAMERAS_HELP)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (sparsest) to 1; default 0.5")
    _add_compaction_options(p)
    p.add_argument("--sf-sh", type=float, metavar="SF", help="steps a unit of the quantiser to expect")
    _add_memory_option(p)
    _add_device_options(p)
    p.set_defaults(run=_compact)

    p = commands.add_parser("decode", help="a .potr file to a .ply that every viewer opens")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.set_defaults(run=_decode)

    p = commands.add_parser("info", help="what a .potr file holds, and where its bytes are")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("--json", action="store_true", help="for programs")
    p.set_defaults(run=_info)

    p = commands.add_parser("render", help="pictures (.png) of a scene from its cameras")
    p.add_argument("scene", type=Path, metavar="SCENE", help=".ply or .potr")
    p.add_argument("--cameras", type=Path, required=True, metavar="PATH", help=_CAMERAS_HELP)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="one file a view, named after it")
    _add_view_options(p, "all")
    _add_rendering_options(p)
    p.set_defaults(run=_render)

    p = commands.add_parser(
        "compare",
        help="what compression cost: PSNR and SSIM of one scene's pictures against another's, and sizes",
        description="Render two scenes from the same views and compare. A PSNR is in decibels, a mean is over views. "
        "In JSON a PSNR of null means identical pictures.",
    )
    p.add_argument("a", type=Path, metavar="A", help="the uncompressed scene, .ply or .potr")
    p.add_argument("b", type=Path, metavar="B", help="the one to judge, .ply or .potr")
    p.add_argument("--cameras", type=Path, metavar="PATH", help=f"{_CAMERAS_HELP}; without, only sizes are compared")
    p.add_argument(
        "--truth", type=Path, metavar="DIR", help="photographs, named after the views: judge A and B by them"
    )
    _add_view_options(p, "test views if there are any, else all")
    p.add_argument("-o", "--output", type=Path, metavar="OUT.png", help="the worst view: A, B, and their difference")
    p.add_argument("--json", action="store_true", help="for programs")
    _add_rendering_options(p)
    p.set_defaults(run=_compare)

    p = commands.add_parser("devices", help="the OpenCL devices; * marks the one that is taken by default")
    p.add_argument("--check", action="store_true", help="prove that each computes right; takes seconds")
    p.add_argument("--json", action="store_true", help="for programs")
    p.set_defaults(run=_devices)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 success, 1 bad data, 2 wrong usage, 130 interrupted.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    args = _parser().parse_args(argv)
    try:
        if args.command == "encode" and args.threads < 0:
            raise UsageError(f"--threads is {args.threads}, it must be 0 or more")
        args.run(args)
    except PotrError as error:
        print(f"potr-cl: {error}", file=sys.stderr)
        return error.exit_code
    except MemoryError:
        print("potr-cl: not enough memory for this scene", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("potr-cl: interrupted; no file is left half written", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader (head, less) has gone; what it read was right.
        sys.stderr.close()
        return 0
    return 0
