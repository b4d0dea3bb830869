"""What a tab may ask for, how soon it is answered, and what becomes of nonsense and of those who flood."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import threading
import time
from typing import Any

import pytest

from potr_cl.viewer.inbox import Inbox, said_by_page

pytestmark = pytest.mark.one_runtime

client = pytest.importorskip("websockets.sync.client", reason="the extra view is not installed")
exceptions = pytest.importorskip("websockets.exceptions")
ESCAPES = "\x1b]0;title\x07\x1b[2Jpassword: "
CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "fov": 1.0, "near": 0.01, "far": 1000.0,
    "image_height": 24, "image_width": 32, "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, -1.0, 0.0],
    "position": [0.0, 0.0, -3.0],
}  # fmt: skip
#: How a JPEG file begins.
JPEG = b"\xff\xd8\xff"


class Connection:
    """Has messages at once, one after the other, until it is closed."""

    def __init__(self, messages: list[str | bytes]) -> None:
        self.messages = messages
        self.closed: int | None = None

    async def recv(self) -> str | bytes:
        if not self.messages or self.closed is not None:
            raise exceptions.ConnectionClosedOK(None, None)
        return self.messages.pop(0)

    async def close(self, code: int, _reason: str) -> None:
        self.closed = code


def taken(connection: Connection) -> list[Any]:
    async def take() -> list[Any]:
        inbox, found = Inbox(connection, said_by_page), []
        try:
            while True:
                found.append(await inbox.next())
        except exceptions.ConnectionClosed:
            return found

    return asyncio.run(take())


def test_of_what_waits_the_newest_of_a_kind_counts():
    messages = [json.dumps({"fly": n}) for n in range(1000)] + ['{"swap": true}', '{"fly": 7}']
    found = taken(Connection(messages))
    assert found[-2:] == [{"swap": True}, {"fly": 7}]
    assert len(found) < 200


@pytest.mark.parametrize("message", ['{"fly": 1}', "nonsense", b"x" * 9000, b""])
def test_who_floods_is_disconnected(message):
    connection = Connection([message] * 4000)
    taken(connection)
    assert connection.closed == 1008
    assert len(connection.messages) > 1000


def opened(viewer: Any, protocol: str | None = None) -> Any:
    import viser

    protocol = f"viser-v{viser.__version__}" if protocol is None else protocol
    address = viewer.url.replace("http://", "ws://")
    return client.connect(address, subprotocols=[protocol], max_size=None, compression=None, close_timeout=1)


def packed(message: dict[str, Any]) -> bytes:
    return pytest.importorskip("msgspec.msgpack").encode(message)


def told(**changes: Any) -> bytes:
    """The page's camera, as viser's page tells it."""
    return packed(CAMERA | changes)


NONSENSE = [
    {"position": ESCAPES}, {"position": [ESCAPES] * 3}, {"wxyz": [0.0] * 4}, {"position": [float("nan")] * 3},
    {"fov": 0.0}, {"up_direction": [0.0] * 3}, {"type": ESCAPES}, {"more": ESCAPES}, {"image_width": ESCAPES},
    {"type": "ShareUrlRequest"}, {"position": [1e300] * 3},
]  # fmt: skip


def test_nothing_that_a_page_sends_is_printed(viewer, capfd):
    """Nor does it end the server: an honest message still has its picture made."""
    with opened(viewer) as page:
        for change in NONSENSE:
            page.send(told(**change))
            time.sleep(0.02)  # or only the newest counts
        page.send(packed({"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": ESCAPES, "removed": True}}))
        page.send(ESCAPES)
        page.send(ESCAPES.encode())
        page.send(told(position=[0.0, 0.0, -2.0]))
        while JPEG not in page.recv(timeout=300):
            pass
    assert capfd.readouterr() == ("", "")


def test_what_is_no_browser_leaves_no_traceback(viewer, capfd):
    port = int(viewer.url.rsplit(":", 1)[1])
    for said in (b"\x16\x03\x01\x02", b"SSH-2.0-x\r\n", b"GET /\0 HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
            connection.sendall(said)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1000):
                pass
    with pytest.raises(exceptions.ConnectionClosed), opened(viewer, "viser-v0-liar") as page:
        page.recv(timeout=60)
    time.sleep(0.1)
    assert capfd.readouterr() == ("", "")


def test_only_so_many_connections_are_taken(viewer, monkeypatch):
    monkeypatch.setattr("potr_cl.viewer.access._MOST_CONNECTIONS", 1)
    with opened(viewer) as first:
        first.recv(timeout=60)
        with pytest.raises(exceptions.ConnectionClosed, match="too many pages"), opened(viewer) as second:
            second.recv(timeout=60)


def test_a_page_that_asks_at_once_finds_its_tab(viewer, monkeypatch):
    """By its key, however long the tab takes to be made."""
    import viser

    add_html, heard, asked = viser.GuiApi.add_html, [], threading.Event()

    def asking_at_once(gui: Any, content: str, **choices: Any) -> Any:
        made = add_html(gui, content, **choices)
        if found := re.search(r'data-potr-key="([\w-]+)"', content):
            try:
                with client.connect(f"{viewer.url.replace('http', 'ws')}/potr_cl/channel?key={found[1]}") as channel:
                    heard.append(json.loads(channel.recv(timeout=300)))
            except Exception as error:
                heard.append(error)
            asked.set()
        return made

    monkeypatch.setattr(viser.GuiApi, "add_html", asking_at_once)
    with opened(viewer) as page:
        page.send(told())  # viser counts a page from then on
        assert asked.wait(300)
    (said,) = heard
    assert isinstance(said, dict), said
    assert "scenes" in said["state"]


def test_a_picture_does_not_wait_for_others(viewer, monkeypatch):
    """viser gathers messages for a sixtieth of a second; here for so long that who waits for it comes too late."""
    buffer = pytest.importorskip("viser.infra._async_message_buffer").AsyncMessageBuffer
    made, delayed, arrived, waits = buffer.__init__, [], [], []

    def patient(self: Any, *args: Any, **options: Any) -> None:
        made(self, *args, **options)
        assert self.window_duration_sec < 1
        self.window_duration_sec = 30.0
        delayed.append(self)

    monkeypatch.setattr(buffer, "__init__", patient)

    def receive(page: Any) -> None:
        with contextlib.suppress(Exception):  # the connection ends with the test
            arrived.extend(time.monotonic() for message in page if JPEG in message)

    with opened(viewer) as page:
        thread = threading.Thread(target=receive, args=(page,), daemon=True)
        thread.start()
        for step in range(5):
            began, known = time.monotonic(), len(arrived)
            page.send(told(position=[0.1 * step, 0.0, -3.0]))
            while len(arrived) == known and time.monotonic() < began + 100:
                time.sleep(0.01)
            waits.append(time.monotonic() - began)
            # The first may come in the middle of a gathering; on a busy machine viser misses a word now and then.
            if step and waits[-1] < 15:
                break
    thread.join(60)
    assert delayed
    assert arrived
    assert min(waits[1:]) < 15, "each picture waits for 30 s"
