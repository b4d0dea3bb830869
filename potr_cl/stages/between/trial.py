"""How many views between the training views does a scene need? A trial with some of them held out.

Some training views that stand close together are made small, a few of them are held out, and splats are removed by what
the rest shows, without and with views between them: each time down to the number that is left without. Since the number
is the same, whatever the held-out views lose less with added views is won at equal size. It is enough if they lose no
more than the views that were looked at; and where more views no longer help, fewer do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres, resized
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.views_between import views_between
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import State, Workbench

#: Views that are added for each training view in the rounds of a trial, one round after the other.
ROUNDS = (1, 2)
#: The trial looks at so many views that stand close together: as close to their neighbours as all of them. Among the
#: inner half of them every so many-th is held out. With fewer views than the least there is nothing to learn from that.
_VIEWS, _EVERY, _LEAST = 32, 4, 6
#: Width and height of the trial's views, at most; iterations and steps.
_SIDE = 256
_ITERATIONS, _STEPS = 6, 2
#: A round has to bring so many decibels on the held-out views; below so many between them and the others the gap is
#: closed.
_GAIN, _CLOSED = 0.15, 0.3
#: A gap of so many decibels is closed by added views without their being tried first, where trying is dear.
_CLEAR = 1.0


@dataclass(frozen=True)
class Trial:
    """What a trial found.

    Attributes:
        each: views to add for each training view.
        held: PSNR of the held-out views of each round, the first without added views, in decibels.
        looked_at: of as many of the others.
    """

    each: int
    held: tuple[float, ...] = ()
    looked_at: tuple[float, ...] = ()


def try_views(state: State, bench: Workbench, spread: float, most: int, brief: bool) -> Trial:
    """How many views to add.

    Args:
        state: before anything was removed.
        bench: of the stage that asks.
        spread: of the views, as :func:`potr_cl.model.views_between.views_between` takes it.
        most: the most that may be added for each view.
        brief: do not try what added views bring: let the gap without them decide.

    Raises:
        DeviceError: the device fails, or has too little memory.
    """
    rounds = sorted({min(each, most) for each in ROUNDS} - {0})
    if len(state.views) < _LEAST or not rounds:
        return Trial(0)
    near = [_small(state.views[number]) for number in _cluster(camera_centres(state.views))]
    held = near[1 : max(len(near) // 2, 2) : _EVERY]
    rest = [view for view in near if not any(view is other for other in held)]
    judges = [*held, *rest[: len(near) // 2 : 2]]
    quiet = dataclasses.replace(bench, interludes=(), progress=lambda what, done: None)
    wanted = _pictures(state.source, judges, bench)
    of_held: list[float] = []
    of_rest: list[float] = []
    best, count = 0, None
    for number, each in enumerate([0, *rounds]):
        bench.progress("views between", number / (len(rounds) + 1))
        looked_at = (*rest, *views_between(state.source, rest, each, spread))
        reduced = _reduced(dataclasses.replace(state, views=looked_at), quiet, count)
        count = len(reduced)
        got = _pictures(reduced, judges, bench)
        errors = [psnr(a, b) for a, b in zip(wanted, got, strict=True)]
        of_held.append(float(np.mean(errors[: len(held)])))
        of_rest.append(float(np.mean(errors[len(held) :])))
        if brief:
            gap = of_rest[0] - of_held[0]
            return Trial(rounds[0] if gap > _CLEAR else 0, tuple(of_held), tuple(of_rest))
        if number and of_held[-1] < of_held[-2] + _GAIN:
            break
        best = each
        if of_rest[-1] < of_held[-1] + _CLOSED:
            break
    return Trial(best, tuple(of_held), tuple(of_rest))


def _cluster(centres: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of some cameras around the one that the others are nearest to, by their distance from it."""
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    middle = int(np.median(distance, axis=1).argmin())
    return np.argsort(distance[middle], kind="stable")[:_VIEWS]


def _reduced(state: State, bench: Workbench, count: int | None) -> Scene:
    """So many splats, or as many as q leaves, with their colours re-fitted, as a quick encode would leave them."""
    pruned = Prune(count=count, iterations=_ITERATIONS).run(state, bench)
    return Refit(steps=_STEPS).run(pruned, bench).scene


def _pictures(scene: Scene, views: Sequence[Camera], bench: Workbench) -> list[FloatArray]:
    with Rasterizer(bench.opened, scene, background=bench.background) as rasterizer:
        return [np.clip(rasterizer.render(view)[0], 0, 1) for view in views]


def _small(camera: Camera) -> Camera:
    """The same view with at most so many pixels a side, whole ones."""
    factor = min(_SIDE / max(camera.width, camera.height), 1.0)
    width, height = max(round(camera.width * factor), 1), max(round(camera.height * factor), 1)
    return resized(camera, width, height)
