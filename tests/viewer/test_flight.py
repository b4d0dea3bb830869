"""A flight to a view ends there, whatever the browser says of its camera on the way."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from potr_cl.viewer.flight import fly, land
from potr_cl.viewer.pose import Gaze, gaze_on, rotation_of

pytest.importorskip("viser", reason="the extra view is not installed")

pytestmark = pytest.mark.one_runtime


class Camera:
    """What viser has of a browser's camera; the browser takes a rotation as a point to look at."""

    def __init__(self, gaze: Gaze) -> None:
        from viser import transforms

        self.client = self
        self.fov, self.position, self.up_direction = gaze.fov, gaze.position, -gaze.rotation[:, 1]
        self.rotation = gaze.rotation
        self._wxyz = transforms.SO3.from_matrix(gaze.rotation).wxyz
        self.told = gaze, time.monotonic()
        self.puts = 0
        self.turned_by = 0.0

    @contextlib.contextmanager
    def atomic(self) -> Iterator[None]:
        yield

    @property
    def wxyz(self) -> Any:
        return self._wxyz

    @wxyz.setter
    def wxyz(self, wxyz: Any) -> None:
        """The last thing that is set: then the browser tells where it is; turned, if it is said to be."""
        self._wxyz = wxyz
        self.puts += 1
        turn, self.turned_by = self.turned_by, 0.0
        around = np.array([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
        self.told = Gaze(np.asarray(self.position, float), rotation_of(wxyz) @ around, self.fov), time.monotonic()


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A camera that arrives is waited for, however busy the machine is."""
    monkeypatch.setattr("potr_cl.viewer.flight.LANDING", 300.0)
    monkeypatch.setattr("potr_cl.viewer.flight.FLIGHT", 0.2)


@pytest.fixture
def goal(plush_excerpt_cameras) -> Gaze:
    return gaze_on(plush_excerpt_cameras[5], 1.5)


@pytest.fixture
def camera(plush_excerpt_cameras, goal) -> Camera:
    """One that has just flown to the goal."""
    camera = Camera(gaze_on(plush_excerpt_cameras[0], 1.5))
    fly(camera, goal, lambda: True)
    assert camera.puts > 2
    return camera


@pytest.mark.parametrize("turned_by", [0.0, 0.01])
def test_a_camera_that_looks_past_its_goal_is_set_once_more(camera, goal, turned_by):
    """One that has arrived is left alone."""
    camera.turned_by = turned_by
    camera.wxyz = camera.wxyz
    assert camera.told[0].is_near(goal) == (turned_by == 0)
    before = camera.puts
    assert land(camera, goal, lambda: camera.told, lambda: True)
    assert camera.told[0].is_near(goal)
    assert camera.puts == before + (turned_by > 0)


def test_what_was_told_of_an_earlier_step_is_not_taken_for_an_arrival_missed(camera, goal, plush_excerpt_cameras):
    """Words of the last step and of the one before come in the wrong order; it rests where the browser says last."""
    arrived = camera.told[0]
    camera.told = gaze_on(plush_excerpt_cameras[4], 1.5), time.monotonic()

    def tells() -> None:
        camera.told = arrived, time.monotonic()

    timer = threading.Timer(0.1, tells)
    timer.start()
    assert land(camera, goal, lambda: camera.told, lambda: True)
    timer.join()


def test_whoever_moves_the_camera_away_keeps_it(camera, goal, monkeypatch):
    monkeypatch.setattr("potr_cl.viewer.flight.LANDING", 0.6)
    camera.told = Gaze(goal.position + 0.5, goal.rotation, goal.fov), time.monotonic()
    before = camera.puts
    assert not land(camera, goal, lambda: camera.told, lambda: True)
    assert camera.puts == before


def test_another_flight_ends_this_one(camera, goal):
    before = camera.puts
    assert not land(camera, goal, lambda: None, lambda: False)
    fly(camera, goal, lambda: False)
    assert camera.puts == before
