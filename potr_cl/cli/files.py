"""The commands about .potr files: decode, info."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

from potr_cl.codec.decoder import PotrFile, decode
from potr_cl.formats.scenes import ply
from potr_cl.report.file import file_report, format_report

if TYPE_CHECKING:
    from potr_cl.cli.options import Commands


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


def add_decode(commands: Commands) -> None:
    p = commands.add_parser("decode", help="a .potr file to a .ply that every viewer opens")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.set_defaults(run=_decode)


def _info(args: argparse.Namespace) -> None:
    report = file_report(PotrFile.open(args.file))
    print(json.dumps(report, indent=1) if args.json else format_report(report))


def add_info(commands: Commands) -> None:
    p = commands.add_parser("info", help="what a .potr file holds, and where its bytes are")
    p.add_argument("file", type=Path, metavar="IN.potr")
    p.add_argument("--json", action="store_true", help="for programs")
    p.set_defaults(run=_info)
