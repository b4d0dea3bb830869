"""The command devices: which OpenCL devices there are."""

from __future__ import annotations

import argparse
import json

from potr_cl.cli.options import Commands
from potr_cl.device_report import device_report, format_devices
from potr_cl.errors import DeviceError


def _devices(args: argparse.Namespace) -> None:
    report = device_report(args.check)
    print(json.dumps(report, indent=1) if args.json else format_devices(report))
    failed = [entry["name"] for entry in report if entry.get("check", "passed") != "passed"]
    if failed:
        raise DeviceError(f"{len(failed)} of {len(report)} devices failed the self-check: {', '.join(failed)}")


def add_devices(commands: Commands) -> None:
    p = commands.add_parser("devices", help="the OpenCL devices; * marks the one that is taken by default")
    p.add_argument("--check", action="store_true", help="prove that each computes right; takes seconds")
    p.add_argument("--json", action="store_true", help="for programs")
    p.set_defaults(run=_devices)
