"""The solver of the joint re-fit, after "Re-fit of the colours" in docs/method.md:

    minimise over x: sum over views s of w_s |A_s x - target_s|^2 + lambda |x_AC|^2 + prior |x - start|^2
    (lambda threefold on chroma)

It uses conjugate gradients on the normal equations, preconditioned by each splat's own block and share of its pixels.
Colours that are cut at 0 count as constant while it looks for a solution. Then it measures the true error of the
result, and keeps the start if that was better.

It also chooses which AC coefficients are worth their bytes: after a few steps it gives up those whose loss would cost
less than a given squared error, and solves again for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.refit_options import QUARTER, Descent, Selection
from potr_cl.stages.refitting.sliced_arrays import Ridge
from potr_cl.views.targets import Targets

#: Steps end where the residual's square, as the preconditioner measures it, has shrunk by this: single precision has no
#: more digits, and what is left of them leads astray.
_CONVERGED = 1e-14
#: Steps that take off more than there is, by this part of the objective at the start, go by rounding alone: so it ends
#: where equations say nothing of some coefficients, and nobody stops it in time.
_IMPOSSIBLE = 1e-3
#: So do steps whose residual's square has shrunk by the first and grown again to the second.
_SMALL, _LARGE = 1e-6, 1e-3


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

    def __init__(self, vectors: Coefficients) -> None:
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
            The number of steps done; -1 if rounding has led x astray.
        """
        vectors, direction, product, preconditioned = self._vectors, self.direction, self.product, self.preconditioned
        vectors.zero(direction)
        slope, first, small, lost = 0.0, 0.0, False, -_IMPOSSIBLE * objective
        for step in range(steps):
            system.precondition(residual, preconditioned)
            new_slope = vectors.dot(preconditioned, residual)
            first = new_slope if step == 0 else first
            if not (new_slope > _CONVERGED * first and math.isfinite(new_slope)):
                return step
            small = small or new_slope < _SMALL * first
            if small and new_slope > _LARGE * first:
                return -1
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
            if objective < lost:
                return -1
            after_step(step + 1)
            if gained < gain * objective:
                return step + 1
        return steps


#: Half steps tried when a solution is worse than its start because colours were cut at 0 on the way.
_HALVINGS = 4


@dataclass(frozen=True)
class Solved:
    """What a solution did.

    Attributes:
        errors: mean squared error over views, pixels and channels before, and after.
        steps: conjugate-gradient steps that were taken and kept.
        start: mean squared error where the last of them began, after the choice.
    """

    errors: tuple[float, float]
    steps: int
    start: float

    @property
    def worst(self) -> float:
        """Mean squared error that a solution may have and still be one."""
        return max(self.errors[0], self.start)


@dataclass(frozen=True)
class _Problem:
    """The map, the pictures to come near to, whether DC alone may change, and of how many blocks of pixels the gradient
    looks at one; steps have their own.
    """

    colour_map: ColourMap
    targets: Targets
    constant: bool
    every: int = 1


@dataclass(frozen=True)
class _State:
    """Squared error by W at some coefficients, and with the ridge."""

    error: float
    objective: float


class ColourSolver:
    """Solves for one scene's coefficients, on vectors of its own.

    Args:
        coefficients: makes the vectors, which live as long as it does, and knows which coefficients may change.
        blocks: the splats' own ones.

    Attributes:
        x: the coefficients: set them to the start before :meth:`solve`, which leaves the solution in them.
        blocks: the splats' own blocks, as they were at the last start.
    """

    def __init__(self, coefficients: Coefficients, blocks: SplatBlocks) -> None:
        self._coefficients = coefficients
        # Conjugate gradients have the ranks between.
        self.x, self._start, self._residual = (coefficients.vector(rank) for rank in (3, 5, 2))
        self._gradients = ConjugateGradients(coefficients)
        self.blocks = blocks

    def solve(
        self,
        colour_map: ColourMap,
        targets: Targets,
        descent: Descent,
        selection: Selection | None = None,
        after_step: Callable[[int], None] = lambda steps: None,
        constant: bool = False,
        check: bool = True,
        after_start: Callable[[], None] = lambda: None,
        every: int = 1,
    ) -> Solved:
        """Solve for the active coefficients, after choosing among them if there is to be a choice.

        Args:
            colour_map: A of the scene.
            targets: the pictures to come near to.
            descent: to the solution.
            selection: what comes first.
            after_step: called with the number of steps done.
            constant: the constant coefficients alone are active. The splats' blocks are then those of the solution
                before, of nearly the same colours: they are only what the steps are preconditioned with.
            check: measure the true error of the result, and go back if the start was better. If not, the error after
                the solution is not a number.
            after_start: called when the blocks are those of the start.
            every: of so many blocks of pixels the gradient looks at one, on CPUs and where views are many; if DC alone
                may change, and nothing is to be checked.
        """
        problem = _Problem(colour_map, targets, constant, every)
        vectors, ridge, whole = self._coefficients, descent.ridge, colour_map.total_weight
        vectors.copy(self._start, self.x)
        first_ridge = selection.descent.ridge if selection else ridge
        state = first = self._linearise(problem, first_ridge, None if constant else self.blocks)
        after_start()
        if not constant:
            self._share(problem)
        steps = 0
        if selection is not None:
            chosen_from = vectors.save_flags()
            steps = self._descend(problem, selection.descent, first.objective, after_step)
            state, steps = self._choose(problem, first, chosen_from, steps, selection.least * whole, ridge)
        more = self._descend(problem, descent, state.objective, lambda done: after_step(steps + done))
        start = state.error / whole
        if not check:
            return Solved((first.error / whole, math.nan), steps + more, start)
        # Go half the way back to the start, again and again, until x is better than the start.
        last = self._measured(problem, ridge)
        for _ in range(_HALVINGS):
            if last.objective <= state.objective:
                break
            vectors.combine(0.5, self.x, 0.5, self._start)
            last = self._measured(problem, ridge)
        if not last.objective <= state.objective:
            vectors.copy(self.x, self._start)
            last, more = state, 0
        return Solved((first.error / whole, last.error / whole), steps + more, start)

    def error(self, colour_map: ColourMap, targets: Targets) -> float:
        """Mean squared error at ``x``."""
        return colour_map.error(self.x, targets) / colour_map.total_weight

    def go_on(self, colour_map: ColourMap, targets: Targets, descent: Descent) -> Solved:
        """Go on from where x is, some steps that nobody checks, with the blocks of the solution before.

        Returns:
            What it did; the error after it is not a number.
        """
        problem = _Problem(colour_map, targets, constant=False)
        self._coefficients.copy(self._start, self.x)
        state = self._linearise(problem, descent.ridge)
        steps = self._descend(problem, descent, state.objective, lambda done: None)
        start = state.error / colour_map.total_weight
        return Solved((start, math.nan), steps, start)

    def _linearise(self, problem: _Problem, ridge: Ridge, blocks: SplatBlocks | None = None) -> _State:
        """Settle which colours are cut, and make the residual: minus half the objective's gradient at x."""
        vectors, residual = self._coefficients, self._residual
        vectors.zero(residual)
        given = (self.x, problem.targets, residual, blocks, problem.constant, problem.every)
        error = problem.colour_map.gradient(*given)
        vectors.add_ridge(residual, self.x, replace(ridge, prior=0.0))
        penalty, change = self._penalty(ridge)
        vectors.combine(-1.0, residual, -ridge.prior, change)
        return _State(error, error + penalty)

    def _measured(self, problem: _Problem, ridge: Ridge) -> _State:
        """What :meth:`_linearise` would return at x."""
        error = problem.colour_map.error(self.x, problem.targets)
        return _State(error, error + self._penalty(ridge)[0])

    def _penalty(self, ridge: Ridge) -> tuple[float, Vector]:
        """What the ridge adds to the objective at x; and how far x is from the start."""
        vectors, change, pulled = self._coefficients, self._gradients.direction, self._gradients.product
        vectors.zero(pulled)
        vectors.add_ridge(pulled, self.x, replace(ridge, prior=0.0))
        penalty = vectors.dot(self.x, pulled)
        vectors.copy(change, self.x)
        vectors.combine(1.0, change, -1.0, self._start)
        return penalty + ridge.prior * vectors.dot(change, change), change

    def _descend(self, problem: _Problem, how: Descent, objective: float, after_step: Callable[[int], None]) -> int:
        """Steps from x, and how many; back at the start, and 0, where rounding has led astray."""
        system = self._system(problem, how)
        steps = self._gradients.descend(system, self.x, self._residual, objective, how.steps, how.gain, after_step)
        if steps < 0:
            self._coefficients.copy(self.x, self._start)
        return max(steps, 0)

    def _system(self, problem: _Problem, how: Descent) -> System:
        """Aᵀ W A + ridge; colours are cut at 0 as they are at the start."""
        normal = problem.colour_map.normal
        product = partial(normal, at=self._start, ridge=how.ridge, constant=problem.constant, every=how.every)
        return System(product, partial(self.blocks.precondition, ridge=how.ridge))

    def _share(self, problem: _Problem) -> None:
        """Find the splats' shares of pixels, as at the start, by a quarter of these."""
        normal, nothing = problem.colour_map.normal, Ridge(0.0, 0.0, 0.0)
        product = partial(normal, at=self._start, ridge=nothing, constant=True, every=QUARTER)
        self.blocks.share(product, self._gradients.direction, self._gradients.product)

    def _choose(
        self, problem: _Problem, first: _State, chosen_from: NDArray[np.uint32], steps: int, least: float, ridge: Ridge
    ) -> tuple[_State, int]:
        """Give up what costs little where x has come to, and start anew from what is left.

        Returns:
            The new start's state, and the steps that led to it.
        """
        vectors, blocks = self._coefficients, self.blocks
        blocks.give_up(self.x, ridge.prior, least)
        former_start = self._gradients.preconditioned
        vectors.copy(former_start, self._start)
        vectors.copy(self._start, self.x)
        state = self._linearise(problem, ridge)
        given_up = least * int(np.bitwise_count(chosen_from ^ vectors.save_flags()).sum())
        if not state.error <= first.error + given_up:
            # Colours were cut at 0 on the way: choose among the coefficients as they were.
            vectors.copy(self.x, former_start)
            vectors.restore_flags(chosen_from)
            blocks.give_up(self.x, ridge.prior, least)
            vectors.copy(self._start, self.x)
            state, steps = self._linearise(problem, ridge), 0
        return state, steps
