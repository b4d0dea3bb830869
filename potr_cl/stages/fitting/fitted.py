"""What fits have come to: :class:`Fitted`, :class:`LeftOut`, and the trials that decide whether a fit is kept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from potr_cl.model.scene import Scene

#: A fit has gained enough to be taken without a look at files if what it leaves of the cost is below the one part, and
#: of the error, where it has made up for no splats, below the other (docs/benchmarks/findings.md).
_MUCH_CHEAPER, _MUCH = 0.9, 0.4
#: By how much more the logarithm of a file's size grows for a decibel, at the least and at the most: 0.11 to 0.13 on
#: lego and plush between q = 0.2 and 0.6 (docs/benchmarks/rate_distortion.md); less where few splats do most.
_LEAST_RATE, _MOST_RATE = 0.05, 0.15
#: What has to be gained: a few held-out views are no exact judges.
_LESS = 0.99


def decibels(error: float) -> float:
    """The PSNR of a mean squared error of colours from 0 to 1."""
    return -10 * math.log10(max(error, 1e-20))


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
        return decibels(self.error)


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


@dataclass(frozen=True)
class FittedToPhotographs:
    """What a fit to photographs did.

    Attributes:
        scene: the fitted one; None if photographs that were held out did not agree.
        photographs: how many there are.
        steps: that were taken and kept.
        held_out: how many photographs were held out in the trial.
        trial: mean squared error of these before the trial, and after each part of it.
        errors: of photographs that it was fitted to, before and after; empty if the scene is None.
        ended_early: whether someone has asked it to end.
    """

    scene: Scene | None
    photographs: int
    steps: int
    held_out: int
    trial: tuple[float, ...]
    errors: tuple[float, ...] = ()
    ended_early: bool = False

    @property
    def facts(self) -> dict[str, Any]:
        """All but the scene, by name."""
        names = ("photographs", "steps", "held_out", "ended_early")
        facts: dict[str, Any] = {name: getattr(self, name) for name in names}
        return facts | {"trial": list(self.trial), "errors": list(self.errors), "kept": self.scene is not None}

    def __str__(self) -> str:
        first, best = decibels(self.trial[0]), decibels(min(self.trial))
        trial = f"in a trial {self.held_out} of {self.photographs} were held out, and matched "
        if self.scene is None:
            why = "it was interrupted" if self.ended_early else f"{trial}no better than before ({first:.2f} dB)"
            return f"the scene was not fitted to photographs: {why}"
        before, after = decibels(self.errors[0]), decibels(self.errors[-1])
        return (
            f"to {self.photographs} photographs in {self.steps} steps: {before:.2f} dB before, {after:.2f} dB after; "
            f"{trial}better ({first:.2f} dB before, {best:.2f} dB after)"
        )


@dataclass(frozen=True)
class Fitted:
    """What a fit did.

    Attributes:
        scene: the one that is kept.
        steps: that were taken, and kept: of these, up to the round that is kept.
        errors: mean squared error of the held-out views before the first round, and after each.
        held_out: how many views these are.
        ended_early: whether someone has asked it to end.
        spared: how many splats were removed before it for it to make up for.
        without: the error of these views before those were removed; None where none were.
        settled: mean squared error of these views after each fit that followed a choice of coefficients or a rounding.
        photographs: what a further fit to photographs did; None if there were none.
        cost: what the scene costs, error and splats together, as a part of what it cost before those were removed.
        files: that were made to see whether the fit pays; None where there was no doubt.
        pace: by how many times its first steps were longer than usual ones.
    """

    scene: Scene
    steps: int
    kept: int
    errors: tuple[float, ...]
    held_out: int
    ended_early: bool = False
    spared: int = 0
    without: float | None = None
    settled: tuple[float, ...] = ()
    photographs: FittedToPhotographs | None = None
    cost: float = 0.0
    files: TwoFiles | None = None
    pace: float = 1.0

    @property
    def in_doubt(self) -> bool:
        """Whether what was gained is so little that the file may lose it again."""
        little = self.without is not None and not self.spared and self.error > _MUCH * self.without
        return little or self.cost > _MUCH_CHEAPER

    @property
    def error(self) -> float:
        """Of the held-out views, of the scene that is kept."""
        return min(self.errors)

    @property
    def psnr(self) -> tuple[float, float]:
        """Of the held-out views before and after, in decibels."""
        return decibels(self.errors[0]), decibels(min(self.errors))

    @property
    def facts(self) -> dict[str, Any]:
        """All but the scene, by name."""
        names = ("steps", "kept", "held_out", "ended_early", "spared", "without", "pace")
        facts = {name: getattr(self, name) for name in names}
        facts |= {"errors": list(self.errors), "settled": list(self.settled)}
        facts |= {"cost": self.cost, "files": None if self.files is None else self.files.facts}
        return facts | {"photographs": None if self.photographs is None else self.photographs.facts}

    def __str__(self) -> str:
        before, after = self.psnr
        views = f"{self.held_out} view{'s' if self.held_out > 1 else ''} held out"
        steps = f"{self.kept} of {self.steps} steps are kept"
        if self.ended_early:
            steps += ", interrupted"
        said = f"{steps}: PSNR {before:.2f} dB before, {after:.2f} dB after, {views}"
        if self.spared and self.without is not None:
            said += f"; {decibels(self.without):.2f} dB with {self.spared:,} splats more, without it"
        if self.settled:
            said += f"; {decibels(self.settled[-1]):.2f} dB with geometry and coefficients as in the file"
        for each in (self.files, self.photographs):
            said += "" if each is None else f"; {each}"
        return said


@dataclass(frozen=True)
class LeftOut:
    """That a fit was left out, so that the scene is as it would be without it.

    Attributes:
        why: as people are told it.
        ended_early: whether someone has asked it to end.
        photographs: what a fit to photographs did; None if there were none.
        files: that were made to see whether it pays; None if it was left out before.
    """

    why: str
    ended_early: bool = False
    photographs: FittedToPhotographs | None = None
    files: TwoFiles | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """All by name."""
        photographs = None if self.photographs is None else self.photographs.facts
        files = None if self.files is None else self.files.facts
        return {"left_out": self.why, "ended_early": self.ended_early, "photographs": photographs, "files": files}

    def __str__(self) -> str:
        more = "".join(f"; {each}" for each in (self.files, self.photographs) if each is not None)
        return f"no fit: {self.why}{more}"
