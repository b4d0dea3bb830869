"""What a file does to a fitted scene, done step by step, and what is left fitted once more in between: :func:`settle`.

A file gives up most AC coefficients and rounds all the rest. Done at once, that costs as much again as removed splats
do. Here it comes one kind after the other, and what may still move makes up for it:

1. AC coefficients are chosen as the re-fit of the colours does; all but them moves on.
2. All but them goes on moving, but what the pictures show is scales, rotations and opacities as the file rounds them:
   what lies behind a level moves until another level suits the other splats' better.
3. Centres are rounded; the others move on in this way.

The re-fit then solves for the colours, on just this geometry; it may give up more coefficients, but takes none back.
Held-out views watch over every fit: one that does not help them is not taken.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TypeAlias

from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantisers import QUANTISERS, Balanced
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.stages.fitting.adam import UNROUNDED, Factors, Rates, in_form_of_files
from potr_cl.stages.fitting.fit import FitOptions, Following, Sight, SupportsBool, fit_scene
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.targets import Targets

#: Steps of the solution that coefficients are chosen by; the last solution, of the re-fit, takes more.
_CHOICE_STEPS = 4
#: A scene's pictures in some views.
PicturesOf: TypeAlias = Callable[[Sequence[Camera]], AbstractContextManager[Targets]]


@dataclass(frozen=True)
class Settling:
    """How far what is left is fitted once more.

    Attributes:
        choosing, rounding: steps after coefficients have been chosen, and in each of the two fits that look at what is
            rounded, as parts of those of the fit. 0: that is left to the re-fit and the coder.
        gentle, through: part of the fit's first rates that the fit after the choice begins with, and those that look at
            what is rounded.
        last: part of the first rates of each fit that is left at its end.
    """

    choosing: float
    rounding: float
    gentle: float = 0.1
    through: float = 0.3
    last: float = 0.1


def settle(
    state: State,
    bench: Workbench,
    sight: Sight,
    pictures: PicturesOf,
    settling: Settling,
    options: FitOptions,
    asked: SupportsBool = False,
    progress: Callable[[int], None] = lambda steps: None,
) -> tuple[State, tuple[float, ...]]:
    """Choose coefficients and round geometry, with fits in between.

    Args:
        state: that was fitted; its views are those that the file is made for.
        pictures: of the scene that the targets show, in other views.
        asked: whether to end early: nothing more is fitted then.
        progress: called with the number of steps that a fit has taken.

    Returns:
        The state: its ``scene`` is not rounded yet, so that other steps can be tried with it. Its ``geometry`` is, for
        the steps of now, if the output is a .potr file in one block of version 2 or later: what others hold is not
        known here. What is learnt are the parameters that coefficients were chosen with. And the mean squared
        error of the held-out views after each fit.
    """
    errors: list[float] = []

    def fitted(scene: Scene, part: float, start: float, still: Sequence[str], factors: Factors = UNROUNDED) -> Scene:
        steps = max(round(part * options.steps), 1)
        rates: Rates = dataclasses.replace(options.rates, **dict.fromkeys(still, 0.0))
        more = dataclasses.replace(
            options, steps=steps, rounds=3, rates=rates, start=start, last=settling.last, patience=3
        )
        found = fit_scene(bench.opened, scene, sight, more, Following(tell=bench.tell, asked=asked), factors)
        errors.append(found.error)
        progress(steps)
        return found.scene

    still = ("ac",)
    if settling.choosing and bench.parameters.drop and not state.results.compacted:
        scene = fitted(_with_chosen(state, bench, sight, pictures), settling.choosing, settling.gentle, still)
        state = dataclasses.replace(state, scene=scene, geometry=None).with_results(chosen=bench.parameters)
    rounded = bench.output.geometry(state.scene, bench.request(state)) if settling.rounding else None
    if not isinstance(rounded, Geometry) or not isinstance(QUANTISERS[rounded.parameters.quantiser], Balanced):
        return state, tuple(errors)
    world = rounded.parameters
    factors = Factors(world.sf_scale, world.sf_rotation, world.sf_opacity)
    scene = fitted(in_form_of_files(state.scene), settling.rounding, settling.through, still, factors)
    with thread_pool(bench.threads) as pool:
        rounded = rounded.with_centres_of(scene.means, state.views, pool.map)
    scene = dataclasses.replace(scene, means=rounded.decoded(scene.sh).means)
    scene = fitted(scene, settling.rounding, settling.through, (*still, "means"), factors)
    then = dataclasses.replace(state.recoloured(scene.sh), geometry=rounded.with_shapes_of(scene))
    return then, tuple(errors)


def _with_chosen(state: State, bench: Workbench, sight: Sight, pictures: PicturesOf) -> Scene:
    """The scene with the AC coefficients that are worth their bytes, solved for without a look at held-out views."""
    # Given ones come first in both.
    views = [view for number, view in enumerate(state.views) if number not in sight.held_out]
    options = RefitOptions(steps=_CHOICE_STEPS, drop=bench.parameters.drop, memory=bench.memory)
    with pictures(views) as targets:
        refitted = refit_colours(bench.opened, state.scene, views, targets, options, background=bench.background)
    return dataclasses.replace(state.scene, sh=refitted.sh)
