"""The thread that makes the pictures: small ones while the camera moves, whole ones when it stands, none for nobody."""

from __future__ import annotations

import dataclasses
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl.formats.images import to_8_bits
from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer, render
from potr_cl.raster.rules import INRIA
from potr_cl.viewer.losses import Losses
from potr_cl.viewer.painter import Painter
from potr_cl.viewer.pose import camera_of, gaze_on
from potr_cl.viewer.session import Exhibit, Session
from potr_cl.viewer.visitor import Shown, Visitor

WIDTH, HEIGHT = 120, 90


def until(check: Callable[[], object], said: Callable[[], str] = str) -> None:
    """Wait for what comes at once unless something hangs."""
    end = time.monotonic() + 300
    while not check():
        assert time.monotonic() < end, f"it does not come to pass {said()}"
        time.sleep(0.01)


class Browser:
    """Keeps what a visitor is shown and told; enters at once."""

    def __init__(self, painter: Painter, mode: Any = "divider", scale: int = 1) -> None:
        self.shown: list[Shown] = []
        self.told: list[str] = []
        width, height = scale * WIDTH, scale * HEIGHT
        self.visitor = Visitor(1, self.shown.append, self.told.append, width=width, height=height, mode=mode)
        self.painter = painter
        painter.enter(self.visitor)

    def look(self, gaze: Any) -> None:
        """What a movement of the camera does."""
        self.visitor.gaze, self.visitor.moved, self.visitor.is_still = gaze, time.monotonic(), False
        self.painter.wake(self.visitor, look=True)

    def change(self, **wishes: Any) -> None:
        for name, value in wishes.items():
            setattr(self.visitor, name, value)
        self.painter.wake(self.visitor)

    def still(self) -> Shown:
        until(lambda: self.shown and self.shown[-1].still and self.visitor.is_still, lambda: f"told {self.told}")
        return self.shown[-1]


@pytest.fixture(scope="module")
def device() -> Device:
    return Device()


@pytest.fixture
def scenes(plush_excerpt) -> list[Any]:
    return [plush_excerpt, plush_excerpt.subset(np.arange(0, len(plush_excerpt), 2))]


@pytest.fixture
def session(device, scenes) -> Iterator[Session]:
    session = Session(lambda: device, INRIA, (0.0, 0.0, 0.0))
    session.show("A", Exhibit(scenes[0], "whole.ply", 2000))
    session.show("B", Exhibit(scenes[1], "half.ply", 1000))
    yield session
    session.close()
    assert device.allocated == 0


@pytest.fixture
def views(plush_excerpt_cameras) -> list[Camera]:
    return [dataclasses.replace(camera, cx=120.0, cy=90.0) for camera in plush_excerpt_cameras[:3]]


@pytest.fixture
def photographs(views, tmp_path) -> Path:
    """Grey ones of all views but the last."""
    for camera in views[:2]:
        Image.new("RGB", (camera.width, camera.height), (200, 200, 200)).save(tmp_path / f"{camera.name}.png")
    return tmp_path


@pytest.fixture
def losses(views, photographs) -> Losses:
    losses = Losses(views, GroundTruth(photographs, views))
    losses.begin(is_pair=True)
    return losses


@pytest.fixture
def painter(session, losses) -> Iterator[Painter]:
    painter = Painter(session, losses, lambda: None)
    painter.start()
    yield painter
    painter.stop(patience=300)


@pytest.fixture
def gazes(plush_excerpt_cameras) -> list[Any]:
    return [gaze_on(camera, WIDTH / HEIGHT) for camera in plush_excerpt_cameras]


def test_whole_pictures_are_those_of_render(painter, gazes, scenes, device):
    browser = Browser(painter, "A")
    browser.look(gazes[4])
    camera = camera_of(gazes[4], WIDTH, HEIGHT)
    a, b = (to_8_bits(render(scene, camera, device)[0]) for scene in scenes)
    assert np.array_equal(browser.still().picture, a)
    compared = potr_cl.compare(*scenes, [camera], device=device)
    assert browser.shown[-1].look.psnr == pytest.approx(compared.psnr, abs=1e-4)
    browser.change(swapped=True)
    until(lambda: np.array_equal(browser.shown[-1].picture, b))


def test_while_the_camera_moves_there_are_fewer_pixels(painter, gazes):
    browser = Browser(painter, scale=4)
    steps = itertools.cycle(gazes)

    def moving() -> list[Shown]:
        browser.look(next(steps))
        time.sleep(0.04)
        return [each for each in browser.shown if not each.still]

    until(moving)
    assert moving()[0].picture.shape < (4 * HEIGHT, 4 * WIDTH, 3)
    assert browser.still().picture.shape == (4 * HEIGHT, 4 * WIDTH, 3)


def test_beside_each_other_each_has_half_the_width(painter, gazes):
    browser = Browser(painter, "side by side")
    browser.look(gazes[0])
    shown = browser.still()
    assert shown.picture.shape == (HEIGHT, WIDTH, 3)
    assert shown.look.a.shape == shown.look.b.shape == (HEIGHT, WIDTH // 2, 3)


def test_a_browser_that_draws_gets_figures_and_no_pictures(painter, gazes, scenes, device, monkeypatch):
    browser, looks, look = Browser(painter), [], Session.look
    monkeypatch.setattr(Session, "look", lambda *args, **choices: looks.append(args) or look(*args, **choices))
    browser.visitor.draws = True
    browser.look(gazes[0])
    until(lambda: browser.shown)
    assert [scenes for _, _, scenes, _ in looks[:1]] == [()], "nothing is rendered while the camera moves"
    shown = browser.still()
    compared = potr_cl.compare(*scenes, [camera_of(gazes[0], WIDTH, HEIGHT)], device=device)
    assert shown.look.psnr == pytest.approx(compared.psnr, abs=1e-4)
    assert {each.picture is None for each in browser.shown} == {True}
    browser.change(draws=False)
    until(lambda: browser.shown[-1].picture is not None)
    assert browser.shown[-1].picture.shape == (HEIGHT, WIDTH, 3)


def test_losses_are_those_of_compare(painter, losses, gazes, scenes, views, photographs, device):
    Browser(painter).look(gazes[0])
    until(lambda: losses.is_complete and losses.of(0) and losses.of(1) and losses.of(2))
    compared = potr_cl.compare(*scenes, views, device=device, split="all")
    photographed = potr_cl.compare(*scenes, views, device=device, split="all", truth=photographs).figures.views
    for number, view in enumerate(compared.figures.views):
        assert losses.of(number).psnr == pytest.approx(view.figures["b_against_a"].psnr, abs=1e-4)
        assert losses.of(number).ssim == pytest.approx(view.figures["b_against_a"].ssim, abs=1e-5)
    for number, view in enumerate(photographed):
        assert losses.of(number).photograph_a == pytest.approx(view.figures["a_against_truth"].psnr, abs=1e-4)
        assert losses.of(number).photograph_b == pytest.approx(view.figures["b_against_truth"].psnr, abs=1e-4)
    worst = sorted(range(2), key=lambda k: -photographed[k].figures["loss"].psnr)
    assert losses.order() == [*worst, 2], "by what photographs lose, then by what is told without one"
    assert losses.mean() == pytest.approx(compared.psnr, abs=1e-4)


def test_nobody_there_nothing_done(painter, gazes, monkeypatch):
    browser = Browser(painter)
    browser.look(gazes[0])
    browser.still()
    painter.leave(1)
    painter.all_anew()  # everything would have to be done again
    painter.ask(lambda: None)
    rendered, before = [], len(browser.shown)
    monkeypatch.setattr(Session, "look", lambda *_, **__: rendered.append(1))
    time.sleep(0.4)
    assert not rendered
    assert len(browser.shown) == before


def test_an_error_is_told_and_the_next_picture_comes(painter, gazes, monkeypatch):
    browser = Browser(painter)
    browser.look(gazes[0])
    browser.still()

    def failing(*_: Any) -> None:
        raise potr_cl.DeviceError("the device has failed")

    with monkeypatch.context() as patch:
        patch.setattr(Rasterizer, "render_into", failing)
        browser.look(gazes[1])
        until(lambda: "the device has failed" in browser.told)
        before = len(browser.told), len(browser.shown)
        time.sleep(0.4)
        assert (len(browser.told), len(browser.shown)) == before, "it does not try the same again and again"
    browser.look(gazes[2])
    browser.still()
    until(lambda: browser.told[-1] == "")  # it is told after the picture is shown


def test_scenes_are_replaced_between_pictures(painter, session, gazes):
    browser = Browser(painter, "B")
    browser.look(gazes[4])
    before = browser.still()

    def job() -> None:
        session.show("B", session.exhibit("A"))
        painter.all_anew()

    painter.do(job)
    until(lambda: browser.shown[-1].look.psnr == float("inf"))
    assert not np.array_equal(browser.shown[-1].picture, before.picture)


def test_memory_does_not_grow(session, device, views):
    """Whatever is looked at, in whatever size: the device holds what one picture needs."""

    def everything() -> int:
        for width, height in [(40 + 8 * k, 30 + 6 * k) for k in range(6)]:
            session.look(camera_of(gaze_on(views[0], width / height), width, height), figures=True)
        return device.allocated

    first = everything()
    assert everything() == first


def test_a_photograph_that_cannot_be_read_does_not_end_the_list(session, losses, views, photographs):
    assert losses.has_photograph(0)
    assert (losses.photograph(0) == 200).all()
    (photographs / f"{views[0].name}.png").write_bytes(b"no picture")
    while not losses.is_complete:
        losses.step(session)
    assert views[0].name in losses.trouble
    assert not losses.has_photograph(0)
    assert losses.of(0).photograph_a is None
    assert losses.of(1).photograph_a > 0


def test_the_thread_ends(painter):
    assert painter.ask(lambda: 1) == 1
    painter.stop(patience=300)
    assert "potr_cl painter" not in [thread.name for thread in threading.enumerate()]
    assert painter.ask(lambda: 1) is None


def test_the_photograph_of_a_view_fades_over_it(painter, views):
    browser = Browser(painter, "A", scale=2)
    browser.look(gaze_on(views[0], WIDTH / HEIGHT))
    bare = browser.still().picture
    browser.visitor.view = 0
    for part in (1.0, 0.5, 0.0):
        browser.change(fade=part)
        expected = bare * (1 - part) + 200 * part
        until(lambda expected=expected: abs(browser.shown[-1].picture - expected).max() <= 1)
    # A browser that draws has no photographs.
    browser.visitor.draws = True
    browser.look(browser.visitor.gaze)
    until(lambda: browser.visitor.is_still and browser.shown[-1].picture is None)
    browser.change(fade=1.0)
    until(lambda: browser.shown[-1].picture is not None and abs(browser.shown[-1].picture - 200.0).max() <= 1)
