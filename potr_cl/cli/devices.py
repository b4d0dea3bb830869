"""The command devices: which OpenCL devices there are."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from potr_cl.cli.guard import WrittenFile
from potr_cl.cli.terminal import note, say, say_document
from potr_cl.errors import DeviceError
from potr_cl.host.atomic_write import replacing
from potr_cl.plain_text import plain_document
from potr_cl.report.devices import device_report, format_devices, measured_report, works

if TYPE_CHECKING:
    from potr_cl.cli.options import Commands


def _devices(args: argparse.Namespace) -> None:
    if args.report is not None:
        with replacing(args.report) as file:
            found = plain_document(measured_report())
            file.write(json.dumps(found, indent=1, ensure_ascii=False).encode() + b"\n")
        report, args.check = found["devices"], True
        note(f"{args.report} holds no names and no paths of yours: docs/devices.md says where to post it")
    else:
        report = device_report(args.check)
    if args.json:
        say_document(report)
    else:
        say(format_devices(report))
    # A device that does not work is no harm: it is passed over where another does.
    if args.check and not any(entry["chosen"] and works(entry) for entry in report):
        able = [str(entry["index"]) for entry in report if works(entry)]
        advice = f"choose another with --device: {', '.join(able)}" if able else "none works"
        raise DeviceError(f"the default device fails the self-check, or there is none: {advice}")


def add_devices(commands: Commands) -> None:
    p = commands.add_parser("devices", help="list the OpenCL devices; * marks the default, ! what does not work")
    p.add_argument(
        "--check",
        action="store_true",
        help="run every kernel of encodes on each device, in a process of its own; takes seconds or, the first time, "
        "minutes. Devices that fail are passed over from now on. Fails if none is left",
    )
    p.add_argument(
        "--report",
        type=WrittenFile,
        metavar="FILE",
        help="the same, and time each kernel on a built-in scene; write what was found to FILE, to be posted",
    )
    p.add_argument("--json", action="store_true", help="print JSON")
    p.set_defaults(run=_devices)
