"""The command line: arguments, progress, exit codes, and nothing else. One module a group of commands."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence

from potr_cl import __version__
from potr_cl.cli import convert, devices, edit, encode, files, pictures
from potr_cl.errors import PotrError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="potr-cl", description="Compress trained 3D Gaussian Splatting scenes without retraining."
    )
    parser.add_argument("--version", action="version", version=f"potr-cl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    encode.add_encode(commands)
    edit.add_prune(commands)
    edit.add_compact(commands)
    edit.add_refit(commands)
    files.add_decode(commands)
    files.add_info(commands)
    convert.add_convert(commands)
    pictures.add_render(commands)
    pictures.add_compare(commands)
    devices.add_devices(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 success, 1 bad data, 2 wrong usage, 130 interrupted.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    args = _parser().parse_args(argv)
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
