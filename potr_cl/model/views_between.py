"""Views between the views: what someone would see who stood between two photographs.

Whoever looks at a scene stands where no photograph was taken, and an encoder that knows only the photographs' views
spoils what lies between them. The pictures that it compares with are renders, so more views cost nothing but time:
:func:`views_between` adds some to each given one. Each lies on the way to one of its nearest neighbours, a little off
it, and looks where the two look. Where cameras orbit something, the way is the orbit and not the chord: the distance to
what they look at is kept.

A view is only added where a camera might have been (:meth:`potr_cl.model.given_views.GivenViews.allows`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.given_views import GivenViews
from potr_cl.model.scene import Scene

F64 = NDArray[np.float64]

#: How far a view is off the way between two given ones, as a part of their distance: one standard deviation.
SPREAD = 0.3
#: Standard deviation of each of the three angles by which a view is turned, in radians.
_TURN = 0.02
#: Neighbours that a given view has.
_NEIGHBOURS = 4
#: How often a place is tried nearer to the way, if it is not allowed, and by how much.
_TRIES, _NEARER = 3, 0.4
#: Lines of sight that meet under a smaller angle (its sine) have no point in common to go around.
_PARALLEL = 0.03
#: What the names of added views begin with.
_PREFIX = "between_"


def views_between(
    scene: Scene,
    cameras: Sequence[Camera],
    each: float,
    spread: float = SPREAD,
    first: int = 0,
    known: GivenViews | None = None,
    run: Run = map,
) -> list[Camera]:
    """Views between given ones, the same ones every time.

    Args:
        scene: that they show.
        cameras: the given views, of any number; fewer than two have nothing between them.
        each: views to add to each given one; with 0.5, one to every second. Fewer are added where too few are allowed.
        spread: how far they are off the way to a neighbour, as a part of the way: one standard deviation.
        first: the number of the first round: rounds of other numbers give other views, so that
            ``each=1, first=1`` adds to those of ``each=1``.
        known: what the given views show, if that has been found already.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        Training views with the intrinsics of the given ones and no photograph, in rounds: first one for each given
        view, then the second ones.

    Raises:
        UsageError: ``each`` is negative, or ``spread`` is not a number from 0 to 10.
    """
    if not 0 <= each < math.inf or not 0 <= spread <= 10:
        raise UsageError(f"{each:g} views between with a spread of {spread:g}: at least 0, and a spread from 0 to 10")
    if each == 0 or len(cameras) < 2:
        return []
    known = known or GivenViews(scene, cameras, run)
    centres = camera_centres(cameras)
    distance = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(distance, np.inf)
    neighbours = np.argsort(distance, axis=1, kind="stable")[:, :_NEIGHBOURS]

    draws = []
    for turn, number in (wanted := _rounds(len(cameras), each, first)):
        others = neighbours[number][np.isfinite(distance[number][neighbours[number]])]
        draw = _Draw.drawn(np.random.default_rng((turn, number)), len(others))
        draws.append((cameras[number], cameras[others[draw.neighbour]], draw))
    found: list[Camera | None] = [None] * len(wanted)
    left, off = list(range(len(wanted))), spread
    _ = known.memory  # before several threads ask for it
    for _ in range(_TRIES):

        def made(place: int, off: float = off) -> tuple[Camera, int]:
            turn, number = wanted[place]
            return _between(*draws[place], off, f"{_PREFIX}{turn}_{number:04d}"), number

        # One by one, so that whoever does this beside other work lets that go on in between.
        fits = run(lambda each: each[0] if known.allows(*each) else None, map(made, left))
        for place, view in zip(left, fits, strict=True):
            found[place] = view
        left = [place for place in left if found[place] is None]
        off *= _NEARER
    return [view for view in found if view is not None]


def _rounds(count: int, each: float, first: int) -> list[tuple[int, int]]:
    """Round and given view of each view to add: all of them in each round, and in the last perhaps not all, evenly."""
    chosen = []
    for turn in range(math.ceil(each)):
        part = min(each - turn, 1.0)
        chosen += [(first + turn, n) for n in range(count) if int((n + 1) * part) > int(n * part)]
    return chosen


def is_between(camera: Camera) -> bool:
    """Whether :func:`views_between` has added it, by its name."""
    return camera.name.startswith(_PREFIX)


@dataclasses.dataclass(frozen=True)
class _Draw:
    """What is random of a view.

    Attributes:
        neighbour: the number among the neighbours.
        part: of the way to it.
        deviate: (3,) normal.
        turn: (3,) rotation vector in the camera's axes, radians.
    """

    neighbour: int
    part: float
    deviate: F64
    turn: F64

    @staticmethod
    def drawn(random: np.random.Generator, neighbours: int) -> _Draw:
        return _Draw(
            int(random.integers(neighbours)), random.random(), random.normal(size=3), random.normal(0, _TURN, 3)
        )


def _between(camera: Camera, other: Camera, draw: _Draw, spread: float, name: str) -> Camera:
    """The training view at a part of the way from one camera to another, with the intrinsics of the first."""
    start, end = camera.centre, other.centre
    way = float(np.linalg.norm(end - start))
    deviate = spread * way * draw.deviate
    focus = _focus(camera, other)
    if focus is None:
        position = start + draw.part * (end - start) + deviate
    else:
        radius, far = (float(np.linalg.norm(x - focus)) for x in (start, end))
        direction = _slerp((start - focus) / radius, (end - focus) / far, draw.part)
        position = focus + math.exp((1 - draw.part) * math.log(radius) + draw.part * math.log(far)) * direction
        # Off the way along the orbit, and across it only as far as the cameras themselves leave it.
        outwards = float(deviate @ direction)
        kept = float(np.linalg.norm(position - focus))
        position = position + deviate - outwards * direction
        across = outwards * abs(far - radius) / max(way, 1e-300)
        position = focus + (position - focus) * max(kept + across, 0.1 * kept) / np.linalg.norm(position - focus)
    rotation = _rotation(draw.turn) @ _rotation(draw.part * _rotation_vector(other.rotation @ camera.rotation.T))
    rotation = rotation @ camera.rotation
    return dataclasses.replace(
        camera, name=name, split="train", image_path=None, rotation=rotation, translation=-rotation @ position
    )


def _focus(camera: Camera, other: Camera) -> F64 | None:
    """The point that two lines of sight come nearest to; None if they are parallel or it is not before both cameras."""
    start, end = camera.centre, other.centre
    a, b = camera.rotation[2], other.rotation[2]
    cosine = float(a @ b)
    squared_sine = 1 - cosine * cosine
    if squared_sine < _PARALLEL**2:
        return None
    gap = end - start
    along = float((a - cosine * b) @ gap) / squared_sine
    back = float((cosine * a - b) @ gap) / squared_sine
    way = float(np.linalg.norm(gap))
    if min(along, back) < 0.5 * way:
        return None
    focus: F64 = 0.5 * (start + along * a + end + back * b)
    return focus if min(np.linalg.norm(focus - start), np.linalg.norm(focus - end)) > 0.5 * way else None


def _slerp(start: F64, end: F64, part: float) -> F64:
    """The unit vector at a part of the arc between two."""
    angle = math.acos(min(max(float(start @ end), -1.0), 1.0))
    if angle < 1e-6 or math.pi - angle < 1e-6:
        mixed = (1 - part) * start + part * end
        length = np.linalg.norm(mixed)
        return mixed / length if length > 1e-9 else start
    arc: F64 = (math.sin((1 - part) * angle) * start + math.sin(part * angle) * end) / math.sin(angle)
    return arc


def _rotation(vector: F64) -> F64:
    """(3, 3) the rotation by a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: F64 = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned


def _rotation_vector(rotation: F64) -> F64:
    """(3,) the rotation vector of a rotation, of length 0 to π."""
    # By the unit quaternion: the eigenvector of its largest eigenvalue (Bar-Itzhack 2000), sound up to half a turn.
    (a, b, c), (d, e, f), (g, h, i) = rotation
    symmetric = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    quaternion = np.linalg.eigh(symmetric / 3)[1][:, 3]
    if quaternion[3] < 0:
        quaternion = -quaternion
    sine = float(np.linalg.norm(quaternion[:3]))
    if sine < 1e-12:
        return np.zeros(3)
    vector: F64 = 2 * math.atan2(sine, float(quaternion[3])) * quaternion[:3] / sine
    return vector
