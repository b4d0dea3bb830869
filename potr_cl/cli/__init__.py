"""The command line: arguments, progress, exit codes, and nothing else. One module a group of commands."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module

from potr_cl import __version__
from potr_cl.cli import guard, outputs
from potr_cl.cli.parser import SHELLS, CommandParser, PrintCompletion
from potr_cl.cli.terminal import note, speak
from potr_cl.errors import PotrError
from potr_cl.host.process import unwinding
from potr_cl.plain_text import plain

#: The commands, and who adds them, in the order of the help.
COMMANDS = {
    "encode": "encode",
    "prune": "edit",
    "compact": "edit",
    "refit": "edit",
    "fit": "edit",
    "decode": "files",
    "info": "files",
    "convert": "files",
    "render": "pictures",
    "compare": "pictures",
    "view": "view",
    "devices": "devices",
}
#: Those that need an OpenCL device, or tell of them.
_ON_A_DEVICE = {"encode", "prune", "compact", "refit", "fit", "render", "compare", "view", "devices"}
#: Set to anything, it has errors that nobody foresaw shown with where they come from.
TRACEBACK_VARIABLE = "POTR_CL_TRACEBACK"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 success, 1 bad data, 2 wrong usage, 130 interrupted. A wrong call raises SystemExit with 2, as argparse does.
    """
    speak("normal")
    argv = sys.argv[1:] if argv is None else argv
    try:
        _run(argv)
    except PotrError as error:
        note(f"potr-cl: {error}", "error")
        return error.exit_code
    except MemoryError:
        note("potr-cl: not enough memory for this scene", "error")
        return 1
    except KeyboardInterrupt:
        note("potr-cl: interrupted; no file is left half written", "error")
        return 130
    except BrokenPipeError:
        return 0  # the reader (head, less) has gone; what it read was right
    except Exception as error:
        return _unforeseen(error)
    return 0


def _run(argv: Sequence[str]) -> None:
    if argv and argv[0] in _ON_A_DEVICE and not {"-h", "--help"} & set(argv):
        # Drivers take as long to load, and to open a device, as the command's modules to be imported.
        import_module("potr_cl.opencl.ahead").begin_to_open(_named_device(argv), whole=argv[0] != "devices")
    from potr_cl.cli.scenes import standard_input  # on use: it brings much that can wait for the lines above

    args = command_parser(argv).parse_args(argv)
    args.typed = shlex.join(["potr-cl", *argv])
    speak(args.loudness)
    if "arrange" in args:
        args.arrange(args)
    guard.check(args)
    outputs.check(args)
    with unwinding(), standard_input(args), outputs.standard_output(args):
        args.run(args)


def _named_device(argv: Sequence[str]) -> str | None:
    """What a call will probably say of its device, once somebody parses it."""
    given = [argv[at + 1] for at, word in enumerate(argv[:-1]) if word == "--device"]
    given += [word.partition("=")[2] for word in argv if word.startswith("--device=")]
    return given[-1] if given else None


def command_parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser of the command that ``argv`` begins with; of all commands where it begins with none."""
    parser = CommandParser(
        prog="potr-cl", description="Compress trained 3D Gaussian Splatting scenes without retraining."
    )
    parser.add_argument("--version", action="version", version=f"potr-cl {__version__}")
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        help='print a script for completion in this shell; needs pip install "potr_cl[completion]"',
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    # To decode takes less time than to import what other commands need.
    for command in [argv[0]] if argv and argv[0] in COMMANDS else COMMANDS:
        getattr(import_module(f"potr_cl.cli.{COMMANDS[command]}"), f"add_{command}")(commands)
        _add_loudness(commands.choices[command])
    return parser


def _add_loudness(command: argparse.ArgumentParser) -> None:
    """What every command understands of how much it shall say."""
    how = command.add_argument_group("messages").add_mutually_exclusive_group()
    for name, text in (
        ("quiet", "print errors, warnings and results only"),
        ("verbose", "print more: the device, its driver, devices that are skipped"),
    ):
        how.add_argument(f"--{name}", dest="loudness", action="store_const", const=name, default="normal", help=text)


def _unforeseen(error: Exception) -> int:
    """One line for an error that no code expected: a traceback would quote, as it is, what files hold."""
    if os.environ.get(TRACEBACK_VARIABLE):
        note("".join(traceback.format_exception(error)).rstrip(), "error")
    if isinstance(error, OSError) and error.strerror:
        where = "" if error.filename is None else f"'{error.filename}': "
        note(plain(f"potr-cl: {where}{error.strerror}"), "error")
    else:
        note(
            plain(f"potr-cl: unforeseen {type(error).__name__}: {error}")
            + f"; please report it with what the environment variable {TRACEBACK_VARIABLE}=1 adds to this message",
            "error",
        )
    return 1
