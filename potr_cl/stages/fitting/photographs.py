"""What is left of a scene comes nearer to photographs: :func:`fit_to_photographs`.

A scene is trained with a loss that is not the squared error, and with long steps, one photograph at a time: a calmer
fit brings it nearer to photographs, also to those that it has never seen.

Whether it does is what some say that are held out in a trial. Mostly the scene has been trained with these too, and
what it remembers of them it loses while it is fitted to others. So the trial is a short one of little steps, in which
little is lost. If it matches them better, the scene is fitted to all photographs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.stages.fitting.adam import Rates
from potr_cl.stages.fitting.fit import FitOptions, Following, Sight, fit_scene
from potr_cl.stages.fitting.fitted import FittedToPhotographs
from potr_cl.stages.fitting.together import kept_pictures
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
    background: tuple[float, float, float],
    following: Following,
) -> FittedToPhotographs:
    """Fit all parameters of a scene to photographs, if some that are held out agree.

    Args:
        scene: where the fit begins.
        views: that have photographs.
        photographs: of these.
        options: of the fit; their rounds and patience mean nothing here.
        following: of the fit, not of the trial before it.

    Raises:
        UsageError: there are fewer than two photographs, or one cannot be opened.
        DataError: a photograph is damaged.
        DeviceError: the scene does not fit the device.
    """
    fit_to, judging = hold_out(views)
    cameras, asked = [*fit_to, *judging], following.asked
    trial_options = dataclasses.replace(
        options, steps=_TRIAL_STEPS, rounds=_TRIAL_LOOKS, patience=_TRIAL_LOOKS, last=1.0,
        rates=times(options.rates, _TRIAL_RATES),
    )  # fmt: skip
    with kept_pictures(device, cameras, PhotographTargets(device, photographs, cameras), options.memory) as pictures:
        sight = Sight(cameras, pictures, background=background, judges=range(len(fit_to), len(cameras)))
        trial = fit_scene(device, scene, sight, trial_options, Following(tell=following.tell, asked=asked))
        if asked or not trial.kept:
            return FittedToPhotographs(None, len(cameras), 0, len(judging), trial.errors, (), bool(asked))
        # Photographs that it looks at are no judges: these only see to it that nothing goes wrong.
        some, every = range(0, len(cameras), max(len(cameras) // len(judging), 1)), range(len(cameras))
        options = dataclasses.replace(options, rounds=_ROUNDS, patience=_ROUNDS)
        found = fit_scene(device, scene, dataclasses.replace(sight, judges=some, fit_to=every), options, following)
    return FittedToPhotographs(
        found.scene if found.kept else None, len(cameras), found.kept, len(judging), trial.errors, found.errors,
        found.ended_early,
    )  # fmt: skip


def longer(rates: Rates) -> Rates:
    """The rates for photographs, where these are those for pictures of a scene."""
    return dataclasses.replace(rates, means=_LONGER * rates.means, quaternions=_LONGER * rates.quaternions)


def times(rates: Rates, factor: float) -> Rates:
    """All rates multiplied."""
    return Rates(**{each.name: factor * getattr(rates, each.name) for each in dataclasses.fields(Rates)})
