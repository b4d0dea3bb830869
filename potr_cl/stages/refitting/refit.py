"""Joint re-fit of the colours: :func:`refit_colours` wins back what pruning and compaction have lost.

With fixed geometry and opacities a picture is linear in the SH coefficients, except where a colour is cut at 0
(colour_map.py). So one linear least-squares problem gives the coefficients of all splats together, such that the
pictures of all views come near to given ones (targets.py). As in the compaction, a ridge holds the AC coefficients down
(solver.py). colour_refit.py puts these together; here is how a scene is solved, and rounded on the way.

This is not in the paper, which solves for each splat alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import nonzero_levels, to_ycocg
from potr_cl.host.threads import in_background, thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import ColourGrid
from potr_cl.stages.refitting.blocks import ROUNDS, Rounding, Steps
from potr_cl.stages.refitting.coefficients import Vector
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit_options import HALF, QUARTER, AnyScene, Descent, RefitOptions, Refitted
from potr_cl.stages.refitting.solver import Solved
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import Targets

#: Steps in which the constant coefficients are solved for once more, after the others have been rounded.
_CONSTANT_STEPS = 3
#: Of the time of a re-fit, in that of a step, as measured with four scenes on a CPU: until its first step; and, where
#: colours are rounded, after its last one, of which a part until all but the last ones are.
_BEGINNING, _ROUNDING, _OF_FIRST_ROUNDS = 5, 6, 4
#: What a coefficient that becomes 0 as it is rounded is worth, as a part of what one is worth that is given up before.
#: What the others of the splat are counted on to make up for is more than they can.
_WORTH = 0.4
#: Pixels of all views for each splat from which on half of them make the normal equations of all steps. With 199 and
#: more that costs at most 0.3 % of the bytes at equal PSNR, with 145 0.3 %, with 121 0.7 %, with 43 1.4 %.
_DENSE = 150
#: With so many, half of them tell the constant coefficients that the last rounding leaves: with 121 and 145 that costs
#: less than 0.1 % of the bytes at equal PSNR.
_HALF_OF = 100
#: What is nearer to 0 than this was 0 before it was made R, G and B.
_ZERO = 1e-6
#: Splats whose coefficients a thread looks at.
_LOOKED_AT = 1 << 14


def refit_colours(
    device: Device,
    scene: AnyScene,
    cameras: Sequence[Camera],
    targets: Targets,
    options: RefitOptions | None = None,
    active: NDArray[np.bool_] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    progress: Callable[[int, int], None] | None = None,
    fix_ac: Callable[[FloatArray, ColourRefit], FloatArray] | None = None,
    help_from: HelpFrom | None = None,
    colour_grid: Callable[[FloatArray], ColourGrid] | None = None,
) -> Refitted:
    """Re-fit a scene's colours to pictures of all views together.

    Args:
        device: to compute on.
        scene: its geometry and opacities stay, its colours are the start. It may still be to come.
        cameras: the views that count.
        targets: the picture that each of them should show.
        options: of the solver.
        active: (N, M, 3) in Y, Co, Cg: the coefficients that may differ from 0; all by default.
        background: R, G, B behind the scene.
        progress: called with what is done and with how much there is to do, in the time of a step.
        fix_ac: chooses the AC coefficients that a file can hold, from the solution (N, M, 3) R, G, B, which it must not
            change, and from what the re-fit knows of them (:meth:`ColourRefit.worth`). The constant ones are then
            solved for again. If it returns the solution itself, that stays as it is.
        help_from: workers that do some of the views; the targets are then pictures of a scene.
        colour_grid: in place of ``fix_ac``, where colours are rounded to steps of their splats, in rounds
            (:mod:`potr_cl.stages.refitting.blocks`): it gets :meth:`ColourRefit.worth_of_constants`, in a thread of
            its own, and returns the steps.

    Raises:
        UsageError: no camera.
        DeviceError: the scene does not fit the device.
        What making a scene raises that is still to come.
    """
    options = options or RefitOptions()
    more = 0 if fix_ac is None and colour_grid is None else _ROUNDING
    steps = options.most_steps

    def report(done: int, _: int = steps) -> None:
        if progress is not None:
            progress(_BEGINNING + done, _BEGINNING + steps + more)

    with ColourRefit(
        device, scene, cameras, background=background, memory=options.memory, help_from=help_from, slices=options.slices
    ) as refit:
        each = sum(camera.width * camera.height for camera in cameras) / len(scene)
        way: _Rounding
        if colour_grid is not None:
            half = each >= _HALF_OF
            way = _OnGrid(refit, targets, options, colour_grid, lambda: report(steps + _OF_FIRST_ROUNDS), half)
        elif fix_ac is not None:
            way = _AsTheFileDoes(refit, targets, options, fix_ac)
        else:
            return refit.solve(scene.sh, targets, options, active, progress=report)

        def begin() -> None:
            way.begin()
            report(0)

        # What steps by half of the pixels leave, the rounds take away; a file that rounds in its own way has none.
        quick = replace(options.descent, every=HALF) if each >= _DENSE and colour_grid is not None else options.descent
        how = (options.selection, report)
        refit.start_from(scene.sh, active)
        solved = refit.solver.solve(refit.colour_map, targets, quick, *how, check=False, after_start=begin)
        result, at_start = way.finish(solved)
        # How good the solution was, the next one has measured at its start: that saves a sweep. Only if it looks bad is
        # it measured by itself, because the rounding may be what was bad. Where many colours were cut at 0 on the way,
        # it is the solution.
        if not at_start <= solved.worst and not way.error() <= solved.worst:
            refit.start_from(scene.sh, active)
            solved = refit.solver.solve(refit.colour_map, targets, options.descent, *how, after_start=begin)
            result, _ = way.finish(solved)
        return result


class _Rounding(Protocol):
    """What becomes of a solution's AC coefficients, and of the constant ones then."""

    def begin(self) -> None:
        """Called when the splats' blocks are known."""
        ...

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        """Round, and solve for the constant coefficients; also the error between the two."""
        ...

    def error(self) -> float:
        """Of the solution, before it was rounded."""
        ...


@dataclass
class _OnGrid:
    """Rounded on the device, to steps that are found while it solves."""

    refit: ColourRefit
    targets: Targets
    options: RefitOptions
    colour_grid: Callable[[FloatArray], ColourGrid]
    after_first: Callable[[], None]
    half: bool
    _steps: Future[Steps] | None = None
    _unrounded: Vector | None = None

    def begin(self) -> None:
        stride = self.refit.coefficients.layout.stride

        def find(effects: FloatArray) -> Steps:
            return Steps.of(self.colour_grid(effects), stride)

        self._steps = in_background(find, self.refit.worth_of_constants())

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        assert self._steps is not None
        coefficients, colour_map, solver = self.refit.coefficients, self.refit.colour_map, self.refit.solver
        steps_of_splats, steps, errors, ridge = self._steps.result(), solved.steps, list[float](), self.options.ridge
        if self._unrounded is None:
            self._unrounded = coefficients.vector()
        coefficients.copy(self._unrounded, solver.x)
        worth = _WORTH * self.options.drop * colour_map.total_weight
        with Rounding(coefficients, steps_of_splats) as rounding:
            *first, last = ROUNDS
            for each in first:
                rounding.round(solver.x, solver.blocks, each, worth)
                gone_on = solver.go_on(colour_map, self.targets, Descent(each.steps, 0.0, ridge, QUARTER))
                steps += gone_on.steps
                errors.append(gone_on.start)
            self.after_first()
            rounding.round(solver.x, solver.blocks, last, worth)
            how, every = Descent(last.steps, 0.0, ridge, QUARTER), HALF if self.half else 1
            # The last step is short, and helped wherever it was looked at: docs/benchmarks/time_error.md.
            again = solver.solve(colour_map, self.targets, how, constant=True, check=False, every=every)
        # But for the last constant coefficients, which are rounded as the file is made.
        return Refitted(self.refit.colours(), (solved.errors[0], again.start), steps + again.steps), errors[0]

    def error(self) -> float:
        assert self._unrounded is not None
        self.refit.coefficients.copy(self.refit.solver.x, self._unrounded)
        return self.refit.solver.error(self.refit.colour_map, self.targets)


@dataclass
class _AsTheFileDoes:
    """Rounded on the host, in whatever way a kind of file has."""

    refit: ColourRefit
    targets: Targets
    options: RefitOptions
    fix_ac: Callable[[FloatArray, ColourRefit], FloatArray]
    _found: FloatArray | None = None

    def begin(self) -> None:
        pass

    def finish(self, solved: Solved) -> tuple[Refitted, float]:
        self._found = self.refit.colours()
        fixed = self.fix_ac(self._found, self.refit)
        if fixed is self._found:
            error = self.error() if math.isnan(solved.errors[1]) else solved.errors[1]
            return Refitted(fixed, (solved.errors[0], error), solved.steps), error
        again = self.refit.solve_constant(self.targets, replace(self.options, steps=_CONSTANT_STEPS), fixed)
        sh = self.refit.colours()
        sh[:, 1:] = fixed[:, 1:]  # they were rounded once more on their way through Y, Co, Cg
        return Refitted(sh, (solved.errors[0], again.errors[1]), solved.steps + again.steps), again.errors[0]

    def error(self) -> float:
        assert self._found is not None
        self.refit.coefficients.write_sh(self.refit.solver.x, self._found)
        return self.refit.solver.error(self.refit.colour_map, self.targets)


def chosen_coefficients(sh: FloatArray) -> NDArray[np.bool_]:
    """(N, M, 3) the coefficients in Y, Co, Cg that are not 0 but for roundings of R, G and B; DC always.

    Args:
        sh: (N, M, 3) R, G, B.
    """
    planar = np.empty((*sh.shape[1:], len(sh)), bool)

    def look(first: int) -> None:
        some = slice(first, first + _LOOKED_AT)
        for m in range(1, sh.shape[1]):
            for channel, values in enumerate(to_ycocg(sh[some, m].astype(np.float64))):
                np.greater(np.abs(values), _ZERO, out=planar[m, channel, some])

    with thread_pool() as pool:
        list(pool.map(look, range(0, len(sh), _LOOKED_AT)))
    planar[0] = True
    return planar.transpose(2, 0, 1)


def active_coefficients(sh: FloatArray, sf_sh: float) -> NDArray[np.bool_]:
    """(N, M, 3) the coefficients in Y, Co, Cg that the quantiser would not round to 0; DC always.

    Args:
        sh: (N, M, 3) R, G, B.
        sf_sh: the quantiser's scale factor.
    """
    active = nonzero_levels(sh, sf_sh)
    active[:, 0] = True
    return active
