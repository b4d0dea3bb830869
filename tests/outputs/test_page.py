"""Pages that hold a scene: what encode writes, what reads it, and what a browser shows of it."""

from __future__ import annotations

import base64
import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.scenes import page as pages
from potr_cl.outputs import page
from potr_cl.outputs.page import Page
from potr_cl.outputs.potr import Potr
from potr_cl.pipeline.options import EncodeOptions

pytestmark = [pytest.mark.one_family, pytest.mark.one_runtime]
needs_viewer = pytest.mark.skipif(
    not page.TEMPLATE.exists(), reason="the viewer of pages is not built: python -m tools.make.web"
)
FAST = {"prune": False, "refit": False, "compact": False}


@pytest.fixture(scope="module")
def encoded(plush_excerpt, plush_excerpt_cameras, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "scene.html"
    cameras = plush_excerpt_cameras
    potr_cl.encode(plush_excerpt, cameras, EncodeOptions(output=Page()).changed(prune=False)).save(path)
    return path


@needs_viewer
def test_holds_what_a_potr_file_holds(plush_excerpt, tmp_path):
    whole = potr_cl.encode(plush_excerpt, None, EncodeOptions(output=Page()).changed(**FAST))
    inner = pages.scene_in(whole.data)
    alone = potr_cl.encode(plush_excerpt, None, EncodeOptions(output=Potr()).changed(**FAST))
    assert len(inner) == alone.nbytes
    scene = potr_cl.load_scene(_written(tmp_path / "a.html", whole.data))
    assert np.array_equal(scene.means, potr_cl.decode(inner).means)
    assert sum(Page().properties(whole.data).values()) == len(whole.data)


@needs_viewer
def test_loads_nothing_from_elsewhere(encoded):
    text = encoded.read_text()
    assert "default-src 'none'" in text
    assert "@" not in text.split('<script id="viewer"')[0].replace("@media", "")


def test_needs_its_viewer(monkeypatch, tmp_path):
    monkeypatch.setattr(page, "TEMPLATE", tmp_path / "none")
    with pytest.raises(UsageError, match=r"python -m tools.make.web"):
        Page()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"<html></html>", "no scene in it"),
        (pages.BEGIN + b"QUJD", "no scene in it"),
        (pages.BEGIN + b"QUJ" + pages.END, "cut off"),
        (pages.BEGIN + base64.b64encode(b"ply") + pages.END, "not a .potr file"),
    ],
)
def test_refuses_other_pages(content, words, tmp_path):
    path = _written(tmp_path / "a.html", content)
    with pytest.raises(DataError, match=words) as caught:
        potr_cl.load_scene(path)
    assert str(path) in str(caught.value)


# In a browser --------------------------------------------------------------------------------------------------------


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def shown(browser, path: Path, width: int, height: int, **context):
    tab = browser.new_context(viewport={"width": width, "height": height}, **context).new_page()
    asked = []
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(path.as_uri())
    tab.wait_for_selector("body[data-shown], body[data-failed]", state="attached")
    assert [url for url in asked if url.startswith("http")] == []
    return tab


def picture(tab) -> np.ndarray:
    tab.evaluate("document.getElementById('words').remove()")
    tab.wait_for_timeout(500)
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")) / 255


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(a - b).mean()))


def until(tab, expression: str, wanted) -> None:
    """Wait for a value, however slowly this machine draws."""
    for _ in range(600):
        if wanted(tab.evaluate(expression)):
            return
        tab.wait_for_timeout(100)
    raise AssertionError(f"it never came: {expression}")


@pytest.mark.browser
@pytest.mark.slow
@needs_viewer
@pytest.mark.parametrize("size", [(640, 480), (390, 844)], ids=["desktop", "phone"])
def test_shows_what_our_renderer_does(browser, encoded, plush_excerpt_cameras, size):
    width, height = size
    tab = shown(browser, encoded, width, height, has_touch=width < height)
    assert tab.evaluate("document.body.dataset.failed") is None
    first = next(camera for camera in plush_excerpt_cameras if camera.split == "train")
    # The page looks from the first view to the scene's middle, with the principal point in the middle.
    focal = first.fy * height / first.height
    matrix = np.array(tab.evaluate("Array.from(potr.camera.matrixWorldInverse.elements)")).reshape(4, 4).T
    pose = np.diag([1.0, -1.0, -1.0]) @ matrix[:3]
    camera = dataclasses.replace(
        first, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2,
        rotation=pose[:, :3], translation=pose[:, 3], lens=None,
    )  # fmt: skip
    ours = np.clip(potr_cl.render(potr_cl.load_scene(encoded), camera).image, 0, 1)
    theirs = picture(tab)
    # three.js has splats end at 1 / 55 of their opacity, ours at 1 / 255 of full opacity; and 8 bits of each colour.
    alike = psnr(ours, theirs)
    assert alike > 30
    assert alike > psnr(np.roll(ours, 2, axis=1), theirs) + 2
    assert alike > psnr(ours[:, ::-1], theirs) + 5


@pytest.mark.browser
@pytest.mark.slow
@needs_viewer
def test_turns_and_flies(browser, encoded):
    tab = shown(browser, encoded, 200, 150)
    place, away = "potr.camera.position.toArray()", "potr.camera.position.distanceTo(potr.controls.target)"
    before = tab.evaluate(place)
    tab.mouse.move(80, 80)
    tab.mouse.down()
    tab.mouse.move(120, 90, steps=3)
    tab.mouse.up()
    until(tab, place, lambda now: not np.allclose(before, now))
    distance = tab.evaluate(away)
    target = tab.evaluate("potr.controls.target.toArray()")
    tab.keyboard.down("w")
    until(tab, "potr.controls.target.toArray()", lambda now: not np.allclose(target, now))
    tab.keyboard.up("w")
    assert tab.evaluate(away) == pytest.approx(distance, rel=1e-3)


@pytest.mark.browser
@pytest.mark.slow
@needs_viewer
def test_says_what_is_wrong_with_a_file(browser, encoded, tmp_path):
    data = encoded.read_bytes()
    scene = bytearray(pages.scene_in(data))
    scene[-1] ^= 1
    begin = data.index(pages.BEGIN) + len(pages.BEGIN)
    end = data.index(pages.END, begin)
    path = _written(tmp_path / "broken.html", data[:begin] + base64.b64encode(scene) + data[end:])
    tab = shown(browser, path, 200, 150)
    assert "is damaged (its checksum does not match)" in tab.inner_text("#words")
