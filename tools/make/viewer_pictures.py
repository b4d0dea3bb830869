"""Make docs/images/viewer_*.jpg, the pictures of the viewer in README and docs/viewer.md, from the real page.

    python -m tools.make.viewer_pictures SCENES [--ladder FOLDER]

SCENES holds the folder ``plush`` with point_cloud.ply, cameras.json and images: of our scenes the one whose photographs
are under a free licence. Its ladder is encoded first, unless FOLDER has it. Chromium of the system is driven by
Playwright (the extra ``browser``); POTR_CL_CHROMIUM names it where it has another name.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

import potr_cl

_IMAGES = Path(__file__).parents[2] / "docs" / "images"
_WIDTH, _HEIGHT = 1280, 800
_QUALITIES = "0.05,0.3,0.6,0.95"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder that holds plush")
    parser.add_argument("--ladder", type=Path, help="of plush, encoded already")
    args = parser.parse_args()
    chromium = os.environ.get("POTR_CL_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        sys.exit("there is no chromium: install it, or name it by POTR_CL_CHROMIUM")
    folder = args.scenes / "plush"
    scene, cameras = folder / "point_cloud.ply", folder / "cameras.json"
    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as play:
        ladder = args.ladder or potr_cl.encode_ladder(scene, temporary, _QUALITIES, cameras, tell=print)
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = play.chromium.launch(executable_path=chromium, args=arguments)
        with potr_cl.view(scene, ladder, cameras, truth=folder / "images") as viewer:
            page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
            page.goto(viewer.url)
            _until(lambda: page.locator(".potr-figures b").count() > 0)
            # viser warns of WebGL without a GPU, which users have.
            page.add_style_tag(content=".mantine-Notifications-root { display: none }")
            visitor = viewer.painter.visitors[0]
            _until(lambda: viewer.losses.is_complete, 150)
            for name, keys in (("divider", "1"), ("heat", "6"), ("cameras", "3c")):
                for key in keys:
                    page.keyboard.press(key)
                if name == "cameras":
                    page.mouse.move(300, 400)
                    for _ in range(6):
                        page.mouse.wheel(0, 300)
                        page.wait_for_timeout(200)
                page.wait_for_timeout(2000)
                _until(lambda: visitor.is_still and not visitor.stale_picture)
                page.wait_for_timeout(4000)  # the page fades what it shows in
                _keep(page, name)
        browser.close()


def _keep(page: Any, name: str) -> None:
    path = _IMAGES / f"viewer_{name}.jpg"
    with Image.open(io.BytesIO(page.screenshot())) as image:
        image.convert("RGB").save(path, quality=85, optimize=True)
    print(f"{path}: {path.stat().st_size} bytes")


def _until(condition: Callable[[], bool], seconds: float = 900) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            sys.exit("the page does not show what it should")
        time.sleep(0.1)


if __name__ == "__main__":
    main()
