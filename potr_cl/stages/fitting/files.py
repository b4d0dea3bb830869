"""Two files, with a fit and without it, and which is the better one: :class:`TwoFiles`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

#: By how much more the logarithm of a file's size grows for a decibel, at the least and at the most: 0.11 to 0.13 on
#: lego and plush between q = 0.2 and 0.6 (docs/benchmarks/rate_distortion.md); less where few splats do most.
_LEAST_RATE, _MOST_RATE = 0.05, 0.15
#: What has to be gained: a few held-out views are no exact judges.
_LESS = 0.99


@dataclass(frozen=True)
class File:
    """What a file takes, and what it shows.

    Attributes:
        nbytes: its size.
        error: mean squared error of the views that were held out.
    """

    nbytes: int
    error: float

    @property
    def psnr(self) -> float:
        """Of these views, in decibels."""
        return -10 * math.log10(max(self.error, 1e-20))


@dataclass(frozen=True)
class TwoFiles:
    """A file without a fit and one with it.

    Attributes:
        without, fitted: the two.
    """

    without: File
    fitted: File

    @property
    def pays(self) -> bool:
        """Whether the fit makes a file that is smaller at the same PSNR, however much a decibel takes."""
        decibels = self.fitted.psnr - self.without.psnr
        growth = math.log(self.fitted.nbytes / self.without.nbytes) - math.log(_LESS)
        return all(growth < rate * decibels for rate in (_LEAST_RATE, _MOST_RATE))

    @property
    def facts(self) -> dict[str, Any]:
        """All by name."""
        files = {"without": self.without, "with": self.fitted}
        return {name: {"bytes": each.nbytes, "psnr": each.psnr} for name, each in files.items()}

    def __str__(self) -> str:
        def told(file: File) -> str:
            return f"{file.nbytes:,} bytes and {file.psnr:.2f} dB"

        return f"files made to see whether it pays: {told(self.fitted)} with it, {told(self.without)} without"
