"""What a search is asked for (:class:`Target`), and what it finds (:class:`Found`)."""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import dataclass
from numbers import Real

from potr_cl.errors import UsageError
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions

#: The kinds of tries (:class:`Try`), and what is said of each; to be followed by a value.
KINDS = {
    "scout": "trying quality {}:",
    "encode": "quality {}:",
    "refit": "re-fitted for quality {}:",
    "steps": "steps of quality {}:",
    "colours": "quality {} with other precision of colours:",
}


@dataclass(frozen=True)
class Target:
    """What to reach: a size or a PSNR.

    Attributes:
        max_bytes: the file shall have at most so many bytes, and at least 98 % of them.
        min_psnr: the mean PSNR in decibels over the judging views, against the uncompressed scene's renders, shall be
            this at least, and at most 0.1 more.

    Raises:
        UsageError: both or neither are given, or the value is out of range.
    """

    max_bytes: int | None = None
    min_psnr: float | None = None

    def __post_init__(self) -> None:
        if (self.max_bytes is None) == (self.min_psnr is None):
            raise UsageError("give either a size or a PSNR to reach")
        if self.max_bytes is not None and self.max_bytes < 1:
            raise UsageError(f"a file of at most {self.max_bytes} bytes: at least 1 is needed")
        if self.min_psnr is not None and not 0 < self.min_psnr < math.inf:
            raise UsageError(f"a PSNR of at least {self.min_psnr:g} dB: it must be a positive number")

    @property
    def window(self) -> tuple[float, float]:
        """The values with which the search is content: logarithms of sizes, or decibels."""
        if self.max_bytes is not None:
            return math.log(0.98 * self.max_bytes), math.log(self.max_bytes)
        assert self.min_psnr is not None
        return self.min_psnr, self.min_psnr + 0.1

    @property
    def aim(self) -> float:
        """The value to aim at: the middle of the window."""
        return sum(self.window) / 2

    def met(self, value: float) -> bool:
        """Whether a value keeps the promise, if not by how little."""
        low, high = self.window
        return value <= high if self.max_bytes is not None else value >= low

    def inside(self, value: float) -> bool:
        """Whether the search is content with a value."""
        low, high = self.window
        return low <= value <= high

    def plain(self, value: float) -> float:
        """A value as bytes or decibels."""
        return round(math.exp(value)) if self.max_bytes is not None else value

    def describe(self, value: float) -> str:
        """A value for people."""
        return f"{self.plain(value):,} bytes" if self.max_bytes is not None else f"{value:.2f} dB"

    def __str__(self) -> str:
        return f"at most {self.max_bytes:,} bytes" if self.max_bytes is not None else f"at least {self.min_psnr:g} dB"


@dataclass(frozen=True)
class Try:
    """One step of a search.

    Attributes:
        kind: "scout" (a rough encode), "encode" (in full), "refit" (the splats of the last full encode, re-fitted and
            quantised for another q), "steps" (other quantiser steps alone), or "colours" (of colours alone).
        q: of the encode, the re-fit or the steps.
        value: see :meth:`Target.plain`.
    """

    kind: str
    q: float
    value: float


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        encoded: the file that meets the target.
        options: that it was encoded with: q, and parameters of their own where they differ from that q's. Without
            compaction :func:`potr_cl.pipeline.encode.encode` makes the same file of them.
        value: that was reached; see :meth:`Target.plain`.
        tries: all steps, in order.
    """

    encoded: Encoded
    options: EncodeOptions
    value: float
    tries: list[Try]

    def __repr__(self) -> str:
        return f"Found({self.encoded!r} after {len(self.tries)} tries)"


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
