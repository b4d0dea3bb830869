"""The page finds its tab by a key, however soon it asks and however long the tab takes to be made."""

from __future__ import annotations

import json
import re
import threading
from typing import Any

import pytest

import potr_cl

pytestmark = pytest.mark.one_runtime


def test_a_page_that_asks_at_once_finds_its_tab(plush_excerpt, plush_excerpt_cameras, monkeypatch):
    viser = pytest.importorskip("viser", reason="the extra view is not installed")
    msgspec, client = pytest.importorskip("msgspec"), pytest.importorskip("websockets.sync.client")
    add_html, heard, asked = viser.GuiApi.add_html, [], threading.Event()

    def asking_at_once(gui: Any, content: str, **choices: Any) -> Any:
        made = add_html(gui, content, **choices)
        if found := re.search(r'data-potr-key="([\w-]+)"', content):
            try:
                with client.connect(f"{address}/potr_cl/channel?key={found[1]}") as channel:
                    heard.append(json.loads(channel.recv(timeout=300)))
            except Exception as error:
                heard.append(error)
            asked.set()
        return made

    monkeypatch.setattr(viser.GuiApi, "add_html", asking_at_once)
    camera: dict[str, Any] = {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "fov": 1.0, "near": 0.01, "far": 1000.0,
        "image_height": 24, "image_width": 32, "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, -1.0, 0.0],
        "position": [0.0, 0.0, -3.0],
    }  # fmt: skip
    with potr_cl.view(plush_excerpt, cameras=plush_excerpt_cameras) as viewer:
        address = viewer.url.replace("http://", "ws://")
        with client.connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as page:
            page.send(msgspec.msgpack.encode(camera))  # viser counts a page from then on
            assert asked.wait(300)
    (said,) = heard
    assert isinstance(said, dict), said
    assert "scenes" in said["state"]
