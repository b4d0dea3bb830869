"""What is known of virtual cameras, which stand in for those that a scene comes without: how many (:func:`plan`), and
that they are virtual (:func:`is_virtual`). :mod:`potr_cl.placement` places them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera, camera_centres, focus
from potr_cl.model.views_between import is_between

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

#: Training views that are placed unless told otherwise, and pixels along a side of each, on a GPU and on a CPU: so many
#: up to so many splats, and more with the root of the splats. Colours want many directions, so the views are many; and
#: each room wants views of its own.
_VIEWS, _VIEWS_ON_CPU, _IN_ROOMS_ON_CPU, MOST = 240, 150, 200, 1600
_SIZE, _SIZE_ON_CPU, _SPLATS = 600, 480, 300_000
#: An eighth as many judge as would in rooms, but no more than so many.
_MOST_TESTS = 32
#: Degrees from side to side, as photographs have.
FIELD = 50.0
#: What may be asked for: no more views than places are tried, no wider ones than are rendered.
MOST_ASKED, WIDEST_ASKED = 4000, 16384
#: What the names of virtual cameras begin with.
PREFIX = "virtual_"

#: Splats by which the distance of the scene is measured.
_SOME = 3000
#: How far the standpoints around a virtual view are from it, as a part of its distance from the scene.
_AROUND = 0.35


@dataclass(frozen=True)
class Plan:
    """What :func:`potr_cl.placement.virtual.place_cameras` sets out from.

    Attributes:
        training: views that an encoder looks at.
        in_rooms: the same where a good part of the places to stand is enclosed.
        test: views besides that only judge.
        size: width and height of each, in pixels.
    """

    training: int
    in_rooms: int
    test: int
    size: int

    def sharper(self, times: float) -> Plan:
        """Pictures so many times as wide, but no wider than on a GPU, and fewer in proportion."""
        size = max(min(round(self.size * times), _SIZE), self.size)
        training, in_rooms = (round(each * self.size / size) for each in (self.training, self.in_rooms))
        return Plan(training, in_rooms, self.test, size)


def plan(splats: int, count: int | None = None, size: int | None = None, slow: bool = False) -> Plan:
    """How many views, and how large.

    Args:
        splats: of the scene.
        count, size: as :func:`potr_cl.placement.virtual.place_cameras` takes them.
        slow: whether a CPU has to look at them.

    Raises:
        UsageError: ``count`` or ``size`` below 1, or above what can be placed and rendered.
    """
    if count is not None:
        in_rooms = count
    else:
        more = math.sqrt(max(splats / _SPLATS, 1.0))
        usual = (_VIEWS_ON_CPU, _IN_ROOMS_ON_CPU) if slow else (_VIEWS, _VIEWS)
        count, in_rooms = (min(round(each * more), MOST) for each in usual)
    if size is None:
        size = _SIZE_ON_CPU if slow else _SIZE
    if not (1 <= count <= MOST_ASKED and 1 <= size <= WIDEST_ASKED):
        raise UsageError(
            f"{count} virtual views of {size} x {size} pixels: both must be at least 1, the views at most "
            f"{MOST_ASKED}, a side at most {WIDEST_ASKED}"
        )
    return Plan(count, in_rooms, min(in_rooms // 8, _MOST_TESTS), size)


def is_virtual(cameras: Sequence[Camera]) -> bool:
    """Whether :func:`potr_cl.placement.virtual.place_cameras` placed them, by their names; or all that is between."""
    if not cameras or not cameras[0].name.startswith(PREFIX):
        return False
    return all(camera.name.startswith(PREFIX) or is_between(camera) for camera in cameras)


def standpoints(cameras: Sequence[Camera], means: F32) -> F64:
    """Where to look from when colours are fitted: what the compaction takes as camera centres.

    Someone will look from between virtual views, where a fit to them alone runs wild. So each shares its weight with
    four places around it.

    Args:
        means: (N, 3) centres of the scene.

    Returns:
        (S, 3) the camera centres of given cameras, (S, 4, 3) the places around those of virtual ones.
    """
    centres = camera_centres(cameras)
    if not is_virtual(cameras):
        return centres
    some = means[:: max(len(means) // _SOME, 1)].astype(np.float64)
    away = np.array([np.median(np.linalg.norm(some - camera_centre, axis=1)) for camera_centre in centres])
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
    return centres[:, None] + _AROUND * away[:, None, None] * corners


def describe(cameras: Sequence[Camera]) -> str:
    """How many views, and where, in words."""
    centres = camera_centres(cameras)
    middle = focus(cameras)
    distance = np.linalg.norm(centres - middle, axis=1)
    at = ", ".join(f"{x:.3g}" for x in middle)
    train, test = (sum(c.split == split for c in cameras) for split in ("train", "test"))
    judges = f" and {test} to judge by" if test else ""
    return f"{train} virtual views{judges}, {distance.min():.3g} to {distance.max():.3g} units from ({at})"
