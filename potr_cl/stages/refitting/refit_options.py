"""How a re-fit of the colours goes, :class:`RefitOptions`, of what, :class:`ComingScene`, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.host.threads import in_background
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.stages.refitting.sliced_arrays import Ridge

#: Of so many blocks of pixels one makes the normal equations: of all steps, and of shorter ways that another follows.
HALF, QUARTER = 2, 4


@dataclass(frozen=True)
class Descent:
    """How to find a solution.

    Attributes:
        steps: the most conjugate-gradient steps.
        gain: stop when a step takes less than this part off the objective.
        ridge: what holds the coefficients down or near their start.
        every: of so many blocks of the views' pixels one makes the normal equations; the gradient that they are solved
            for is that of all pixels. 1: all do.
    """

    steps: int
    gain: float
    ridge: Ridge
    every: int = 1


@dataclass(frozen=True)
class Selection:
    """How to choose the AC coefficients that are given up.

    Attributes:
        descent: how to come near to the solution before the choice.
        least: coefficients that cost less mean squared error than this are given up.
    """

    descent: Descent
    least: float


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
        slices: splats of a slice, with the vectors on the host (:func:`residency_of`); None: only
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

    @property
    def ridge(self) -> Ridge:
        """What holds the coefficients down or near their start."""
        return Ridge(self.lam, self.chroma_factor, self.prior)

    @property
    def descent(self) -> Descent:
        """The way to the solution."""
        return Descent(self.steps, self.gain, self.ridge)

    @property
    def selection(self) -> Selection | None:
        """What comes before it; None: no coefficient is given up."""
        if not self.drop:
            return None
        ridge = replace(self.ridge, lam=self.selection_lam)
        return Selection(Descent(self.selection_steps, self.gain, ridge, QUARTER), self.drop)

    @property
    def most_steps(self) -> int:
        """Steps of both together, at the most."""
        return self.steps + (self.selection_steps if self.drop else 0)


@dataclass(frozen=True)
class Refitted:
    """What a re-fit did.

    Attributes:
        sh: (N, M, 3) float32 coefficients, R, G, B.
        errors: mean squared error over views, pixels and channels before, and after; where colours were rounded in
            rounds, before the last step instead, which takes off some more, and on a CPU perhaps by half of the pixels.
        steps: conjugate-gradient steps that were taken.
    """

    sh: FloatArray
    errors: tuple[float, float]
    steps: int


class ComingScene:
    """A scene that a thread of its own makes.

    Its geometry takes the host long, and much of a re-fit can be made ready without it.

    Args:
        sh: (N, M, 3) the scene's colours.
        make: returns the scene, with these colours.

    Attributes:
        sh: as given.
    """

    def __init__(self, sh: FloatArray, make: Callable[[], Scene]) -> None:
        self.sh = sh
        self._made: Future[Scene] = in_background(make)

    def __len__(self) -> int:
        return len(self.sh)

    def result(self) -> Scene:
        """The scene, once it is there.

        Raises:
            What making it raised.
        """
        return self._made.result()


#: A scene that is there or will be.
AnyScene: TypeAlias = Scene | ComingScene


def arrived(scene: AnyScene) -> Scene:
    """The scene itself, once it is there.

    Raises:
        What making it raised.
    """
    return scene.result() if isinstance(scene, ComingScene) else scene


def colourless(scene: Scene) -> Scene:
    """The same splats in black: a re-fit's rasterizer is never asked for colours."""
    return replace(scene, sh=np.broadcast_to(np.float32(0), (len(scene), 1, 3)))
