"""The commands about .potr files: decode, info."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from potr_cl.cli.guard import ReadFile, WrittenFile
from potr_cl.cli.scenes import add_trust_option, trust
from potr_cl.cli.terminal import say, say_document
from potr_cl.codec.decoder import PotrFile, decode
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import SH_COEFFICIENTS
from potr_cl.report.file import file_report, format_report

if TYPE_CHECKING:
    from potr_cl.cli.options import Commands


def _decode(args: argparse.Namespace) -> None:
    started = time.perf_counter()
    scene = decode(args.file, **trust(args), sh_degree=args.sh_degree)
    decoded = time.perf_counter()
    ply.save(args.output, scene)
    written = time.perf_counter()
    say(
        f"{args.output}: {len(scene)} splats, decoded in {decoded - started:.2f} s, "
        f"written in {written - decoded:.2f} s"
    )


def add_decode(commands: Commands) -> None:
    p = commands.add_parser("decode", help="a .potr file to a .ply that every viewer opens")
    p.add_argument("file", type=ReadFile, metavar="IN.potr")
    p.add_argument("-o", "--output", type=WrittenFile, required=True, metavar="OUT.ply")
    p.add_argument(
        "--sh-degree", type=int, choices=range(len(SH_COEFFICIENTS)), metavar="N",
        help="leave out SH coefficients of degrees above N, 0 to 3, without decoding them; default: none",
    )  # fmt: skip
    add_trust_option(p)
    p.set_defaults(run=_decode)


def _info(args: argparse.Namespace) -> None:
    report = file_report(PotrFile.open(args.file, **trust(args)))
    if args.json:
        say_document(report)
    else:
        say(format_report(report))


def add_info(commands: Commands) -> None:
    p = commands.add_parser("info", help="what a .potr file holds, and where its bytes are")
    p.add_argument("file", type=ReadFile, metavar="IN.potr")
    p.add_argument("--json", action="store_true", help="for programs")
    add_trust_option(p)
    p.set_defaults(run=_info)
