"""Virtual cameras for scenes that come with none: where would someone stand who looks at this? Pure numpy.

A trained scene remembers how it was looked at. Splats are where the photographs had detail, empty space is where the
photographer stood, and the SH coefficients of a splat are a sum of basis functions in the directions of the views that
trained it, so its colour varies most in those directions and hardly in others. :func:`place_cameras` draws candidates
all around and inside the scene, rejects those that stand in dense matter or from where the colours were never trained,
and picks, one after the other, the view that adds most: splats seen from directions from which they were not seen yet.

Visibility is that of points in a coarse cube map, not a rendering: no device is needed, and the same scene gives the
same cameras everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.placement.candidates import candidates_of
from potr_cl.model.placement.choice import pick
from potr_cl.model.placement.matter import frame_of, matter_of
from potr_cl.model.placement.sampling import F64
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import is_between

F32 = NDArray[np.float32]

#: Training views that are placed unless told otherwise. Each costs time and memory for every splat, hardly less if it
#: is small: so they are few and wide, and large scenes get fewer.
FEWEST, MOST = 86, 128
_SPLATS_TIMES_VIEWS = 67_000_000
#: Pixels of all of them together, and along a side of each.
_PIXELS = 46_080_000
_SMALLEST, _LARGEST = 500, 740
#: Degrees from side to side. A wide view shows a splat together with more of the others, so that fewer views show each
#: splat from as many directions.
FIELD = 65.0
#: What may be asked for: no more views than places are tried, no wider ones than are rendered.
_MOST_ASKED, _WIDEST_ASKED = 4000, 16384
#: What the names of virtual cameras begin with.
_PREFIX = "virtual_"

#: More threads than these wait for each other: NumPy's calls are short here, and each needs the interpreter in between.
_THREADS = 4

#: Splats by which the distance of the scene is measured.
_SOME = 3000
#: How far the standpoints around a virtual view are from it, as a part of its distance from the scene.
_AROUND = 0.35


def place_cameras(
    scene: Scene, count: int | None = None, size: int | None = None, field: float = FIELD
) -> list[Camera]:
    """Views that cover what someone would look at.

    Args:
        scene: clean, at least one splat.
        count: training views; by default 86 to 128, the fewer the more splats there are. An eighth as many test views,
            which lie among them, come on top.
        size: of their square images, in pixels; by default 600 to 740, the smaller the more views there are.
        field: of view from side to side, in degrees; less where the renderer's near plane would cut a small scene off.

    Returns:
        Cameras "virtual_000" and so on, in the order in which they were picked.

    Raises:
        UsageError: ``count`` or ``size`` below 1, or above what can be placed and rendered.
    """
    planned = plan(len(scene), count, size)
    with thread_pool(_THREADS) as pool:
        frame = frame_of(scene, pool.map)
        matter = matter_of(scene, frame)
        candidates = candidates_of(frame, matter, math.tan(math.radians(field / 2)), pool.map)
    tests, views = planned.test, planned.training + planned.test
    picked = pick(candidates, views)
    every = views // tests if tests else 0
    cameras = []
    for number, view in enumerate(picked):
        split = "test" if every and number % every == every - 1 and number // every < tests else "train"
        camera_centre = frame.centre + frame.unit * candidates.centres[view]
        cameras.append(
            _camera(
                f"{_PREFIX}{number:03d}",
                camera_centre,
                candidates.forward[view],
                frame.up,
                candidates.tangent[view],
                planned.size,
                split,
            )
        )
    return cameras


@dataclass(frozen=True)
class Plan:
    """What :func:`place_cameras` will place: known before anything is computed.

    Attributes:
        training: views that an encoder looks at.
        test: views besides that only judge.
        size: width and height of each, in pixels.
    """

    training: int
    test: int
    size: int

    @property
    def pixels(self) -> int:
        """Of all training views together: what time and memory of an encode grow with."""
        return self.training * self.size**2

    def __str__(self) -> str:
        return f"{self.training} views of {self.size} x {self.size} pixels"


def plan(splats: int, count: int | None = None, size: int | None = None) -> Plan:
    """How many views, and how large.

    Args:
        splats: of the scene.
        count, size: as :func:`place_cameras` takes them.

    Raises:
        UsageError: ``count`` or ``size`` below 1, or above what can be placed and rendered.
    """
    if count is None:
        count = min(max(_SPLATS_TIMES_VIEWS // max(splats, 1), FEWEST), MOST)
    if size is None:
        size = min(max(round(math.sqrt(_PIXELS / max(count, 1))), _SMALLEST), _LARGEST)
    if not (1 <= count <= _MOST_ASKED and 1 <= size <= _WIDEST_ASKED):
        raise UsageError(
            f"{count} virtual views of {size} x {size} pixels: both must be at least 1, the views at most "
            f"{_MOST_ASKED}, a side at most {_WIDEST_ASKED}"
        )
    return Plan(count, count // 8, size)


def is_virtual(cameras: Sequence[Camera]) -> bool:
    """Whether they were placed by :func:`place_cameras`, or between such ones, by their names."""
    if not cameras or not cameras[0].name.startswith(_PREFIX):
        return False
    return all(camera.name.startswith(_PREFIX) or is_between(camera) for camera in cameras)


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
    across = np.eye(3) - np.stack([np.outer(c.rotation[2], c.rotation[2]) for c in cameras])
    # The point that their lines of sight come nearest to.
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=1e-9)[0]
    distance = np.linalg.norm(centres - focus, axis=1)
    at = ", ".join(f"{x:.3g}" for x in focus)
    train, test = (sum(c.split == split for c in cameras) for split in ("train", "test"))
    judges = f" and {test} to judge by" if test else ""
    return f"{train} virtual views{judges} placed {distance.min():.3g} to {distance.max():.3g} units from ({at})"


def _camera(name: str, camera_centre: F64, forward: F64, up: F64, tangent: float, size: int, split: str) -> Camera:
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:  # looks straight up or down: any roll will do
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = size / 2 / tangent
    return Camera(name, size, size, focal, focal, size / 2, size / 2, rotation, -rotation @ camera_centre, split)
