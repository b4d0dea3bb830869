"""What a tab may ask for: nonsense is passed over unseen, the newest of a kind counts, who floods is disconnected."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from typing import Any

import pytest

import potr_cl
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
    connection = Connection([message] * 20_000)
    taken(connection)
    assert connection.closed == 1008
    assert len(connection.messages) > 15_000


@pytest.fixture
def viewer(plush_excerpt, plush_excerpt_cameras):
    pytest.importorskip("viser", reason="the extra view is not installed")
    with potr_cl.view(plush_excerpt, cameras=plush_excerpt_cameras) as viewer:
        yield viewer


def opened(viewer: Any, protocol: str | None = None) -> Any:
    import viser

    protocol = f"viser-v{viser.__version__}" if protocol is None else protocol
    address = viewer.url.replace("http://", "ws://")
    return client.connect(address, subprotocols=[protocol], max_size=None, compression=None, close_timeout=1)


@pytest.mark.parametrize(
    "change",
    [
        {"position": ESCAPES}, {"position": [ESCAPES] * 3}, {"wxyz": [0.0] * 4}, {"position": [float("nan")] * 3},
        {"fov": 0.0}, {"up_direction": [0.0] * 3}, {"type": ESCAPES}, {"more": ESCAPES}, {"image_width": ESCAPES},
        {"type": "ShareUrlRequest"}, {"position": [1e300] * 3},
    ],
)  # fmt: skip
def test_nothing_that_a_page_sends_is_printed(viewer, capfd, change):
    """Nor does it end the server: an honest message still has its picture made."""
    from msgspec.msgpack import encode

    with opened(viewer) as page:
        page.send(encode(CAMERA | change))
        page.send(encode({"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": ESCAPES, "removed": True}}))
        page.send(ESCAPES)
        page.send(ESCAPES.encode())
        page.send(encode(CAMERA | {"position": [0.0, 0.0, -2.0]}))
        while b"\xff\xd8\xff" not in page.recv(timeout=300):  # a JPEG file
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
