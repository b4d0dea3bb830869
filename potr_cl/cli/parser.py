"""The parser of arguments: argparse's, but a wrong call is told in one line, and what is typed is shown harmlessly."""

from __future__ import annotations

import argparse
import sys
from typing import Any, NoReturn

from potr_cl.cli.terminal import note, say
from potr_cl.plain_text import plain

#: More digits than any number of views, steps or splats has.
_MOST_DIGITS = 12


class CommandParser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line and exit with 2."""

    def error(self, message: str) -> NoReturn:
        note(plain(f"{self.prog}: {message} (see {self.prog} --help)"))
        sys.exit(2)

    def _print_message(self, message: str, file: Any = None) -> None:
        # The help and the version; argparse writes them as they are, and lets errors pass.
        (note if file is sys.stderr else say)(message.rstrip("\n"))


def whole_number(text: str) -> int:
    """An integer of a size that something may be counted in; a type of arguments.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    try:
        if len(text) <= _MOST_DIGITS:
            return int(text)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{plain(text, 40)!r} is no whole number of at most {_MOST_DIGITS} digits")
