"""Views to choose from: all around and inside a scene, free of matter, from where its colours were trained."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.placement.colour_memory import remembered
from potr_cl.model.placement.matter import CROWDED, Frame, Matter, cell_of, surroundings
from potr_cl.model.placement.sampling import F64, low_discrepancy, on_sphere

F32 = NDArray[np.float32]

#: Directions from which seeing a splat counts as new.
BINS = 32
#: Places to stand that are tried, and views at each.
_PLACES = 800
_AIMS = 6
#: Distances of the places from the centre, in units of the scene's median radius.
_NEAREST, _FARTHEST = 0.2, 4.0
#: The SH energy towards a view, as a part of the same splats' highest: below the first it was never trained, above the
#: second it was.
_UNTRAINED, _TRAINED = 0.65, 0.85
#: Part of all directions that is blocked where a place counts as enclosed.
_ENCLOSED = 0.8

_BIN_DIRECTIONS = on_sphere(low_discrepancy(BINS, 2)).astype(np.float32)


@dataclass(frozen=True)
class Candidates:
    """Views to choose from, in the frame's units.

    Attributes:
        camera centres: (C, 3) positions.
        forward: (C, 3) unit vectors.
        tangent: (C,) tan of half the field of view.
        worth: (C, K) what the view shows of each target, 0 to 1.
        bins: (C, K) from which of the directions.
        enclosed: (C,) whether there is matter nearly all around.
        trained: whether the colours tell how plausible each view is; ``worth`` then holds it already.
    """

    centres: F64
    forward: F64
    tangent: F64
    worth: F32
    bins: NDArray[np.uint8]
    enclosed: NDArray[np.bool_]
    trained: bool


def candidates_of(frame: Frame, matter: Matter, half_view: float, run: Run = map) -> Candidates:
    """All views from all places that are free; from the freest tenth if too few are.

    Args:
        frame, matter: of the scene.
        half_view: tan of half the field of view, both ways.
        run: in place of :func:`map`, to work with several threads.
    """
    places, tangents = places_to_try(frame, half_view)
    horizons, blocked = zip(*run(lambda place: surroundings(place, matter), places), strict=True)
    crowd = np.array(blocked)
    free = np.flatnonzero(crowd <= max(CROWDED, float(np.quantile(crowd, 0.1))))

    def look(place: int) -> tuple[F64, F32, NDArray[np.uint8]]:
        return views_from(places[place], tangents[place], tangents[place] / half_view, horizons[place], frame, matter)

    views = list(run(look, free))
    worths = [worth for _, worth, _ in views]
    memory = remembered(places[free], [np.maximum.reduce(worth) for worth in worths], matter, run)
    if memory is not None:
        plausible = np.clip((memory - _UNTRAINED) / (_TRAINED - _UNTRAINED), 0, 1)
        worths = [worth * part for worth, part in zip(worths, plausible.astype(np.float32), strict=True)]
    each = [len(aims) for aims, _, _ in views]
    return Candidates(
        centres=np.repeat(places[free], each, axis=0),
        forward=np.concatenate([aims for aims, _, _ in views]),
        tangent=np.repeat(tangents[free], each),
        worth=np.concatenate(worths),
        bins=np.repeat([bins for _, _, bins in views], each, axis=0),
        enclosed=np.repeat([np.mean(np.isfinite(horizons[place])) > _ENCLOSED for place in free], each),
        trained=memory is not None,
    )


def places_to_try(frame: Frame, half_view: float) -> tuple[F64, F64]:
    """Positions to try, and the tangent of half the field of view there.

    Evenly in direction and in the logarithm of the distance. Where the near plane would cut off a small scene, the
    camera steps back and looks through a longer lens.
    """
    spread = low_discrepancy(_PLACES, 3)
    distance = _NEAREST * (_FARTHEST / _NEAREST) ** spread[:, 2]
    away = np.maximum(distance, frame.near + 1.5) if frame.near > 0.5 else distance
    return on_sphere(spread[:, :2]) * away[:, None], half_view * distance / away


def views_from(
    camera_centre: F64, tangent: float, zoom: float, horizon: F32, frame: Frame, matter: Matter
) -> tuple[F64, F32, NDArray[np.uint8]]:
    """Some directions to look in from one place, what each view shows of every target, and from which direction bin.

    Args:
        camera_centre: (3,) the place.
        tangent: of half the field of view.
        zoom: the tangent as a part of what it is where no lens had to be longer.
        horizon: of the place, as :func:`potr_cl.model.placement.matter.surroundings` gives it.
        frame, matter: of the scene.
    """
    rays = matter.targets - camera_centre
    distance = np.linalg.norm(rays, axis=1)
    towards = rays / np.maximum(distance, 1e-300)[:, None]
    # A cell is wide: what is a little behind its nearest point may be the same surface.
    visible = (distance <= 1.1 * horizon[cell_of(rays.T.astype(np.float32))] + 0.02) & (distance > frame.near)
    shown = np.where(visible, np.minimum(1, (matter.reach / np.maximum(distance * zoom, 1e-12)) ** 2), 0)
    seen = np.flatnonzero(visible)
    if len(seen) == 0:
        aims = -camera_centre[None] / max(float(np.linalg.norm(camera_centre)), 1e-300)
    else:
        some = seen[((np.arange(_AIMS - 1) + 0.5) / (_AIMS - 1) * len(seen)).astype(np.int64)]
        middle = shown @ towards
        length = np.linalg.norm(middle)
        aims = np.concatenate([middle[None] / length if length > 1e-6 else towards[seen[:1]], towards[some]])
    ahead = towards @ aims.T
    # In the image's inscribed circle; a little beyond it, in the corners, counts no less than it costs.
    inside = ahead >= 1 / math.hypot(1, tangent)
    worth = np.where(inside, shown[:, None], 0).T.astype(np.float32)
    # Without BLAS, whose threads would wait for each other where several threads ask.
    bins = np.einsum("kj,bj->kb", towards.astype(np.float32), _BIN_DIRECTIONS).argmax(axis=1).astype(np.uint8)
    return aims, worth, bins
