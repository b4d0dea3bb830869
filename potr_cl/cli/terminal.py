"""What the commands print (:func:`say`, :func:`say_document`, :func:`note`): nothing that could harm a terminal.

Standard output gets results: where it cannot take them, the command fails. Standard error gets what happens meanwhile:
where it cannot take that, the work goes on. ``--quiet`` and ``--verbose`` choose how much that is
(:func:`speak`). Colours are for terminals alone, and not where the environment variable NO_COLOR is set
(https://no-color.org).
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
from typing import Any, Literal, TextIO

from potr_cl.errors import PotrError
from potr_cl.host.process import closed
from potr_cl.plain_text import plain_document, plain_lines

#: What a line is: of an error or a warning, which are always shown; of what happens, which --quiet leaves out; or of
#: more than most people want to know, which --verbose asks for.
Kind = Literal["error", "warning", "news", "detail"]
Loudness = Literal["quiet", "normal", "verbose"]

#: The kinds that are shown.
_SHOWN: dict[Loudness, set[Kind]] = {
    "quiet": {"error", "warning"},
    "normal": {"error", "warning", "news"},
    "verbose": {"error", "warning", "news", "detail"},
}
#: Bold red and yellow, of what stands before the first colon.
_COLOURS: dict[Kind, str] = {"error": "\x1b[1;31m", "warning": "\x1b[33m"}
_PLAIN_AGAIN = "\x1b[0m"

_shown = _SHOWN["normal"]


def speak(loudness: Loudness) -> None:
    """Choose how much is said on standard error from now on, log messages included."""
    global _shown
    _shown = _SHOWN[loudness]
    logger = logging.getLogger("potr_cl")
    for handler in list(logger.handlers):
        if isinstance(handler, _Notes):
            logger.removeHandler(handler)
    logger.addHandler(_Notes())
    logger.setLevel({"quiet": logging.WARNING, "normal": logging.INFO, "verbose": logging.DEBUG}[loudness])


def is_quiet() -> bool:
    """Whether nothing but errors and warnings is to be said."""
    return "news" not in _shown


def say(text: object) -> None:
    """Print lines on standard output.

    Raises:
        BrokenPipeError: whoever read it has gone.
        PotrError: it cannot be written to.
    """
    _say(plain_lines(text))


def say_done(text: object) -> None:
    """Print on standard output what a command did whose result is a file: not where only errors are to be said, nor
    where standard output is closed.

    Raises:
        As :func:`say`.
    """
    if not is_quiet() and 1 not in closed:
        say(text)


def say_document(document: Any) -> None:
    """Print a document as JSON, whatever its values are; see :func:`say`."""
    say(json.dumps(plain_document(document), indent=1, allow_nan=False))


def say_line(document: Any) -> None:
    """The same in one line, however long, for one of several documents."""
    _say(json.dumps(plain_document(document), allow_nan=False))  # escapes all that is not ASCII


def duration(seconds: float) -> str:
    """A time that is known roughly: "98 s", "4.2 min"."""
    for unit, name in ((3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.1f} {name}" if seconds < 10 * unit else f"{seconds / unit:.0f} {name}"
    return f"{max(seconds, 1):.0f} s"


def megabytes(nbytes: float) -> str:
    """A size: "1.60 MB", "196 kB"."""
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if nbytes >= unit:
            return f"{nbytes / unit:.3g} {name}"
    return f"{nbytes:.0f} bytes"


def note(text: object, kind: Kind = "news") -> None:
    """Print lines on standard error, if lines of this kind are shown."""
    if kind not in _shown:
        return
    try:
        _print(sys.stderr, plain_lines(text), _COLOURS.get(kind))
    except OSError:
        abandon(sys.stderr)


def _say(text: str) -> None:
    if 1 in closed:
        raise PotrError("standard output is closed: redirect it to see the result")
    try:
        _print(sys.stdout, text)
    except BrokenPipeError:
        abandon(sys.stdout)
        raise
    except OSError as error:
        abandon(sys.stdout)
        raise PotrError(f"cannot write to the standard output: {error.strerror or error}") from error


def is_terminal(stream: TextIO | None) -> bool:
    """Whether someone sees a stream on a terminal."""
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # closed
        return False


def abandon(stream: TextIO | None) -> None:
    """Let a stream that cannot be written to lead to nowhere, so that the interpreter does not stumble over it too."""
    if stream is None:
        return
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class _Notes(logging.Handler):
    """What the package logs, as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        kinds: dict[int, Kind] = {logging.DEBUG: "detail", logging.INFO: "news"}
        kind = kinds.get(record.levelno, "warning")
        note(f"warning: {self.format(record)}" if kind == "warning" else self.format(record), kind)


def _takes_colours(stream: TextIO) -> bool:
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not is_terminal(stream):
        return False
    # Older consoles of Windows show escape sequences as they are.
    return os.name != "nt" or "WT_SESSION" in os.environ


def _print(stream: TextIO | None, text: str, colour: str | None = None) -> None:
    if stream is None:  # closed by whoever started the process
        return
    # A terminal of another alphabet shows escapes rather than nothing.
    alphabet = stream.encoding or "utf-8"
    line = text.encode(alphabet, "backslashreplace").decode(alphabet)
    if colour is not None and _takes_colours(stream):
        head, colon, rest = line.partition(":")
        line = f"{colour}{head}{colon}{_PLAIN_AGAIN}{rest}" if colon else f"{colour}{line}{_PLAIN_AGAIN}"
    with contextlib.suppress(ValueError), _without_bars(stream):  # closed meanwhile
        stream.write(f"{line}\n")
        stream.flush()


def _without_bars(stream: TextIO) -> contextlib.AbstractContextManager[None]:
    """Of a block in which no bar of tqdm stands on the terminal that a stream writes to."""
    library = sys.modules.get("tqdm")  # where nothing has imported it, there is no bar
    if library is None or not is_terminal(stream):
        return contextlib.nullcontext()
    cleared: contextlib.AbstractContextManager[None] = library.tqdm.external_write_mode(file=stream)
    return cleared
