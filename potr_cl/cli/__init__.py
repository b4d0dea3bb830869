"""The command line: arguments, progress, exit codes, and nothing else. One module a group of commands."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from importlib import import_module

from potr_cl import __version__
from potr_cl.errors import PotrError
from potr_cl.host.threads import in_background

#: The commands, and who adds them, in the order of the help.
_COMMANDS = {
    "encode": "encode",
    "prune": "edit",
    "compact": "edit",
    "refit": "edit",
    "decode": "files",
    "info": "files",
    "convert": "convert",
    "render": "pictures",
    "compare": "pictures",
    "devices": "devices",
}
#: Those that need an OpenCL device.
_ON_A_DEVICE = {"encode", "prune", "compact", "refit", "render", "compare", "devices"}


def command_parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser of the command that ``argv`` begins with; of all commands where it begins with none."""
    parser = argparse.ArgumentParser(
        prog="potr-cl", description="Compress trained 3D Gaussian Splatting scenes without retraining."
    )
    parser.add_argument("--version", action="version", version=f"potr-cl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    # To decode takes less time than to import what other commands need.
    for command in [argv[0]] if argv and argv[0] in _COMMANDS else _COMMANDS:
        getattr(import_module(f"potr_cl.cli.{_COMMANDS[command]}"), f"add_{command}")(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 success, 1 bad data, 2 wrong usage, 130 interrupted.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] in _ON_A_DEVICE and not {"-h", "--help"} & set(argv):
        # Drivers take as long to load as the command's modules to be imported.
        in_background(import_module("potr_cl.opencl.discovery").list_devices)
    args = command_parser(argv).parse_args(argv)
    try:
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
