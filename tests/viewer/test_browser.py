"""The page in a real browser: what a user sees and does."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import io
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.viewer.comparison import MODES
from potr_cl.viewer.pose import camera_of

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.one_runtime]

WIDTH, HEIGHT = 760, 480
#: Of the page, what neither labels nor viser's notes nor the panel cover: rows and columns.
CLEAR = (slice(220, 460), slice(20, 420))
HOSTILE = '<img src=x onerror="document.title=1">\u202e.ply'


@pytest.fixture(scope="module")
def ladder(tmp_path_factory, data) -> Path:
    """The folder of a ladder of the excerpt: three qualities, no views, so that it takes no time."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    folder = tmp_path_factory.mktemp("ladder")
    potr_cl.encode_ladder(data / "plush_excerpt.ply", folder, [0, 0.5, 1], prune=False, refit=False, compact=False)
    return folder


@pytest.fixture(scope="module")
def viewer(ladder, data) -> Iterator[Any]:
    cameras = potr_cl.read_cameras(data / "plush_excerpt_cameras.json")
    cameras[3] = dataclasses.replace(cameras[3], name=HOSTILE)
    with pytest.MonkeyPatch.context() as patch, potr_cl.view(data / "plush_excerpt.ply", ladder, cameras) as viewer:
        patch.setattr("potr_cl.viewer.flight.LANDING", 300.0)  # however slow the browser is
        yield viewer


@contextlib.contextmanager
def opened(browser: Any, viewer: Any, prepare: Callable[[Any], Any] | None = None, **choices: Any) -> Iterator[Any]:
    """A tab that shows the viewer; an error on its console fails the test.

    Args:
        prepare: given the context of the browser before it opens a tab.
        choices: of the context.
    """
    context = browser.new_context(**{"viewport": {"width": WIDTH, "height": HEIGHT}, **choices})
    before, errors = len(viewer.painter.visitors), []
    if prepare is not None:
        prepare(context)
    tab = context.new_page()
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    try:
        tab.goto(viewer.url)
        until(lambda: tab.locator(".potr-figures b").count() > 0)
        yield tab
    finally:
        context.close()
        until(lambda: len(viewer.painter.visitors) <= before)
    assert errors == []


@pytest.fixture(scope="module")
def tab(viewer, browser) -> Iterator[Any]:
    with opened(browser, viewer) as tab:
        yield tab


@pytest.fixture
def page(viewer, tab) -> Any:
    """The same tab for all tests, for it takes long to load; as it is at the beginning."""
    tab.keyboard.press("1")
    if tab.get_by_role("checkbox").first.is_checked():
        tab.keyboard.press("c")
    viewer.climb(1)
    until(lambda: "_q0.5." in viewer.session.exhibit("B").name)
    viewer.painter.visitors[0].divider = 0.5
    tab.locator("[data-view='0']").click()
    until(lambda: viewer.painter.visitors[0].view == 0)
    return tab


def until(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come"
        time.sleep(0.05)


def press(viewer: Any, page: Any, key: str) -> None:
    """Choose what is shown, and wait until that is known behind the page."""
    page.keyboard.press(key)
    until(lambda: viewer.painter.visitors[-1].mode == MODES[int(key) - 1])


def still(viewer: Any, page: Any) -> Any:
    """The visitor of a page, once its picture is as good as it gets and nothing is on its way."""
    until(lambda: bool(viewer.painter.visitors))
    visitor = viewer.painter.visitors[-1]
    until(
        lambda: visitor.is_still and not visitor.stale_look and not visitor.stale_picture and visitor.look is not None
    )
    page.wait_for_timeout(700)
    until(lambda: visitor.is_still and not visitor.stale_picture)
    page.wait_for_timeout(300)
    return visitor


def seen(page: Any) -> Any:
    """(H, W, 3) float, what the tab shows where nothing covers the picture."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))[CLEAR].astype(np.float64) / 255


def rendered(viewer: Any, visitor: Any, which: str) -> Any:
    camera = camera_of(visitor.gaze, visitor.width, visitor.height)
    exhibit = viewer.session.exhibit(which)
    image = potr_cl.render(exhibit.scene, camera).pixels.astype(np.float64) / 255
    assert image.shape == (HEIGHT, WIDTH, 3), "the picture fills the page"
    return image[CLEAR]


def test_the_picture_is_that_of_render(viewer, page):
    press(viewer, page, "3")
    visitor = still(viewer, page)
    assert visitor.mode == "A"
    expected = rendered(viewer, visitor, "A")
    assert expected.std() > 0.05, "something is to be seen"
    until(lambda: psnr(seen(page), expected) > 34)  # a JPEG of quality 95, its colours at half the resolution
    press(viewer, page, "4")
    visitor = still(viewer, page)
    expected = rendered(viewer, visitor, "B")
    until(lambda: psnr(seen(page), expected) > 34)


def test_the_divider_is_drawn(viewer, page):
    page.locator("[data-potr=scenes]").wait_for()
    slide(page, 0)
    until(lambda: viewer.session.exhibit("B").name.endswith("_q0.potr"))
    page.locator("[data-view='4']").click()  # there the scene fills the picture
    until(lambda: viewer.painter.visitors[0].view == 4)
    visitor = still(viewer, page)
    grip = page.locator(".potr-grip").bounding_box()
    assert grip["x"] + grip["width"] / 2 == pytest.approx(WIDTH / 2, abs=2)
    page.mouse.move(WIDTH / 2, HEIGHT / 2)
    page.mouse.down()
    page.mouse.move(280, HEIGHT / 2, steps=5)
    page.mouse.up()
    until(lambda: abs(visitor.divider - 280 / WIDTH) < 0.01)
    still(viewer, page)
    picture, a, b = seen(page), rendered(viewer, visitor, "A"), rendered(viewer, visitor, "B")
    column = 280 - CLEAR[1].start
    left, right = slice(0, column - 30), slice(column + 30, None)
    assert psnr(picture[:, left], a[:, left]) > psnr(picture[:, left], b[:, left]) + 1
    assert psnr(picture[:, right], b[:, right]) > psnr(picture[:, right], a[:, right]) + 1


def slide(page: Any, rung: int) -> None:
    """Choose the first or the last quality."""
    page.locator("[role=slider]:not(.potr-grip)").first.focus()
    page.keyboard.press("End" if rung else "Home")


def test_the_slider_chooses_a_quality(viewer, page, ladder):
    sizes = [(ladder / f"plush_excerpt_q{q}.potr").stat().st_size for q in ("0", "0.5", "1")]
    slide(page, 0)
    until(lambda: viewer.session.exhibit("B").nbytes == sizes[0])
    low = float(figure(viewer, page).split()[0])
    slide(page, 2)
    until(lambda: viewer.session.exhibit("B").nbytes == sizes[2])
    high = float(figure(viewer, page).split()[0])
    assert high > low + 3
    assert page.locator("[data-potr=scenes]").inner_text().count("plush_excerpt_q1.potr") == 1


def figure(viewer: Any, page: Any) -> str:
    still(viewer, page)
    return page.locator(".potr-figures b").first.inner_text()


def test_figures_are_those_of_compare(viewer, page):
    visitor = still(viewer, page)
    camera = camera_of(visitor.gaze, visitor.width, visitor.height)
    a, b = (viewer.session.exhibit(which).scene for which in "AB")
    expected = potr_cl.compare(a, b, [camera])
    told = [f"{expected.psnr:.2f} dB", f"{expected.ssim:.4f}"]
    until(lambda: page.locator(".potr-figures b").all_inner_texts() == told)


def test_heat_map_and_difference(viewer, page):
    slide(page, 0)
    press(viewer, page, "6")
    visitor = still(viewer, page)
    page.get_by_text("equal", exact=True).wait_for()

    def is_hot(picture: Any) -> bool:
        """Its colours go from black over red to yellow: green only where there is red."""
        return bool(picture.max() > 0.5 and (picture[..., 1] <= picture[..., 0] + 0.2).all())

    until(lambda: is_hot(seen(page)))
    press(viewer, page, "5")
    visitor = still(viewer, page)
    a, b = rendered(viewer, visitor, "A"), rendered(viewer, visitor, "B")
    factor = int(page.locator("[data-potr=figures] .potr-note").inner_text().split("× ")[-1])
    until(lambda: psnr(seen(page), np.clip(factor * abs(a - b), 0, 1)) > 25)


def test_side_by_side_and_the_flicker_key(viewer, page):
    press(viewer, page, "2")
    visitor = still(viewer, page)
    assert visitor.look.a.shape == visitor.look.b.shape == (HEIGHT, WIDTH // 2, 3)
    left = slice(None, WIDTH // 2 - 60)
    until(lambda: psnr(seen(page)[:, left], visitor.look.a[CLEAR][:, left].astype(float)) > 30)
    press(viewer, page, "3")
    visitor = still(viewer, page)
    page.keyboard.down("f")
    until(lambda: visitor.swapped)
    page.get_by_text("B", exact=True).first.wait_for()
    page.keyboard.up("f")
    until(lambda: not visitor.swapped)


def test_a_click_flies_to_a_view(viewer, page):
    visitor = still(viewer, page)
    assert visitor.view == 0
    page.locator("[data-view='5']").click()
    until(lambda: visitor.view == 5)
    still(viewer, page)
    assert visitor.view == 5
    camera = viewer.losses.views[5]
    assert visitor.gaze.position == pytest.approx(camera.centre, abs=1e-3)
    assert visitor.gaze.rotation == pytest.approx(camera.rotation.T, abs=1e-3)
    page.locator("[data-view='5'].at").wait_for()


def test_a_press_outlasts_news_of_the_views(viewer, page):
    """The list is made anew and put in order while figures of views become known, also under a finger."""
    slide(page, 2)
    until(lambda: viewer.losses.is_complete and viewer.session.exhibit("B").name.endswith("_q1.potr"))
    visitor = still(viewer, page)
    row = page.locator("[data-view='7']")
    row.scroll_into_view_if_needed()
    box = row.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    before = row.inner_text()
    viewer.climb(0)
    until(lambda: viewer.losses.is_complete and viewer.session.exhibit("B").name.endswith("_q0.potr"))
    still(viewer, page)
    page.mouse.up()
    until(lambda: visitor.view == 7)
    until(lambda: row.inner_text() != before)
    row.focus()
    viewer.climb(2)
    until(lambda: row.inner_text() == before)
    assert page.evaluate("document.activeElement.dataset.view") == "7", "the keyboard stays where it was"


def test_a_click_on_a_frustum_flies_there(viewer, page):
    visitor = still(viewer, page)
    press(viewer, page, "3")
    page.keyboard.press("c")
    until(page.get_by_role("checkbox").first.is_checked)
    page.mouse.move(200, 300)
    for _ in range(8):
        page.mouse.wheel(0, 400)
        page.wait_for_timeout(60)
    visitor = still(viewer, page)
    camera = camera_of(visitor.gaze, visitor.width, visitor.height)
    places = {}
    for number, view in enumerate(viewer.losses.views):
        x, y, z = camera.rotation @ view.centre + camera.translation
        if z > 0:
            places[number] = (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy)
    clear = [at for at in places.values() if 10 < at[0] < 420 and 10 < at[1] < 470]
    assert clear, "no frustum is in the picture"
    for x, y in clear:
        # As a hand does it: viser has to see that the mouse is over it, at the few pictures a second of this WebGL.
        page.mouse.move(x - 3, y - 3)
        page.wait_for_timeout(300)
        page.mouse.move(x, y)
        page.wait_for_timeout(500)
        page.mouse.down()
        page.wait_for_timeout(150)
        page.mouse.up()
        page.wait_for_timeout(1000)
        if np.linalg.norm(visitor.gaze.position - camera.centre) > 1e-3:
            until(lambda: visitor.view is not None)
            return
    raise AssertionError("no click flew anywhere")


#: Hides the panel and viser's notes.
HIDE = """document.head.append(Object.assign(document.createElement("style"),
  { textContent: ".mantine-Paper-root, .mantine-Notifications-root { visibility: hidden }" }))"""


def test_the_browser_draws_what_render_does(viewer, browser):
    """Where WebGL is computed on the CPU only if it is asked to."""
    with opened(browser, viewer) as tab:
        tab.locator("[data-potr=drawn] [aria-pressed=true]", has_text="exact").wait_for()
        assert tab.evaluate("globalThis.potr") is None, "what is not needed is loaded"
        visitor = viewer.painter.visitors[-1]
        slide(tab, 0)
        until(lambda: viewer.session.exhibit("B").name.endswith("_q0.potr"))
        tab.locator("[data-view='4']").click()
        until(lambda: visitor.view == 4)
        tab.keyboard.press("x")
        until(lambda: visitor.draws)
        tab.evaluate(HIDE)

        def picture(columns: slice = slice(None)) -> Any:
            tab.wait_for_timeout(200)
            shot = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
            return shot[60:, columns].astype(np.float64) / 255

        def exact(which: str, columns: slice = slice(None), width: int = WIDTH) -> Any:
            camera = camera_of(visitor.gaze, width, HEIGHT)
            pixels = potr_cl.render(viewer.session.exhibit(which).scene, camera).pixels
            return pixels[60:, columns].astype(np.float64) / 255

        def is_drawn(which: str, columns: slice = slice(None), width: int = WIDTH, of: slice | None = None) -> bool:
            """Whether the part of the page is that scene, and not the other one, however good that is."""
            drawn, other = picture(columns), "B" if which == "A" else "A"
            like = psnr(drawn, exact(which, of or columns, width))
            return bool(28 < like < 60 and like > psnr(drawn, exact(other, of or columns, width)) + 1)

        left, right = slice(0, WIDTH // 2 - 25), slice(WIDTH // 2 + 25, None)
        until(lambda: is_drawn("A", left) and is_drawn("B", right))
        press(viewer, tab, "4")
        until(lambda: is_drawn("B"))
        tab.keyboard.down("f")
        until(lambda: is_drawn("A"))
        tab.keyboard.up("f")
        press(viewer, tab, "2")
        half = WIDTH // 2
        until(lambda: is_drawn("A", left, half, left) and is_drawn("B", right, half, slice(25, None)))
        press(viewer, tab, "3")
        figures = still(viewer, tab).look
        assert figures.psnr is not None, "figures are found without pictures"
        # Another scene, of another camera.
        viewer.climb(2)
        press(viewer, tab, "4")
        tab.mouse.move(300, 300)
        tab.mouse.wheel(0, 100)
        until(lambda: visitor.view is None)
        until(lambda: 28 < psnr(picture(), exact("B")) < 60)
        # Both: left of the line as drawn here, right of it the server's own.
        here = picture()
        tab.keyboard.press("x")
        until(lambda: not visitor.draws and visitor.is_still)
        until(lambda: psnr(picture(), exact("B")) > 34 and not np.array_equal(picture(), here))
        tab.wait_for_timeout(700)
        pictured = picture()
        tab.locator("[data-potr=drawn] button", has_text="both").dispatch_event("click")
        until(lambda: tab.evaluate("document.body.dataset.drawn") == "both")
        until(lambda: psnr(picture(left), here[:, left]) > 60 and psnr(picture(right), pictured[:, right]) > 60)
        assert psnr(here[:, left], pictured[:, left]) < 50
        labels = tab.locator(".potr-label").all_inner_texts()
        assert labels == ["B, your GPU", "B, exact"]
        # What it cannot draw.
        press(viewer, tab, "6")
        until(lambda: tab.evaluate("document.body.dataset.drawn") == "")


def test_a_scene_that_is_too_large_is_pictured(viewer, page, monkeypatch):
    page.locator("[data-potr=drawn] button").first.wait_for()
    with monkeypatch.context() as patch:
        patch.setattr("potr_cl.viewer.server.MOST_DRAWN", 100)
        viewer.climb(0)
        page.locator("[data-potr=drawn] button").first.wait_for(state="detached")


def test_a_second_tab_and_the_end_of_the_work(viewer, browser, page):
    first = still(viewer, page)
    with opened(browser, viewer) as other:
        assert len(viewer.painter.visitors) == 2
        other.keyboard.press("4")
        until(lambda: [visitor.mode for visitor in viewer.painter.visitors] == ["divider", "B"])
    assert viewer.painter.visitors == [first]


def test_a_dropped_file_is_shown_and_hostile_names_are_text(viewer, page, data):
    exhibit = viewer.session.exhibit("B")
    scene = potr_cl.read_scene(data / "plush_excerpt.ply")
    content = (data / "plush_excerpt.ply").read_bytes()
    drop(page, HOSTILE, content, "B")
    until(lambda: len(viewer.session.exhibit("B").scene) == len(scene))
    page.locator("[data-potr=scenes]", has_text="<img src=x").wait_for()
    page.locator("[data-potr=views]", has_text="<img src=x").wait_for()
    assert page.locator("img[src=x]").count() == 0
    assert page.title() != "1"
    viewer.put("B", exhibit)
    until(lambda: viewer.session.exhibit("B") is exhibit)


#: Notes when the page hands a word of its camera to the worker that sends it.
SPY = """window.told = []; const post = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (data, ...rest) {
  if (data && data.message && data.message.type === "ViewerCameraMessage") window.told.push(performance.now());
  return post.call(this, data, ...rest);
};"""


def test_the_camera_is_told_as_often_as_screens_show_pictures(viewer, browser):
    with opened(browser, viewer, lambda context: context.add_init_script(SPY)) as tab:
        tab.mouse.move(200, 330)
        tab.mouse.down()
        gaps: list[float] = []
        end = time.monotonic() + 60
        while not (gaps and min(gaps) < 1000 / 60) and time.monotonic() < end:
            for step in range(40):
                tab.mouse.move(200 + 2 * step, 330 + step % 7)
            told = tab.evaluate("window.told")
            gaps = [later - before for before, later in pairwise(told)]
        tab.mouse.up()
    assert min(gaps) < 1000 / 60, "viser's page tells no sooner than after 20 ms"


def test_arrow_keys_move_the_slider_from_file_to_file(viewer, page):
    visitor = still(viewer, page)
    until(lambda: page.title().startswith("plush_excerpt.ply – plush_excerpt_q0.5.potr – "))
    page.locator("[role=slider]:not(.potr-grip)").first.focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: viewer.session.exhibit("B").name.endswith("_q0.potr"))
    page.keyboard.press("ArrowLeft")  # there is none below
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    until(lambda: "_q1." in viewer.session.exhibit("B").name)
    until(lambda: page.title().startswith("plush_excerpt.ply – plush_excerpt_q1.potr – "))
    still(viewer, page)
    assert visitor.view == 0, "viser turns the camera by these keys where no slider has them"


def test_an_old_answer_does_not_undo_a_key(viewer, page, browser):
    """On a slow line what the server told before a key may come after it."""
    held: list[Any] = []
    is_slow = False

    def route(socket: Any) -> None:
        server = socket.connect_to_server()
        server.on_message(lambda message: held.append((socket, message)) if is_slow else socket.send(message))

    def prepare(context: Any) -> None:
        context.route_web_socket(lambda url: "potr_cl/channel" in url, route)

    with opened(browser, viewer, prepare) as slow:

        def behind(name: str) -> bool:
            """Is this file shown behind the page? What a routed page says goes by this process, while it waits."""
            slow.wait_for_timeout(50)
            return name in viewer.session.exhibit("B").name

        until(lambda: slow.title().startswith("plush_excerpt.ply – plush_excerpt_q0.5.potr – "))
        is_slow = True
        slow.locator("[role=slider]:not(.potr-grip)").first.focus()
        slow.keyboard.press("ArrowLeft")
        until(lambda: behind("_q0.potr"))
        until(lambda: slow.wait_for_timeout(50) or any("_q0.potr" in message for _, message in held))
        slow.keyboard.press("ArrowRight")
        for socket, message in held[:]:
            socket.send(message)
        until(lambda: slow.title().startswith("plush_excerpt.ply – plush_excerpt_q0.potr – "))
        slow.keyboard.press("ArrowRight")
        until(lambda: behind("_q1."))


def test_on_a_phone(viewer, browser):
    choices = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
    with opened(browser, viewer, **choices, device_scale_factor=2) as phone:
        visitor = still(viewer, phone)
        assert (visitor.width, visitor.height) == (780, 1688), "pictures have the pixels of the screen"
        phone.locator("[data-potr=figures]", has_text="780 × 1688").wait_for()
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390
        panel = phone.locator(".potr-sheet").bounding_box()
        assert (panel["x"], panel["width"]) == (0, 390)
        assert panel["y"] > 0.6 * 844, "the picture is above the panel"
        handle = phone.evaluate("parseFloat(getComputedStyle(document.querySelector('.potr-grip'), '::after').top)")
        assert 40 < handle + 17 < panel["y"]
        note = phone.locator(".mantine-Notification-root").first  # that WebGL is computed on the CPU
        label = phone.locator(".potr-label.left").bounding_box()
        assert note.bounding_box()["y"] >= label["y"] + label["height"], "notes leave the labels free"


def test_a_bad_file_is_told(viewer, page):
    before = viewer.session.exhibit("B")
    drop(page, "scene.ply", b"this is no scene", "B")
    page.locator(".potr-toast.bad", has_text="scene.ply").wait_for()
    drop(page, "scene.docx", b"neither is this", "A")
    page.locator(".potr-toast.bad", has_text="no scene that is known by its name").wait_for()
    assert viewer.session.exhibit("B") is before


def drop(page: Any, name: str, content: bytes, which: str) -> None:
    """What a browser does when a file is dropped; the file is made in the page, for no mouse brings one."""
    page.evaluate(
        """([name, content, which]) => {
            const data = new DataTransfer();
            data.items.add(new File([Uint8Array.from(atob(content), c => c.charCodeAt(0))], name));
            const event = kind => new DragEvent(kind, { dataTransfer: data, bubbles: true, cancelable: true });
            document.body.dispatchEvent(event("dragenter"));
            document.querySelector(`[data-as=${which}]`).dispatchEvent(event("drop"));
        }""",
        [name, base64.b64encode(content).decode(), which],
    )


def test_an_error_of_the_device_is_shown_and_the_server_lives_on(viewer, page, monkeypatch):
    visitor = still(viewer, page)

    def failing(*_: Any) -> None:
        raise potr_cl.DeviceError("the device <b>broke</b>")

    with monkeypatch.context() as patch:
        patch.setattr(Rasterizer, "render_into", failing)
        page.locator("[data-view='3']").click()
        page.locator(".potr-error", has_text="the device <b>broke</b>").wait_for()
    page.locator("[data-view='4']").click()
    until(lambda: visitor.view == 4)
    still(viewer, page)
    assert page.locator(".potr-error").count() == 0
