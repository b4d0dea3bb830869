"""How a re-fit of the colours goes, :class:`RefitOptions`, and what has come of it, :class:`Refitted`."""

from __future__ import annotations

from dataclasses import dataclass

from potr_cl.errors import UsageError
from potr_cl.model.scene import FloatArray


@dataclass(frozen=True)
class RefitOptions:
    """How to re-fit.

    Attributes:
        steps: the most conjugate-gradient steps.
        drop: AC coefficients that cost less mean squared error than this are set to 0 for good, after
            ``selection_steps`` steps. 0: none is.
        selection_steps, selection_lam: steps and lambda before that choice.
        gain: stop when a step takes less than this part off the squared error.
        lam: lambda on the AC coefficients of Y, in pixels of an image of :data:`REFERENCE_PIXELS`.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: the same for every coefficient's distance to its start, so that what no view shows stays as it was.
        memory: bytes of device memory that prepared views and targets may take; None: two fifths
            of what is free, or a quarter where that is the host's memory.
        slices: splats of a slice, with the vectors on the host (:mod:`potr_cl.stages.refitting.placement`); None: only
            where they do not fit.

    Raises:
        UsageError: a value is out of range.
    """

    steps: int = 8
    drop: float = 0.0
    selection_steps: int = 2
    selection_lam: float = 0.0
    gain: float = 0.01
    lam: float = 0.0
    chroma_factor: float = 3.0
    prior: float = 0.1
    memory: int | None = None
    slices: int | None = None

    def __post_init__(self) -> None:
        if self.slices is not None and self.slices < 1:
            raise UsageError(f"slices of {self.slices} splats: at least 1 is needed")
        if self.steps < 0:
            raise UsageError(f"{self.steps} re-fit steps: it must be 0 or more")
        if not 0 <= self.gain < 1:
            raise UsageError(f"the re-fit's least gain a step is {self.gain:g}, it must be 0 or more and below 1")
        if self.selection_steps < 0:
            raise UsageError(f"{self.selection_steps} re-fit steps: it must be 0 or more")
        for name in ("lam", "chroma_factor", "prior", "drop", "selection_lam"):
            if not 0 <= getattr(self, name) <= 1e12:
                raise UsageError(f"the re-fit's {name} is {getattr(self, name):g}, it must lie between 0 and 1e12")


@dataclass(frozen=True)
class Refitted:
    """What a re-fit did.

    Attributes:
        sh: (N, M, 3) float32 coefficients, R, G, B.
        errors: mean squared error over views, pixels and channels before, and after.
        steps: conjugate-gradient steps that were taken.
    """

    sh: FloatArray
    errors: tuple[float, float]
    steps: int
