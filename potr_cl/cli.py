"""The command line: arguments, progress, exit codes, and nothing else."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from potr_cl import __version__
from potr_cl.atomic_write import replacing
from potr_cl.bitstream import EntropyCoder
from potr_cl.decoder import PotrFile, decode
from potr_cl.encoder import EncodeOptions, encode
from potr_cl.errors import PotrError, UsageError
from potr_cl.formats import load_cameras, load_scene, ply
from potr_cl.report import file_report, format_report


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


def _encode(args: argparse.Namespace) -> None:
    options = EncodeOptions(
        q=args.quality,
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
    scene = load_scene(args.scene)
    progress = _Progress()
    try:
        with replacing(args.output) as file:
            encoded = encode(scene, cameras, options, progress)
            for piece in encoded.pieces:
                file.write(piece)
    finally:
        progress.close()
    if not (args.no_prune and args.no_compact):
        print("all splats and all their colours were kept: this version neither prunes nor compacts", file=sys.stderr)
    before = options.source_bytes or scene.nbytes
    print(
        f"{args.output}: {len(scene)} splats, {encoded.nbytes} bytes, "
        f"{encoded.nbytes / len(scene):.2f} bytes a splat, {before / encoded.nbytes:.1f} times smaller"
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
        help="cameras.json, transforms.json, or a COLMAP model's folder: lets far splats be placed more coarsely",
    )
    p.add_argument("--no-prune", action="store_true", help="keep every splat")
    p.add_argument("--no-compact", action="store_true", help="keep the colours' coefficients as they are")
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
    p.set_defaults(run=_encode)

    p = commands.add_parser("decode", help="a .potr file to a .ply that every viewer opens")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.set_defaults(run=_decode)

    p = commands.add_parser("info", help="what a .potr file holds, and where its bytes are")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("--json", action="store_true", help="for programs")
    p.set_defaults(run=_info)
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
        print("potr-cl: interrupted, nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader (head, less) has gone; what it read was right.
        sys.stderr.close()
        return 0
    return 0
