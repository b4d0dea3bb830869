"""How soon a picture is on its way."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import pytest

import potr_cl

pytestmark = pytest.mark.one_runtime


def test_a_picture_does_not_wait_for_others(plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """viser gathers messages for a sixtieth of a second; here for so long that who waits for it comes too late."""
    viser = pytest.importorskip("viser", reason="the extra view is not installed")
    msgspec, client = pytest.importorskip("msgspec"), pytest.importorskip("websockets.sync.client")
    buffer = pytest.importorskip("viser.infra._async_message_buffer").AsyncMessageBuffer
    made = buffer.__init__

    def patient(self: Any, *args: Any, **options: Any) -> None:
        made(self, *args, **options)
        assert self.window_duration_sec < 1
        self.window_duration_sec = 30.0

    monkeypatch.setattr(buffer, "__init__", patient)
    arrived: list[float] = []

    def receive(socket: Any) -> None:
        with contextlib.suppress(Exception):  # the connection ends with the test
            for message in socket:
                if b"\xff\xd8\xff" in message:  # a JPEG file
                    arrived.append(time.monotonic())

    camera: dict[str, Any] = {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "fov": 1.0, "near": 0.01, "far": 1000.0,
        "image_height": 24, "image_width": 32, "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, -1.0, 0.0],
    }  # fmt: skip
    with potr_cl.view(plush_excerpt, cameras=plush_excerpt_cameras) as viewer:
        address = viewer.url.replace("http://", "ws://")
        protocols = [f"viser-v{viser.__version__}"]
        with client.connect(address, subprotocols=protocols, max_size=None, compression=None) as socket:
            thread = threading.Thread(target=receive, args=(socket,), daemon=True)
            thread.start()
            waits: list[float] = []
            for step in range(5):
                began, known = time.monotonic(), len(arrived)
                socket.send(msgspec.msgpack.encode({**camera, "position": [0.1 * step, 0.0, -3.0]}))
                while len(arrived) == known and time.monotonic() < began + 100:
                    time.sleep(0.01)
                waits.append(time.monotonic() - began)
                # The first may come in the middle of a gathering; on a busy machine viser misses a word now and then.
                if step and waits[-1] < 15:
                    break
        thread.join(60)
    assert arrived
    assert min(waits[1:]) < 15, "each picture waits for 30 s"
