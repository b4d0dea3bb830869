"""The solver of the joint re-fit, after "Re-fit of the colours" in docs/method.md:

    minimise over x: sum over views s of w_s |A_s x - target_s|^2 + lambda |x_AC|^2 + prior |x - start|^2
    (lambda threefold on chroma)

It uses conjugate gradients on the normal equations, preconditioned by each splat's own block. Colours that are cut at 0
count as constant while it looks for a solution. Then it measures the true error of the result, and keeps the start if
that was better.

It also chooses which AC coefficients are worth their bytes: after a few steps it gives up those whose loss would cost
less than a given squared error, and solves again for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.colour_map import ColourMap
from potr_cl.stages.refitting.conjugate_gradients import ConjugateGradients
from potr_cl.stages.refitting.layout import Ridge
from potr_cl.views.targets import Targets

#: Half steps tried when a solution is worse than its start because colours were cut at 0 on the way.
_HALVINGS = 4


@dataclass(frozen=True)
class Descent:
    """How to find a solution.

    Attributes:
        steps: the most conjugate-gradient steps.
        gain: stop when a step takes less than this part off the objective.
        ridge: what holds the coefficients down or near their start.
        part: of the views (:attr:`OwnViews.parts`) by which the normal equations are made, for a way that need not be
            exact because another one follows, or leads less far; None: of all.
    """

    steps: int
    gain: float
    ridge: Ridge
    part: int | None = None


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
    """The map, the pictures to come near to, and whether DC alone may change."""

    colour_map: ColourMap
    targets: Targets
    constant: bool


@dataclass(frozen=True)
class _NormalEquations:
    """The matrix Aᵀ W A + ridge of the conjugate gradients; colours are cut at 0 as they are ``at`` a vector.

    With ``constant``, only DC may change.
    """

    colour_map: ColourMap
    coefficients: Coefficients
    blocks: SplatBlocks
    ridge: Ridge
    at: Vector
    constant: bool
    part: int | None

    def precondition(self, residual: Vector, result: Vector) -> None:
        self.blocks.precondition(residual, self.ridge, result)

    def product(self, direction: Vector, result: Vector) -> None:
        self.coefficients.zero(result)
        self.colour_map.normal(direction, self.at, result, self.constant, self.part)
        self.coefficients.add_ridge(result, direction, self.ridge)


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

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
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

        Raises:
            DeviceError: the device failed.
        """
        problem = _Problem(colour_map, targets, constant)
        self._coefficients.copy(self._start, self.x)
        ridge = (selection.descent if selection else descent).ridge
        first = self._linearise(problem, ridge, None if constant else self.blocks)
        after_start()
        state, steps = first, 0
        if selection is not None:
            state, steps = self._choose(problem, first, selection, descent.ridge, after_step)
        more = self._descend(problem, state, descent, lambda done: after_step(steps + done))
        whole = colour_map.total_weight
        start = state.error / whole
        if not check:
            return Solved((first.error / whole, math.nan), steps + more, start)
        last = self._halve_until_better(problem, state, descent.ridge)
        if last is None:
            last, more = state, 0
        return Solved((first.error / whole, last.error / whole), steps + more, start)

    def error(self, colour_map: ColourMap, targets: Targets) -> float:
        """Mean squared error at ``x``.

        Raises:
            DeviceError: the device failed.
        """
        self._coefficients.zero(self._residual)
        return colour_map.gradient(self.x, targets, self._residual) / colour_map.total_weight

    def go_on(self, colour_map: ColourMap, targets: Targets, descent: Descent) -> Solved:
        """Go on from where x is, some steps that nobody checks, with the blocks of the solution before.

        Returns:
            What it did; the error after it is not a number.

        Raises:
            DeviceError: the device failed.
        """
        problem = _Problem(colour_map, targets, constant=False)
        state = self._start_here(problem, descent.ridge)
        steps = self._descend(problem, state, descent, lambda done: None)
        start = state.error / colour_map.total_weight
        return Solved((start, math.nan), steps, start)

    def _linearise(self, problem: _Problem, ridge: Ridge, blocks: SplatBlocks | None = None) -> _State:
        """Settle which colours are cut, and make the residual: minus half the objective's gradient at x."""
        vectors, residual = self._coefficients, self._residual
        change, pulled = self._gradients.direction, self._gradients.product
        shrinking = replace(ridge, prior=0.0)
        vectors.zero(residual)
        error = problem.colour_map.gradient(self.x, problem.targets, residual, blocks, problem.constant)
        vectors.add_ridge(residual, self.x, shrinking)
        vectors.zero(pulled)
        vectors.add_ridge(pulled, self.x, shrinking)
        penalty = vectors.dot(self.x, pulled)
        vectors.copy(change, self.x)
        vectors.combine(1.0, change, -1.0, self._start)
        penalty += ridge.prior * vectors.dot(change, change)
        vectors.combine(-1.0, residual, -ridge.prior, change)
        return _State(error, error + penalty)

    def _descend(self, problem: _Problem, state: _State, how: Descent, after_step: Callable[[int], None]) -> int:
        """Take conjugate-gradient steps from where x was linearised; returns their number."""
        equations = _NormalEquations(
            problem.colour_map, self._coefficients, self.blocks, how.ridge, self._start, problem.constant, how.part
        )
        return self._gradients.descend(
            equations, self.x, self._residual, state.objective, how.steps, how.gain, after_step
        )

    def _halve_until_better(self, problem: _Problem, state: _State, ridge: Ridge) -> _State | None:
        """Go half the way back to the start, again and again, until x is better than the start.

        Returns:
            The state at x; None if nothing helps, with x back at the start.
        """
        last = self._linearise(problem, ridge)
        for _ in range(_HALVINGS):
            if last.objective <= state.objective:
                break
            self._coefficients.combine(0.5, self.x, 0.5, self._start)
            last = self._linearise(problem, ridge)
        if not last.objective <= state.objective:
            self._coefficients.copy(self.x, self._start)
            return None
        return last

    def _choose(
        self, problem: _Problem, first: _State, how: Selection, ridge: Ridge, after_step: Callable[[int], None]
    ) -> tuple[_State, int]:
        """Come near to the solution, give up what costs little there, and start anew from what is left.

        Returns:
            The new start's state, and the steps that led to it.
        """
        vectors = self._coefficients
        chosen_from = vectors.save_flags()
        steps = self._descend(problem, first, how.descent, after_step)
        least = how.least * problem.colour_map.total_weight
        self._give_up(least, ridge)
        former_start = self._gradients.preconditioned
        vectors.copy(former_start, self._start)
        state = self._start_here(problem, ridge)
        given_up = least * int(np.bitwise_count(chosen_from ^ vectors.save_flags()).sum())
        if not state.error <= first.error + given_up:
            # Colours were cut at 0 on the way: choose among the coefficients as they were.
            vectors.copy(self.x, former_start)
            vectors.restore_flags(chosen_from)
            self._give_up(least, ridge)
            state, steps = self._start_here(problem, ridge), 0
        return state, steps

    def _give_up(self, least: float, ridge: Ridge) -> None:
        self.blocks.give_up(self.x, ridge.prior, least)

    def _start_here(self, problem: _Problem, ridge: Ridge) -> _State:
        self._coefficients.copy(self._start, self.x)
        return self._linearise(problem, ridge)
