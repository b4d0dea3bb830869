"""What a fit of a reduced scene to photographs has come to: :class:`FittedToPhotographs`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from potr_cl.model.scene import Scene


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
        first, best = _decibels(self.trial[0]), _decibels(min(self.trial))
        trial = f"in a trial {self.held_out} of {self.photographs} were held out, and matched "
        if self.scene is None:
            why = "it was interrupted" if self.ended_early else f"{trial}no better than before ({first:.2f} dB)"
            return f"the scene was not fitted to photographs: {why}"
        before, after = _decibels(self.errors[0]), _decibels(self.errors[-1])
        return (
            f"to {self.photographs} photographs in {self.steps} steps: {before:.2f} dB before, {after:.2f} dB after; "
            f"{trial}better ({first:.2f} dB before, {best:.2f} dB after)"
        )


def _decibels(error: float) -> float:
    """The PSNR of a mean squared error of colours from 0 to 1."""
    return -10 * math.log10(max(error, 1e-20))
