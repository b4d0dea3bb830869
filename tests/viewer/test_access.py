"""Who may connect to the page, and who is refused."""

from __future__ import annotations

import http.client
import socket
import sys
from typing import Any

import pytest

import potr_cl
from potr_cl.viewer.access import Door

pytestmark = pytest.mark.one_runtime


@pytest.mark.parametrize(
    ("listens", "host", "origin", "lets_in"),
    [
        ("127.0.0.1", "127.0.0.1:8080", None, True),
        ("127.0.0.1", "localhost:8080", "http://localhost:8080", True),
        ("127.0.0.1", "LocalHost:8080", "http://localhost:8080", True),
        ("127.0.0.1", "localhost", "http://localhost", True),
        ("127.0.0.1", "[::1]:8080", "http://[::1]:8080", True),
        ("127.0.0.1", "evil.example:8080", None, False),
        ("127.0.0.1", "localhost.evil.example:8080", None, False),
        ("127.0.0.1", "192.168.0.7:8080", None, False),
        ("127.0.0.1", None, None, False),
        ("127.0.0.1", "", None, False),
        ("127.0.0.1", "localhost:port", None, False),
        ("127.0.0.1", "localhost:8080", "http://evil.example", False),
        ("127.0.0.1", "localhost:8080", "http://localhost:9999", False),
        ("127.0.0.1", "localhost:8080", "http://127.0.0.1:8080", False),
        ("127.0.0.1", "localhost:8080", "null", False),
        ("127.0.0.1", "localhost:8080", "file://localhost:8080", False),
        ("0.0.0.0", "192.168.0.7:8080", "http://192.168.0.7:8080", True),
        ("0.0.0.0", f"{socket.gethostname()}:8080", None, True),
        ("0.0.0.0", "evil.example:8080", None, False),
        ("192.168.0.7", "192.168.0.7:8080", None, True),
        ("192.168.0.7", "127.0.0.1:8080", None, False),
        ("box.local", "box.local:8080", "http://box.local:8080", True),
    ],
)
def test_who_is_let_in(listens, host, origin, lets_in):
    refusal = Door(listens, {}, "", {}).refusal(host, origin)
    assert (refusal is None) == lets_in, refusal


def port_of(viewer: Any) -> int:
    return int(viewer.url.rsplit(":", 1)[1])


def asked(viewer: Any, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(viewer), timeout=120)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()


def test_the_page_is_served_with_what_is_ours(viewer):
    status, headers, body = asked(viewer)
    assert status == 200
    assert b"/potr_cl/page.js" in body
    assert "frame-ancestors" in headers["content-security-policy"]
    assert int(headers["content-length"]) == len(body)
    for name, kind in (("page.js", "text/javascript"), ("page.css", "text/css")):
        status, headers, body = asked(viewer, f"/potr_cl/{name}")
        assert status == 200
        assert headers["content-type"].startswith(kind)
        assert len(body) > 500
        assert b"$" not in body.split(b"accent")[0][:200]


def test_requests_from_elsewhere_are_refused(viewer):
    for path in ("/", "/potr_cl/page.js", "/potr_cl/channel?key=x"):
        assert asked(viewer, path, Host="evil.example")[0] == 403
        assert asked(viewer, path, Origin="http://evil.example")[0] == 403
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    for path in ("/", "/potr_cl/channel?key=x"):
        status, _, said = asked(viewer, path, Origin="http://evil.example", **upgrade)
        assert status == 403
        assert b"another page" in said
    assert asked(viewer, Host=f"localhost:{port_of(viewer)}")[0] == 200


def test_no_file_beside_the_page_is_served(viewer):
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/setup.py", "/potr_cl/../page.py", "/potr_cl/page.py"):
        assert asked(viewer, path)[0] == 404


def test_it_listens_on_this_machine_alone(viewer):
    """No other address of the machine answers under the port."""
    found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    # 127.0.0.2 is this machine too, on Linux, and not what the server listens on.
    address = next((each[4][0] for each in found if each[4][0][:4] != "127."), "127.0.0.2")
    with pytest.raises(OSError, match=r".+"):
        socket.create_connection((address, port_of(viewer)), timeout=2).close()


def test_an_unknown_tab_has_no_channel(viewer):
    client = pytest.importorskip("websockets.sync.client")
    address = f"ws://127.0.0.1:{port_of(viewer)}/potr_cl/channel?key=guessed"
    with client.connect(address) as connection, pytest.raises(Exception, match="no such tab"):
        connection.recv(timeout=120)


def test_a_taken_port_is_told(viewer, data):
    with pytest.raises(potr_cl.UsageError, match=f"--port {port_of(viewer)} is taken"):
        potr_cl.view(data / "plush_excerpt.ply", port=port_of(viewer))


@pytest.mark.parametrize(("choice", "said"), [({"port": 70000}, "between 0 and"), ({"host": "no.such.host"}, "--host")])
def test_wrong_addresses_are_told(data, choice, said):
    pytest.importorskip("viser")
    with pytest.raises(potr_cl.UsageError, match=said):
        potr_cl.view(data / "plush_excerpt.ply", **choice)


def test_a_server_that_starts_otherwise_is_not_trusted():
    """viser might begin to start its server in another way: then nothing would stand before it."""
    with pytest.raises(potr_cl.PotrError, match="unknown way"), Door("127.0.0.1", {}, "", {}).guarding():
        pass


def test_without_viser_the_command_that_installs_it_is_told(monkeypatch, data):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(potr_cl.UsageError, match=r"needs viser: pip install .*vi"):
        potr_cl.view(data / "plush_excerpt.ply")
