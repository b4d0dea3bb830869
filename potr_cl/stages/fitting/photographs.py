"""What is left of a scene comes nearer to photographs: :func:`fit_to_photographs`.

A scene is trained with a loss that is not the squared error, and with long steps, one photograph at a time: a calmer
fit brings it nearer to photographs, also to those that it has never seen.

Whether it does is what some say that are held out in a trial. Mostly the scene has been trained with these too, and
what it remembers of them it loses while it is fitted to others. So the trial is a short one of little steps, in which
little is lost. If it matches them better, the scene is fitted to all photographs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import FitOptions, FitProgress, SupportsBool, fit_scene, kept_pictures
from potr_cl.stages.fitting.fitted import FittedToPhotographs
from potr_cl.stages.held_out import hold_out
from potr_cl.views.targets import Photographs, PhotographTargets

#: The trial: its steps, the parts after which held-out photographs are looked at, and its rates as parts of the fit's.
_TRIAL_STEPS, _TRIAL_LOOKS, _TRIAL_RATES = 40, 4, 0.1
#: Whole rounds of the fit, of which someone who ends it early keeps the last.
_ROUNDS = 5
#: Centres and rotations take longer steps than in a fit to a scene's own pictures, to which they come near in one go.
_LONGER = 2.0


def fit_to_photographs(
    device: Device,
    scene: Scene,
    views: Sequence[Camera],
    photographs: Photographs,
    options: FitOptions,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tell: Callable[[str], None] | None = None,
    asked: SupportsBool = False,
    progress: FitProgress | None = None,
) -> FittedToPhotographs:
    """Fit all parameters of a scene to photographs, if some that are held out agree.

    Args:
        device: to compute on.
        scene: where the fit begins.
        views: that have photographs.
        photographs: of these.
        options: of the fit; their rounds and patience mean nothing here.
        background: R, G, B behind the scene.
        tell: called with a line for each look at photographs.
        asked: whether to end before the next step.
        progress: called after each step of the fit.

    Raises:
        UsageError: there are fewer than two photographs, or one cannot be opened.
        DataError: a photograph is damaged.
        DeviceError: the scene does not fit the device.
    """
    fit_to, judging = hold_out(views)
    cameras = [*fit_to, *judging]
    every, judges = range(len(cameras)), range(len(fit_to), len(cameras))
    # Photographs that it looks at are no judges: these only see to it that nothing goes wrong.
    some = range(0, len(cameras), max(len(cameras) // len(judging), 1))
    trial_options = dataclasses.replace(
        options, steps=_TRIAL_STEPS, rounds=_TRIAL_LOOKS, patience=_TRIAL_LOOKS, last=1.0,
        rates=times(options.rates, _TRIAL_RATES),
    )  # fmt: skip
    with kept_pictures(device, cameras, PhotographTargets(device, photographs, cameras), options.memory) as pictures:
        trial = fit_scene(
            device,
            scene,
            cameras,
            pictures,
            trial_options,
            0,
            background,
            None,
            tell,
            asked,
            judges,
            range(len(fit_to)),
        )
        if asked or not trial.kept:
            return FittedToPhotographs(None, len(cameras), 0, len(judges), trial.errors, (), bool(asked))
        options = dataclasses.replace(options, rounds=_ROUNDS, patience=_ROUNDS)
        found = fit_scene(device, scene, cameras, pictures, options, 0, background, progress, tell, asked, some, every)
    return FittedToPhotographs(
        found.scene if found.kept else None, len(cameras), found.kept, len(judges), trial.errors, found.errors,
        found.ended_early,
    )  # fmt: skip


def longer(rates: Rates) -> Rates:
    """The rates for photographs, where these are those for pictures of a scene."""
    return dataclasses.replace(rates, means=_LONGER * rates.means, quaternions=_LONGER * rates.quaternions)


def times(rates: Rates, factor: float) -> Rates:
    """All rates multiplied."""
    return Rates(**{each.name: factor * getattr(rates, each.name) for each in dataclasses.fields(Rates)})
