"""The decoder, its loaders and pages in a real browser: what it draws is what our renderer draws.

Skipped where there is no Chromium, or ``python -m tools.make.web`` has built nothing. One browser for all, whose WebGL
is computed on the CPU.
"""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import potr_cl
from potr_cl.formats.scenes import page as pages
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene, joined
from potr_cl.outputs.potr import Page
from potr_cl.pipeline.options import EncodeOptions
from tests.cases.web import GOLDEN, WEB, judged
from tests.reference.scenes import random_scene

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.one_family,
    pytest.mark.one_runtime,
    pytest.mark.skipif(
        not (pages.TEMPLATE.exists() and (WEB / "dist" / "potr.js").exists() and (WEB / "node_modules").exists()),
        reason="the decoder for browsers is not built: python -m tools.make.web",
    ),
]
FAST = {"prune": False, "refit": False, "compact": False}
WIDTH, HEIGHT = 320, 240


class Server:
    """Gives a browser the files in web/, and some of its own: all at once, or half until ``rest`` is set."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.rest = threading.Event()
        self.cut_off = threading.Event()
        server = self

        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                pass

            def do_GET(self) -> None:
                content = server.files.get(self.path.removeprefix("/slow"))
                if content is None:
                    super().do_GET()
                    return
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                try:
                    half = len(content) // 2 if self.path.startswith("/slow") else len(content)
                    self.wfile.write(content[:half])
                    if half < len(content):
                        server.rest.wait(300)
                        for at in range(half, len(content), 100):
                            self.wfile.write(content[at : at + 100])
                except OSError:
                    server.cut_off.set()

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(WEB)))
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}"
        threading.Thread(target=self.http.serve_forever, daemon=True).start()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    server = Server()
    server.files = {f"/{path.name}": path.read_bytes() for path in GOLDEN}
    yield server
    server.rest.set()
    server.http.shutdown()
    server.http.server_close()


@pytest.fixture(scope="module")
def tab(browser: Any, server: Server) -> Any:
    """A page that has the loaders' engines (web/test/stage.html); each test loads it anew."""
    return browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}).new_page()


def on_stage(tab: Any, server: Server) -> None:
    tab.goto(f"{server.url}/test/stage.html")
    tab.wait_for_selector("body[data-ready]", state="attached")


def picture(tab: Any) -> NDArray[np.float64]:
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")) / 255


def psnr(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(-10 * np.log10(np.square(a - b).mean()))


def check_alike(ours: NDArray[Any], theirs: NDArray[Any], least: float) -> None:
    """Also that a picture of something else, or from elsewhere, would not do."""
    alike = psnr(ours, theirs)
    assert alike > least
    assert alike > psnr(np.roll(ours, 2, axis=1), theirs) + 2
    assert alike > psnr(ours[:, ::-1], theirs) + 5


# The decoder ---------------------------------------------------------------------------------------------------------

_IN_BROWSER = """async ([data, workers, simd]) => {
  const { decode } = await import('/dist/potr.js');
  const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0)), wasm = simd ? {} : { simd: null };
  const blocks = [], scene = await decode(bytes, { workers, wasm, onBlock: ({ block }) => blocks.push(block) });
  const names = ['positions', 'scales', 'rotations', 'opacities', 'sh'];
  const all = await new Blob(names.map((name) => scene[name])).arrayBuffer();
  const digest = new Uint8Array(await crypto.subtle.digest('SHA-256', all));
  return [Array.from(digest, (byte) => byte.toString(16).padStart(2, '0')).join(''), blocks.length];
}"""


def test_decodes_to_the_same_bits(tab: Any, server: Server) -> None:
    """Golden files in the page's thread, and a scene of several parts by two workers, with SIMD and without."""
    large = potr_cl.encode(
        random_scene(150_000, degree=1, seed=4), None, EncodeOptions().changed(prune=False, refit=False, compact=False)
    )
    tab.goto(f"{server.url}/README.md")
    for simd in (True, False):
        for path in GOLDEN:
            data = path.read_bytes()
            digest, _ = tab.evaluate(_IN_BROWSER, [base64.b64encode(data).decode(), 0, simd])
            assert digest == judged(data), path.name
        digest, blocks = tab.evaluate(_IN_BROWSER, [base64.b64encode(large.data).decode(), 2, simd])
        assert (digest, blocks) == (judged(large.data), 1)
    broken = bytearray(large.data)
    broken[-1] ^= 1
    with pytest.raises(Exception, match="is damaged"):
        tab.evaluate(_IN_BROWSER, [base64.b64encode(broken).decode(), 2, True])


@pytest.fixture(scope="module")
def encoded(plush_excerpt: Any, plush_excerpt_cameras: list[Camera], tmp_path_factory: Any) -> Path:
    path: Path = tmp_path_factory.mktemp("page") / "scene.html"
    output = Page(title="<b>Plush</b>", author="Ada")
    potr_cl.encode(plush_excerpt, plush_excerpt_cameras, EncodeOptions(output=output).changed(prune=False)).save(path)
    return path


# Loaders -------------------------------------------------------------------------------------------------------------


def stage_view(camera: Camera) -> tuple[Camera, dict[str, Any]]:
    """A camera of the stage's size with its principal point in the middle, and the same for the engines."""
    focal = camera.fy * HEIGHT / camera.height
    ours = dataclasses.replace(
        camera, width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=WIDTH / 2, cy=HEIGHT / 2, lens=None
    )
    to_world = np.eye(4)
    to_world[:3, :3] = ours.rotation.T @ np.diag([1.0, -1.0, -1.0])
    to_world[:3, 3] = -ours.rotation.T @ ours.translation
    fov = float(np.degrees(2 * np.arctan(HEIGHT / 2 / focal)))
    return ours, {"width": WIDTH, "height": HEIGHT, "fov": fov, "matrix": to_world.T.reshape(-1).tolist()}


# Bounds: all engines have 8 bits of each colour and opacity, and end splats at 1 / 55 (three.js) or so of their opacity
# instead of 1 / 255 of full opacity; Spark and PlayCanvas have half floats besides.
@pytest.mark.parametrize(("engine", "least"), [("three", 30), ("spark", 30), ("playcanvas", 30)])
def test_engines_draw_what_our_renderer_does(
    engine: str, least: float, tab: Any, server: Server, encoded: Path, plush_excerpt_cameras: list[Camera]
) -> None:
    potr = pages.scene_in(encoded.read_bytes())
    server.files["/scene.potr"] = potr
    camera, view = stage_view(plush_excerpt_cameras[0])
    ours = np.clip(potr_cl.render(potr_cl.decode(potr), camera).image, 0, 1)
    on_stage(tab, server)
    tab.evaluate(f"(view) => potr.{engine}('/scene.potr', view)", view)
    check_alike(ours, picture(tab), least)


def with_sky(scene: Scene, view: Camera) -> Scene:
    """With a tenth of it once more, large and far behind it."""
    part = scene.subset(np.arange(0, len(scene), 10))
    away, larger = view.centre + 80 * view.rotation[2], 150.0
    sky = dataclasses.replace(
        part,
        means=(away + larger * (part.means - np.median(part.means, axis=0))).astype(np.float32),
        log_scales=part.log_scales + np.float32(np.log(1.5 * larger)),
    )
    return joined([scene, sky])


@pytest.fixture(scope="module", params=[False, True], ids=["without_sky", "with_sky"])
def streamed(
    request: Any, plush_excerpt: Scene, plush_excerpt_cameras: list[Camera], server: Server, tmp_path_factory: Any
) -> Path:
    """Levels of detail, as streamed SOG, whose environment is the sky; in the browser below their folder's name."""
    path: Path = tmp_path_factory.mktemp("streamed") / "lod-meta.json"
    scene = with_sky(plush_excerpt, plush_excerpt_cameras[0]) if request.param else plush_excerpt
    potr_cl.encode(
        scene, plush_excerpt_cameras, output=path, levels=3, lod_chunk_count=1, iterations=2, refit=2, views_between=0
    )
    assert (path.parent / "env").exists() is request.param
    for file in filter(Path.is_file, path.parent.rglob("*")):
        server.files[f"/{file.relative_to(path.parents[1])}"] = file.read_bytes()
    return path


def url_of(streamed: Path) -> str:
    return f"/{streamed.parent.name}/{streamed.name}"


def splats_of(streamed: Path, level: int) -> int:
    """Of a level and the environment, as the descriptions say."""
    around = streamed.parent / "env" / "meta.json"
    counts = json.loads(streamed.read_text())["counts"]
    return int(counts[level] + (json.loads(around.read_text())["count"] if around.exists() else 0))


@contextmanager
def without_complaints(tab: Any) -> Iterator[None]:
    """Of a block in which pages complain of nothing."""
    said: list[str] = []

    def on_console(message: Any) -> None:
        of_browser = "GPU stall" in message.text or message.location["url"].endswith("/favicon.ico")
        if message.type in ("warning", "error") and not of_browser:
            said.append(f"{message.text} ({message.location['url']})")

    tab.on("console", on_console)
    tab.on("pageerror", lambda error: said.append(str(error)))
    yield
    tab.remove_listener("console", on_console)
    assert said == []


def check_playcanvas_streams(streamed: Path, level: int, looking: Camera, tab: Any, server: Server) -> None:
    camera, view = stage_view(looking)
    scene = potr_cl.load_scene(f"{streamed}#{level}")
    with without_complaints(tab):
        on_stage(tab, server)
        budget = 10**6 if level == 0 else 1
        shown = tab.evaluate("(given) => potr.streamed(...given)", [url_of(streamed), view, budget])
    assert shown == len(scene) == splats_of(streamed, level)
    check_alike(np.clip(potr_cl.render(scene, camera).image, 0, 1), picture(tab), 30)


@pytest.mark.parametrize("level", [0, 2])
def test_playcanvas_streams_levels_of_detail(
    level: int, tab: Any, server: Server, streamed: Path, plush_excerpt_cameras: list[Camera]
) -> None:
    check_playcanvas_streams(streamed, level, plush_excerpt_cameras[0], tab, server)


@pytest.mark.parametrize("streamed", [True], indirect=True, ids=["with_sky"])
def test_playcanvas_shows_the_sky_where_it_sees_nothing_else(
    tab: Any, server: Server, streamed: Path, plush_excerpt: Scene, plush_excerpt_cameras: list[Camera]
) -> None:
    first, a = plush_excerpt_cameras[0], np.radians(14)
    aside = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]) @ first.rotation
    camera = dataclasses.replace(first, rotation=aside, translation=-aside @ first.centre)
    assert not potr_cl.render(plush_excerpt, stage_view(camera)[0]).image.any()
    check_playcanvas_streams(streamed, 0, camera, tab, server)


@pytest.mark.skipif(
    not (WEB / "node_modules" / "@playcanvas" / "supersplat-viewer").exists(),
    reason="SuperSplat's viewer is not installed: npm ci in web/",
)
def test_supersplat_streams_levels_of_detail(tab: Any, server: Server, streamed: Path) -> None:
    """It turns scenes by 180 degrees about z, and its field of view is that of the longer side."""
    scene, turned = potr_cl.load_scene(f"{streamed}#0"), np.diag([-1.0, -1.0, 1.0])
    target = np.median(scene.means, axis=0).astype(np.float64) @ turned
    view = {"position": (target + np.array([0.1, 0.15, -0.6])).tolist(), "target": target.tolist(), "fov": 50}
    with without_complaints(tab):
        on_stage(tab, server)
        found = tab.evaluate("(given) => potr.supersplat(...given)", [url_of(streamed), view, 1])
    assert found["splats"] == len(scene) == splats_of(streamed, 0)
    to_world = np.array(found["matrix"]).reshape(4, 4).T
    rotation, centre = np.diag([1.0, -1.0, -1.0]) @ to_world[:3, :3].T @ turned, turned @ to_world[:3, 3]
    focal = WIDTH / 2 / np.tan(np.radians(found["fov"] / 2))
    camera = Camera("viewer", WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, rotation, -rotation @ centre)
    check_alike(np.clip(potr_cl.render(scene, camera).image, 0, 1), picture(tab), 28)


def view_of(scene: Any) -> dict[str, Any]:
    """All of a scene, from in front of it."""
    middle, reach = np.median(scene.means, axis=0), float(np.ptp(scene.means, axis=0).max())
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = middle - [0, 0, 2 * reach]
    return {"width": WIDTH, "height": HEIGHT, "fov": 50, "matrix": matrix.T.reshape(-1).tolist()}


def test_a_block_is_on_screen_before_the_file_has_arrived(tab: Any, server: Server) -> None:
    scene = potr_cl.decode(server.files["/golden_blocks.potr"])
    on_stage(tab, server)
    server.rest.clear()
    tab.evaluate("(view) => potr.blocks('/slow/golden_blocks.potr', view)", view_of(scene))
    part = picture(tab)
    assert part.max() > 0.2, "nothing is drawn"
    assert tab.evaluate("potr.arrived") is None
    server.rest.set()
    tab.evaluate("potr.all")
    assert tab.evaluate("potr.arrived") is True
    tab.evaluate("() => new Promise((done) => setTimeout(done, 300))")
    assert not np.array_equal(picture(tab), part), "the other blocks are not drawn"


def test_a_load_that_is_given_up(tab: Any, server: Server) -> None:
    scene = potr_cl.decode(server.files["/golden_blocks.potr"])
    on_stage(tab, server)
    server.rest.clear()
    tab.evaluate("(view) => potr.blocks('/slow/golden_blocks.potr', view)", view_of(scene))
    tab.evaluate("potr.stop() ?? potr.all")
    assert tab.evaluate("potr.failed") == "AbortError"
    server.rest.set()
    assert server.cut_off.wait(60), "the download goes on"


@pytest.mark.parametrize("engine", ["three", "spark", "playcanvas"])
def test_engines_are_told_what_is_wrong_with_a_file(engine: str, tab: Any, server: Server) -> None:
    broken = bytearray(server.files["/golden_bundles_degree3.potr"])
    broken[-1] ^= 1
    server.files["/broken.potr"] = bytes(broken)
    on_stage(tab, server)
    with pytest.raises(Exception, match="is damaged \\(its checksum does not match\\)"):
        tab.evaluate(f"(view) => potr.{engine}('/broken.potr', view)", view_of(potr_cl.decode(GOLDEN[0].read_bytes())))


# Pages ---------------------------------------------------------------------------------------------------------------


@contextmanager
def shown(browser: Any, path: Path, width: int, height: int, **context: Any) -> Iterator[Any]:
    with browser.new_context(viewport={"width": width, "height": height}, **context) as own:
        tab, asked = own.new_page(), []
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(path.as_uri())
        tab.wait_for_selector("body[data-shown], body[data-failed]", state="attached")
        assert [url for url in asked if url.startswith("http")] == []
        yield tab


def until(tab: Any, expression: str, wanted: Callable[[Any], bool]) -> None:
    """Wait for a value, however slowly this machine draws."""
    for _ in range(600):
        if wanted(tab.evaluate(expression)):
            return
        tab.wait_for_timeout(100)
    raise AssertionError(f"it never came: {expression}")


@pytest.mark.parametrize("size", [(640, 480), (390, 844)], ids=["desktop", "phone"])
def test_a_page_shows_what_our_renderer_does(
    size: tuple[int, int], browser: Any, encoded: Path, plush_excerpt_cameras: list[Camera]
) -> None:
    width, height = size
    with shown(browser, encoded, width, height, has_touch=width < height) as tab:
        assert tab.evaluate("document.body.dataset.failed") is None
        assert tab.title() == "<b>Plush</b>"
        assert tab.inner_text("#words").startswith("<b>Plush</b> · by Ada · 1,500 splats, ")
        matrix = np.array(tab.evaluate("Array.from(potr.camera.matrixWorldInverse.elements)")).reshape(4, 4).T
        tab.evaluate("document.getElementById('words').remove()")
        tab.wait_for_timeout(500)
        theirs = picture(tab)
    first = next(camera for camera in plush_excerpt_cameras if camera.split == "train")
    # The page looks from the first view to the scene's middle, with the principal point in the middle.
    focal = first.fy * height / first.height
    pose = np.diag([1.0, -1.0, -1.0]) @ matrix[:3]
    camera = dataclasses.replace(
        first, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2,
        rotation=pose[:, :3], translation=pose[:, 3], lens=None,
    )  # fmt: skip
    check_alike(np.clip(potr_cl.render(potr_cl.load_scene(encoded), camera).image, 0, 1), theirs, 30)


def test_a_page_turns_and_flies(browser: Any, encoded: Path) -> None:
    place, away = "potr.camera.position.toArray()", "potr.camera.position.distanceTo(potr.controls.target)"
    with shown(browser, encoded, 200, 150) as tab:
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


def test_a_page_says_what_is_wrong_with_its_file(browser: Any, encoded: Path, tmp_path: Path) -> None:
    data = encoded.read_bytes()
    scene = bytearray(pages.scene_in(data))
    scene[-1] ^= 1
    begin = data.index(pages.BEGIN) + len(pages.BEGIN)
    end = data.index(pages.END, begin)
    path = tmp_path / "broken.html"
    path.write_bytes(data[:begin] + base64.b64encode(scene) + data[end:])
    with shown(browser, path, 200, 150) as tab:
        assert "is damaged (its checksum does not match)" in tab.inner_text("#words")
