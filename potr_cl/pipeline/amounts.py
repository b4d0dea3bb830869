"""Amounts of bytes as people give them: :func:`size_in_bytes` of files, :func:`as_bytes` of memory."""

from __future__ import annotations

import contextlib
import re
from numbers import Real

from potr_cl.errors import UsageError

#: More than any device has; beyond it someone has typed bytes.
_MOST_GIGABYTES = 1e6
#: Fewer than any file has: whoever types so few means megabytes.
_FEWEST_BYTES = 100
#: More than any file has.
_MOST_BYTES = 1e18


def as_bytes(gigabytes: float | None) -> int | None:
    """Bytes of what ``--memory`` says.

    Raises:
        UsageError: no machine has that much, or it is no amount at all.
    """
    if gigabytes is None:
        return None
    if not isinstance(gigabytes, Real):
        raise UsageError(f"--memory is {gigabytes!r}: give a number of GiB")
    if not 0 <= gigabytes <= _MOST_GIGABYTES:
        raise UsageError(f"--memory is {gigabytes:g}, it must lie between 0 and {_MOST_GIGABYTES:g} GiB")
    return int(gigabytes * 2**30)


def size_in_bytes(text: str) -> int:
    """Bytes of a size as people write it: 8MB (10⁶), 8 MiB (2²⁰), 800k, 1.5e6.

    Raises:
        UsageError: it is none, or so few bytes that a unit is missing.
    """
    match = re.fullmatch(r"\s*([0-9][0-9._]*(?:e[0-9]+)?)\s*(?:([kmg])(i?))?b?\s*", text, re.IGNORECASE)
    if match is not None:
        with contextlib.suppress(ValueError):
            power = " kmg".index((match[2] or " ").lower())
            size = float(match[1]) * (1024 if match[3] else 1000) ** power
            if size < _FEWEST_BYTES and not match[2]:
                raise UsageError(f"'{text.strip()}' would be {size:g} bytes: give a unit, as in {match[1]}MB")
            if size <= _MOST_BYTES:
                return int(size)
    raise UsageError(f"'{text[:40]}' is not a size: give bytes, or a number with k, MB, GB, KiB, MiB or GiB")
