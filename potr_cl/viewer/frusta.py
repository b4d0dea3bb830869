"""The cameras of a scene as frusta in the picture (:func:`add_frusta`): a click flies there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.report.style import TEST_VIEW, TRAINING_VIEW, rgb

#: More would only hide the scene: of more, as many are drawn, evenly spread.
MOST_FRUSTA = 400


def add_frusta(scene: Any, cameras: Sequence[Camera], click: Callable[[int], None]) -> dict[int, Any]:
    """Draw the cameras.

    Args:
        scene: viser's, of one tab.
        cameras: to draw; training views in one colour, test views in another.
        click: called with the number of a camera that was clicked.

    Returns:
        viser's handles of the frusta, by the numbers of the cameras.
    """
    from viser import transforms

    size = _size(cameras)
    handles = {}
    step = max(len(cameras) / MOST_FRUSTA, 1.0)
    for number in (int(place * step) for place in range(min(len(cameras), MOST_FRUSTA))):
        camera = cameras[number]
        colour = rgb(TEST_VIEW if camera.split == "test" else TRAINING_VIEW)
        # The names of views were chosen by whoever wrote the cameras; those of nodes are ours.
        handle = scene.add_camera_frustum(
            f"/views/{number}",
            fov=2 * math.atan(camera.height / 2 / camera.fy),
            aspect=camera.width / camera.fx * camera.fy / camera.height,
            scale=size,
            thickness=1.5,
            thickness_units="screen",
            color=colour,
            wxyz=transforms.SO3.from_matrix(camera.rotation.T).wxyz,
            position=camera.centre,
            cast_shadow=False,
            receive_shadow=False,
        )
        # A line is hard to hit: the tip has a ball.
        ball = scene.add_icosphere(
            f"/views/{number}/tip",
            radius=size / 5,
            color=colour,
            subdivisions=1,
            cast_shadow=False,
            receive_shadow=False,
        )
        for each in (handle, ball):
            each.on_click(lambda _, number=number: click(number))
        handles[number] = handle
    return handles


def _size(cameras: Sequence[Camera]) -> float:
    """In world units: a fifth of what usually lies between a camera and its nearest neighbour."""
    centres = camera_centres(cameras)[:: max(len(cameras) // 300, 1)]
    if len(centres) < 2:
        return 0.1
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    across = float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0)))
    return max(min(nearest / 5, across / 25), across / 150, 1e-6)
