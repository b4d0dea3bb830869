"""A browser's camera flies to a view (:func:`fly`), and the photograph of the view fades over the picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from potr_cl.viewer.pose import F64, Gaze

#: Seconds of a flight, and of the photograph's coming, staying and going.
FLIGHT, FADE, STAY = 0.6, 0.7, 1.2
_STEP = 0.04
#: Seconds that the browser has to say where its camera has landed, and of silence after which it rests.
LANDING, _REST = 3.0, 0.25


def fly(camera: Any, goal: Gaze, goes_on: Callable[[], bool]) -> None:
    """Move a browser's camera; returns when it is there.

    Args:
        camera: viser's handle of it.
        goal: where to.
        goes_on: asked before each step; a flight that is not to go on ends where it is.
    """
    from viser import transforms

    start = np.asarray(camera.position, np.float64), transforms.SO3(np.asarray(camera.wxyz)), float(camera.fov)
    end = transforms.SO3.from_matrix(goal.rotation)
    turn = (start[1].inverse() @ end).log()
    began = time.monotonic()
    while goes_on():
        part = min((time.monotonic() - began) / FLIGHT, 1.0)
        smooth = part * part * (3 - 2 * part)
        rotation = end if part == 1 else start[1] @ transforms.SO3.exp(turn * smooth)
        put(camera, start[0] + (goal.position - start[0]) * smooth, rotation.as_matrix(), goal.fov)
        if part == 1:
            return
        time.sleep(_STEP)


def land(camera: Any, goal: Gaze, told: Callable[[], tuple[Gaze, float] | None], goes_on: Callable[[], bool]) -> bool:
    """Wait after a flight until the browser's camera rests at the goal.

    viser turns a rotation into a point to look at by where it thinks that the camera stands. What a browser tells of an
    earlier step may reach it between two parts of the last one, and the camera would look past the goal for good: one
    that rests in the right place and looks elsewhere is set once more.

    Args:
        camera: viser's handle of it.
        goal: of the flight.
        told: what the browser has told last, and when, by the monotonic clock; None before it has.
        goes_on: asked all the time; whoever moves the camera meanwhile is left in peace.

    Returns:
        Whether it has arrived.
    """
    began = time.monotonic()
    put_at = began
    while goes_on() and (now := time.monotonic()) - began < LANDING:
        last = told()
        if last is not None and now - max(last[1], put_at) > _REST:
            if last[0].is_near(goal):
                return True
            if last[0].stands_with(goal):
                put(camera, goal.position, goal.rotation, goal.fov)
                put_at = now
        time.sleep(_STEP / 2)
    return False


def put(camera: Any, position: F64, rotation: F64, fov: float) -> None:
    """Set a browser's camera at once: (3,), (3, 3) camera to world, vertical angle in radians."""
    from viser import transforms

    # viser refuses to turn a camera that has no upwards or no distance to what it looks at, as a browser may say.
    with camera.client.atomic(), suppress(ValueError):
        camera.fov = fov
        camera.position = position
        # The controls turn around an axis of their own; up in the view is up in the picture, whatever they thought.
        camera.up_direction = -rotation[:, 1]
        camera.wxyz = transforms.SO3.from_matrix(rotation).wxyz


def fade(show: Callable[[float], None], goes_on: Callable[[], bool]) -> None:
    """Let something come, stay and go.

    Args:
        show: given how much of it shows, 0 to 1; at last 0.
        goes_on: asked before each step.
    """
    began = time.monotonic()
    while goes_on():
        passed = time.monotonic() - began
        left = 2 * FADE + STAY - passed
        if left <= 0:
            show(0.0)
            return
        show(max(0.0, min(1.0, passed / FADE, left / FADE)))
        time.sleep(_STEP)
