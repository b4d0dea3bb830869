"""What the commands print (:func:`say`, :func:`say_document`, :func:`note`): nothing that could harm a terminal.

Standard output gets results: where it cannot take them, the command fails. Standard error gets what happens meanwhile:
where it cannot take that, the work goes on.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from typing import Any, TextIO

from potr_cl.errors import PotrError
from potr_cl.plain_text import plain_document, plain_lines


def say(text: object) -> None:
    """Print lines on standard output.

    Raises:
        BrokenPipeError: whoever read it has gone.
        PotrError: it cannot be written to.
    """
    _say(plain_lines(text))


def say_document(document: Any) -> None:
    """Print a document as JSON, whatever its values are; see :func:`say`."""
    say(json.dumps(plain_document(document), indent=1, allow_nan=False))


def say_line(document: Any) -> None:
    """The same in one line, however long, for one of several documents."""
    _say(json.dumps(plain_document(document), allow_nan=False))  # escapes all that is not ASCII


def note(text: object) -> None:
    """Print lines on standard error."""
    try:
        _print(sys.stderr, plain_lines(text))
    except OSError:
        abandon(sys.stderr)


def _say(text: str) -> None:
    try:
        _print(sys.stdout, text)
    except BrokenPipeError:
        abandon(sys.stdout)
        raise
    except OSError as error:
        abandon(sys.stdout)
        raise PotrError(f"cannot write to the standard output: {error.strerror or error}") from error


def abandon(stream: TextIO | None) -> None:
    """Let a stream that cannot be written to lead to nowhere, so that the interpreter does not stumble over it too."""
    if stream is None:
        return
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _print(stream: TextIO | None, text: str) -> None:
    if stream is None:  # closed by whoever started the process
        return
    # A terminal of another alphabet shows escapes rather than nothing.
    alphabet = stream.encoding or "utf-8"
    line = text.encode(alphabet, "backslashreplace").decode(alphabet)
    with contextlib.suppress(ValueError):  # closed meanwhile
        stream.write(f"{line}\n")
        stream.flush()
