"""A file's metadata: from bytes that are not trusted to an object that any other program can be given as JSON."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn

from potr_cl.errors import DataError

#: Whole numbers have at most this many bits beside their sign: what other languages read them into.
_BITS = 63


def parse(raw: bytes) -> dict[str, Any]:
    """The object of a metadata section.

    Strict, where Python's own reader is lenient: UTF-8 only, no NaN or Infinity, no number beyond float64 or 64 bits,
    no half of a surrogate pair. So what comes out can be written as JSON again.

    Raises:
        DataError: it is something else.
    """
    try:
        facts = json.loads(raw.decode("utf-8"), parse_constant=_refuse, parse_float=_real, parse_int=_whole)
        json.dumps(facts, ensure_ascii=False).encode("utf-8")  # fails on half a surrogate pair
    except (ValueError, RecursionError):
        facts = None
    if not isinstance(facts, dict):
        raise DataError("section 'metadata' is not a JSON object")
    return facts


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def _real(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError("beyond float64")
    return value


def _whole(digits: str) -> int:
    # Length first: to read thousands of digits takes long, and Python refuses it with an error of its own.
    value = int(digits) if len(digits) <= 20 else 1 << 64
    if abs(value) >> _BITS:
        raise ValueError("beyond 64 bits")
    return value
