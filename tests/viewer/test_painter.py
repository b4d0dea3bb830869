"""The thread that makes the pictures: small ones while the camera moves, whole ones when it stands, none for nobody."""

from __future__ import annotations

import dataclasses
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import potr_cl
from potr_cl.formats.images import to_8_bits
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.viewer.losses import Losses
from potr_cl.viewer.painter import Painter
from potr_cl.viewer.pose import camera_of, gaze_on
from potr_cl.viewer.session import Exhibit, Session
from potr_cl.viewer.visitor import Shown, Visitor
from tests.devices import KERNELS, open_device

WIDTH, HEIGHT = 120, 90


def until(check: Callable[[], object], said: Callable[[], str] = str) -> None:
    """Wait for what comes at once unless something hangs."""
    end = time.monotonic() + 300
    while not check():
        assert time.monotonic() < end, f"it does not come to pass {said()}"
        time.sleep(0.01)


class Browser:
    """Keeps what a visitor is shown and told."""

    def __init__(self) -> None:
        self.shown: list[Shown] = []
        self.told: list[str] = []
        self.visitor = Visitor(1, self.shown.append, self.told.append, width=WIDTH, height=HEIGHT)

    def look(self, painter: Painter, gaze: Any) -> None:
        """What a movement of the camera does."""
        self.visitor.gaze, self.visitor.moved, self.visitor.is_still = gaze, time.monotonic(), False
        painter.wake(self.visitor, look=True)

    def still(self) -> Shown:
        until(lambda: self.shown and self.shown[-1].still and self.visitor.is_still, lambda: f"told {self.told}")
        return self.shown[-1]


@pytest.fixture(scope="module", params=KERNELS)
def device(request: Any) -> Any:
    return open_device(request.param)


@pytest.fixture
def scenes(plush_excerpt) -> tuple[Exhibit, Exhibit]:
    fewer = plush_excerpt.subset(np.arange(0, len(plush_excerpt), 2))
    return Exhibit(plush_excerpt, "whole.ply", 2000), Exhibit(fewer, "half.ply", 1000)


@pytest.fixture
def painter(device, scenes, plush_excerpt_cameras) -> Iterator[Painter]:
    session = Session(lambda: device, INRIA, (0.0, 0.0, 0.0))
    session.show("A", scenes[0])
    session.show("B", scenes[1])
    losses = Losses(plush_excerpt_cameras[:3], None)
    losses.begin(session.is_pair)
    painter = Painter(session, losses, lambda: None)
    painter.session, painter.losses = session, losses  # type: ignore[attr-defined]
    painter.start()
    yield painter
    painter.stop(patience=300)
    assert device.allocated == 0


@pytest.fixture
def gazes(plush_excerpt_cameras) -> list[Any]:
    return [gaze_on(camera, WIDTH / HEIGHT) for camera in plush_excerpt_cameras]


def test_whole_pictures_are_those_of_render(painter, gazes, scenes, device):
    browser = Browser()
    browser.visitor.mode = "A"
    painter.enter(browser.visitor)
    browser.look(painter, gazes[4])
    camera = camera_of(gazes[4], WIDTH, HEIGHT)
    with Rasterizer(device, scenes[0].scene) as whole, Rasterizer(device, scenes[1].scene) as half:
        a, b = whole.render(camera)[0], half.render(camera)[0]
    assert np.array_equal(browser.still().picture, to_8_bits(a))
    compared = potr_cl.compare(scenes[0].scene, scenes[1].scene, [camera], device=device)
    assert browser.shown[-1].look.psnr == pytest.approx(compared.psnr, abs=1e-4)
    browser.visitor.swapped = True
    painter.wake(browser.visitor)
    until(lambda: np.array_equal(browser.shown[-1].picture, to_8_bits(b)))


def test_while_the_camera_moves_there_are_fewer_pixels(painter, gazes):
    browser = Browser()
    browser.visitor.width, browser.visitor.height = 4 * WIDTH, 4 * HEIGHT
    painter.enter(browser.visitor)
    steps = itertools.cycle(gazes)

    def moving() -> list[Shown]:
        browser.look(painter, next(steps))
        time.sleep(0.04)
        return [each for each in browser.shown if not each.still]

    until(moving)
    assert moving()[0].picture.shape < (4 * HEIGHT, 4 * WIDTH, 3)
    assert browser.still().picture.shape == (4 * HEIGHT, 4 * WIDTH, 3)


def test_beside_each_other_each_has_half_the_width(painter, gazes):
    browser = Browser()
    browser.visitor.mode = "side by side"
    painter.enter(browser.visitor)
    browser.look(painter, gazes[0])
    shown = browser.still()
    assert shown.picture.shape == (HEIGHT, WIDTH, 3)
    assert shown.look.a.shape == shown.look.b.shape == (HEIGHT, WIDTH // 2, 3)


def test_a_browser_that_draws_gets_figures_and_no_pictures(painter, gazes, scenes, device, monkeypatch):
    browser, looks, look = Browser(), [], Session.look
    monkeypatch.setattr(Session, "look", lambda *args, **choices: looks.append(args) or look(*args, **choices))
    browser.visitor.draws = True
    painter.enter(browser.visitor)
    browser.look(painter, gazes[0])
    until(lambda: browser.shown)
    assert [scenes for _, _, scenes, _ in looks[:1]] == [()], "nothing is rendered while the camera moves"
    shown = browser.still()
    camera = camera_of(gazes[0], WIDTH, HEIGHT)
    compared = potr_cl.compare(*(each.scene for each in scenes), [camera], device=device)
    assert shown.look.psnr == pytest.approx(compared.psnr, abs=1e-4)
    assert {each.picture is None for each in browser.shown} == {True}
    browser.visitor.draws = False
    painter.wake(browser.visitor)
    until(lambda: browser.shown[-1].picture is not None)
    assert browser.shown[-1].picture.shape == (HEIGHT, WIDTH, 3)


def test_losses_are_those_of_compare(painter, gazes, scenes, plush_excerpt_cameras, device):
    browser = Browser()
    painter.enter(browser.visitor)
    browser.look(painter, gazes[0])
    until(lambda: painter.losses.is_complete)
    time.sleep(0.3)
    compared = potr_cl.compare(*(each.scene for each in scenes), plush_excerpt_cameras[:3], device=device, split="all")
    figures = [view.figures["b_against_a"] for view in compared.figures.views]
    for number, expected in enumerate(figures):
        assert painter.losses.of(number).psnr == pytest.approx(expected.psnr, abs=1e-4)
        assert painter.losses.of(number).ssim == pytest.approx(expected.ssim, abs=1e-5)
    assert painter.losses.order() == sorted(range(3), key=lambda k: figures[k].psnr)
    assert painter.losses.mean() == pytest.approx(compared.psnr, abs=1e-4)


def test_nobody_there_nothing_done(painter, gazes, monkeypatch):
    browser = Browser()
    painter.enter(browser.visitor)
    browser.look(painter, gazes[0])
    browser.still()
    painter.leave(1)
    painter.all_anew()  # everything would have to be done again
    painter.ask(lambda: None)
    rendered = []
    monkeypatch.setattr(Session, "look", lambda *_, **__: rendered.append(1))
    before = time.thread_time(), len(browser.shown)
    time.sleep(1.2)
    assert not rendered
    assert len(browser.shown) == before[1]


def test_an_error_is_told_and_the_next_picture_comes(painter, gazes, monkeypatch):
    browser = Browser()
    painter.enter(browser.visitor)
    browser.look(painter, gazes[0])
    browser.still()

    def failing(*_: Any) -> None:
        raise potr_cl.DeviceError("the device has failed")

    with monkeypatch.context() as patch:
        patch.setattr(Rasterizer, "render_into", failing)
        browser.look(painter, gazes[1])
        until(lambda: "the device has failed" in browser.told)
        pictures = len(browser.shown)
        time.sleep(0.5)
        assert len(browser.shown) == pictures, "it does not try the same again and again"
    browser.look(painter, gazes[2])
    browser.still()
    until(lambda: browser.told[-1] == "")  # it is told after the picture is shown


def test_scenes_are_replaced_between_pictures(painter, gazes, scenes):
    browser = Browser()
    browser.visitor.mode = "B"
    painter.enter(browser.visitor)
    browser.look(painter, gazes[4])
    before = browser.still()

    def job() -> None:
        painter.session.show("B", scenes[0])
        painter.all_anew()

    painter.do(job)
    until(lambda: browser.shown[-1].look.psnr == float("inf"))
    assert not np.array_equal(browser.shown[-1].picture, before.picture)


@pytest.mark.one_runtime
def test_memory_does_not_grow(device, scenes, plush_excerpt_cameras):
    """Whatever is looked at, in whatever size: the device holds what one picture needs."""
    session = Session(lambda: device, INRIA, (0.0, 0.0, 0.0))
    session.show("A", scenes[0])
    session.show("B", scenes[1])
    camera = plush_excerpt_cameras[0]
    sizes = [(40 + 8 * k, 30 + 6 * k) for k in range(12)]

    def everything() -> int:
        for width, height in sizes:
            gaze = gaze_on(camera, width / height)
            session.look(camera_of(gaze, width, height), figures=True)
        return device.allocated

    first = everything()
    assert max(everything() for _ in range(4)) == first
    session.close()
    assert device.allocated == 0


@pytest.mark.one_runtime
def test_a_photograph_that_cannot_be_read_does_not_end_the_list(plush_excerpt_cameras, tmp_path):
    from potr_cl.quality.photographs import GroundTruth

    cameras = [dataclasses.replace(camera, lens=None) for camera in plush_excerpt_cameras[:2]]
    for camera in cameras:
        picture = np.zeros((camera.height, camera.width, 3), np.uint8)
        with (tmp_path / f"{camera.name}.png").open("wb") as file:
            from potr_cl.formats.images import write_png

            write_png(file, picture)
    photographs = GroundTruth(tmp_path, cameras)
    losses = Losses(cameras, photographs)
    assert losses.has_photograph(0)
    assert not losses.photograph(0).any()
    (tmp_path / f"{cameras[0].name}.png").write_bytes(b"no picture")
    losses.begin(is_pair=True)

    class Nothing:
        def look(self, camera: Any, figures: bool = False) -> Any:
            from potr_cl.viewer.session import Look

            return Look(camera, np.zeros((camera.height, camera.width, 3), np.float32), None)

    while not losses.is_complete:
        losses.step(Nothing())  # type: ignore[arg-type]
    assert cameras[0].name in losses.trouble
    assert not losses.has_photograph(0)
    assert losses.of(1).photograph_a == float("inf")


def test_the_thread_ends(device, scenes):
    session = Session(lambda: device, INRIA, (0.0, 0.0, 0.0))
    session.show("A", scenes[0])
    painter = Painter(session, Losses([], None), lambda: None)
    others = set(threading.enumerate())
    painter.start()
    (own,) = (each for each in set(threading.enumerate()) - others if each.name == "potr_cl painter")
    painter.stop(patience=300)
    assert not own.is_alive()
    assert painter.ask(lambda: 1) is None


@pytest.mark.one_runtime
def test_the_photograph_of_a_view_fades_over_it(device, scenes, plush_excerpt_cameras, tmp_path):
    from PIL import Image

    from potr_cl.quality.photographs import GroundTruth

    camera = dataclasses.replace(plush_excerpt_cameras[0], cx=120.0, cy=90.0)
    photograph = np.full((camera.height, camera.width, 3), 200, np.uint8)
    Image.fromarray(photograph).save(tmp_path / f"{camera.name}.png")
    session = Session(lambda: device, INRIA, (0.0, 0.0, 0.0))
    session.show("A", scenes[0])
    painter = Painter(session, Losses([camera], GroundTruth(tmp_path, [camera])), lambda: None)
    painter.start()
    try:
        browser = Browser()
        browser.visitor.width, browser.visitor.height = camera.width, camera.height
        painter.enter(browser.visitor)
        browser.look(painter, gaze_on(camera, camera.width / camera.height))
        bare = browser.still().picture
        browser.visitor.view = 0
        for part in (1.0, 0.5, 0.0):
            browser.visitor.fade = part
            painter.wake(browser.visitor)
            painter.ask(lambda: None)
            expected = bare * (1 - part) + 200 * part
            until(lambda expected=expected: abs(browser.shown[-1].picture - expected).max() <= 1)
        # A browser that draws has no photographs.
        browser.visitor.draws = True
        browser.look(painter, browser.visitor.gaze)
        until(lambda: browser.visitor.is_still and browser.shown[-1].picture is None)
        browser.visitor.fade = 1.0
        painter.wake(browser.visitor)
        until(lambda: browser.shown[-1].picture is not None and abs(browser.shown[-1].picture - 200.0).max() <= 1)
    finally:
        painter.stop(patience=300)
