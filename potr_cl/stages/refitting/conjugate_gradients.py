"""Preconditioned conjugate gradients on vectors that stay where they are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from potr_cl.stages.refitting.coefficients import Vector

#: Steps end where the residual's square, as the preconditioner measures it, has shrunk by this: single precision has no
#: more digits, and what is left of them leads astray.
_CONVERGED = 1e-14


class Vectors(Protocol):
    """Arithmetic of vectors; :class:`potr_cl.stages.refitting.coefficients.Coefficients` is one."""

    def vector(self, rank: int) -> Vector:
        """A new vector; the lower the rank, the more often it is used."""
        ...

    def zero(self, x: Vector) -> None:
        """x = 0."""
        ...

    def combine(self, a: float, y: Vector, b: float, x: Vector) -> None:
        """y = a y + b x."""
        ...

    def dot(self, x: Vector, y: Vector) -> float:
        """x · y."""
        ...


@dataclass(frozen=True)
class System:
    """Linear equations with a symmetric positive matrix H.

    Attributes:
        product: of a direction and a result: result = H direction.
        precondition: of a residual and a result: result = about H⁻¹ residual, by a symmetric positive matrix.
    """

    product: Callable[[Vector, Vector], None]
    precondition: Callable[[Vector, Vector], None]


class ConjugateGradients:
    """Minimises x · H x / 2 - b · x, whose residual is b - H x.

    Args:
        vectors: makes the vectors that the steps need, and computes with them.

    Attributes:
        direction, product, preconditioned: the vectors; free for other use between solutions.
    """

    def __init__(self, vectors: Vectors) -> None:
        self._vectors = vectors
        self.direction, self.product, self.preconditioned = (vectors.vector(rank) for rank in (0, 1, 4))

    def descend(
        self,
        system: System,
        x: Vector,
        residual: Vector,
        objective: float,
        steps: int,
        gain: float,
        after_step: Callable[[int], None],
    ) -> int:
        """Steps from x.

        Args:
            system: the equations.
            x: where to start; is moved.
            residual: at x; is moved along.
            objective: of least squares at x, x · H x - 2 b · x and a constant that makes it 0 or more.
            steps: at the most.
            gain: stop after a step that takes less than this part off the objective that is left.
            after_step: called with the number of steps done.

        Returns:
            The number of steps done.

        Raises:
            DeviceError: the device failed.
        """
        vectors, direction, product, preconditioned = self._vectors, self.direction, self.product, self.preconditioned
        vectors.zero(direction)
        slope, least = 0.0, 0.0
        for step in range(steps):
            system.precondition(residual, preconditioned)
            new_slope = vectors.dot(preconditioned, residual)
            least = _CONVERGED * new_slope if step == 0 else least
            if not (new_slope > least and math.isfinite(new_slope)):
                return step
            vectors.combine(new_slope / slope if step else 0.0, direction, 1.0, preconditioned)
            slope = new_slope
            system.product(direction, product)
            curvature = vectors.dot(direction, product)
            if not (curvature > 0 and math.isfinite(curvature)):
                return step
            length = slope / curvature
            vectors.combine(1.0, x, length, direction)
            vectors.combine(1.0, residual, -length, product)
            gained = length * slope
            objective -= gained
            after_step(step + 1)
            if gained < gain * objective:
                return step + 1
        return steps
