"""Text that is harmless wherever it is shown (:func:`plain`): a terminal, a log, JSON, a web page.

Names, numbers and texts that a file holds were chosen by whoever wrote the file. An escape sequence among them can move
a terminal's cursor, set its title or answer for its user; a line of 60 kB hides what stands before it; a lone surrogate
cannot be written at all.
"""

from __future__ import annotations

import logging
import math
from typing import Any

#: Characters of one line that are shown. The longest path that systems allow is shortened, usual ones are not.
LONGEST_LINE = 1000
#: Characters of one value that a file holds.
LONGEST_VALUE = 60
#: JSON readers commonly hold integers in so many bits, with a sign.
_INTEGER_BITS = 64
#: What is left out where something is too long.
_GAP = " […] "


def plain(text: object, longest: int = LONGEST_LINE) -> str:
    """One line of printable characters.

    Control characters, line ends, characters that change the direction of writing, and lone surrogates stand as escapes
    such as ``\\x1b``. Of what is too long the beginning and the end are kept. What is plain already stays as it is.

    Args:
        text: anything that ``str`` makes a text of.
        longest: characters to show at most.
    """
    try:
        line = str(text)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
    if len(line) > longest:
        end = (longest - len(_GAP)) // 3
        line = line[: longest - len(_GAP) - end] + _GAP + line[len(line) - end :]
    if line.isprintable():
        return line
    shown = "".join(each if each.isprintable() else repr(each)[1:-1] for each in line)
    return shown if len(shown) <= longest else plain(shown, longest)


def plain_lines(text: object) -> str:
    """The same for a text of several lines: each of them is made plain."""
    return "\n".join(map(plain, str(text).split("\n")))


def plain_document(document: Any) -> Any:
    """The same for a document that becomes JSON: texts are made plain, and numbers that JSON cannot hold become None.

    Args:
        document: of dicts, lists, tuples, texts, numbers, bools and None; anything else becomes a text.
    """
    if isinstance(document, dict):
        return {plain(name): plain_document(value) for name, value in document.items()}
    if isinstance(document, (list, tuple)):
        return [plain_document(value) for value in document]
    if document is None or isinstance(document, bool):
        return document
    if isinstance(document, int):
        return document if document.bit_length() < _INTEGER_BITS else None
    if isinstance(document, float):
        return document if math.isfinite(document) else None
    return plain(document)


def plain_fact(value: Any) -> Any:
    """A number or a text that a file states, as it can be shown and computed with; None for anything else.

    Returns:
        A finite number of at most 64 bits, a plain text of at most ``LONGEST_VALUE`` characters, a bool, or None.
    """
    return plain(value, LONGEST_VALUE) if isinstance(value, str) else plain_document(_number_or_none(value))


def _number_or_none(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float)) else None


class _PlainRecords(logging.Filter):
    """Makes messages plain before any handler sees them, the handlers of other programs included."""

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = plain(record.getMessage()), None
        return True


logging.getLogger("potr_cl").addFilter(_PlainRecords())
