"""Who may connect (:class:`Door`), and what the page consists of beyond viser's own.

A server on localhost is within reach of every page that the user's browser shows: a page of a stranger may open a
WebSocket to it, or have its own name resolved to 127.0.0.1 (DNS rebinding). Browsers say in ``Host`` whom they mean and
in ``Origin`` who asks, so both are checked here, before viser sees the request.

viser starts a server of the library websockets and has no place for a check. :meth:`Door.guarding` therefore wraps the
function that starts it, for as long as viser's server is being made, and refuses to go on if viser has started its
server in another way.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import http
import inspect
import ipaddress
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from potr_cl.errors import PotrError
from potr_cl.viewer.inbox import Sifted

#: Names of this machine for itself.
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
#: Who may show the page within another one: notebooks of this machine. Others could have a user click on what they do
#: not see.
_FRAMES = "frame-ancestors 'self' http://localhost:* http://127.0.0.1:* https://localhost:* vscode-webview:"
_HEADERS = {
    "Content-Security-Policy": _FRAMES,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    # Else any page may read what a GET brings, where a browser lets it.
    "Cross-Origin-Resource-Policy": "same-origin",
}
#: Bytes of a message: parts of files have 1 MiB. Connections at a time: a page has two.
_LARGEST_MESSAGE, _MOST_CONNECTIONS = 4 << 20, 64
_starting = threading.Lock()

logger = logging.getLogger("potr_cl")

#: Takes a WebSocket connection of the page.
Handler = Callable[[Any], Awaitable[None]]


@dataclass(frozen=True)
class Asset:
    """A file of the page.

    Attributes:
        kind: its media type.
        content: its bytes.
    """

    kind: str
    content: bytes


class Door:
    """Lets in who means this server, by one of its names, and keeps out the pages of others.

    Args:
        host: that the server listens on.
        assets: files of the page by path, beyond viser's.
        head: HTML to put into the page's head.
        channels: takers of WebSocket connections by path, beyond viser's.
    """

    def __init__(self, host: str, assets: Mapping[str, Asset], head: str, channels: Mapping[str, Handler]) -> None:
        self._names = _names(host)
        self._any_address = host in ("0.0.0.0", "::", "")
        self._assets = dict(assets)
        self._head = head.encode()
        self._channels = dict(channels)
        self._in_use = False
        self._connections = 0

    def refusal(self, host: str | None, origin: str | None) -> str | None:
        """Why a request is refused; None if it is let in.

        Args:
            host: its header ``Host``.
            origin: its header ``Origin``, which browsers send with every WebSocket and programs do not.
        """
        if host is None:
            return "the request does not say whom it means"
        name, _ = _host_and_port(f"http://{host}")
        if name is None or not self._is_ours(name):
            return "the request means another server: open the page under the address that the viewer has printed"
        if origin is not None:
            scheme = origin.partition("://")[0]
            if scheme not in ("http", "https") or _host_and_port(origin) != _host_and_port(f"{scheme}://{host}"):
                return "the request comes from another page"
        return None

    def _is_ours(self, name: str) -> bool:
        if name in self._names:
            return True
        if not self._any_address:
            return False
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True  # nobody's name leads here without being one
        return False

    @contextlib.contextmanager
    def guarding(self) -> Iterator[None]:
        """Stand before the server that viser starts in this block.

        Raises:
            PotrError: viser has started none in the way that is known here.
        """
        import websockets.asyncio.server as library

        with _starting:
            serve = library.serve

            @functools.wraps(serve)
            def guarded(handler: Handler, *args: Any, process_request: Any = None, **options: Any) -> Any:
                if not getattr(handler, "__module__", "").startswith("viser."):
                    return serve(handler, *args, process_request=process_request, **options)
                self._in_use = True
                options |= {"logger": _unheard(), "max_size": _LARGEST_MESSAGE}
                return serve(self._handler(handler), *args, process_request=self._request(process_request), **options)

            library.serve = guarded
            try:
                yield
            finally:
                library.serve = serve
        if not self._in_use:
            raise PotrError("this version of viser starts its server in an unknown way: install another one")

    def _handler(self, inner: Handler) -> Handler:
        import viser

        async def handler(connection: Any) -> None:
            asyncio.get_running_loop().set_exception_handler(_pass_over)
            path = urlsplit(connection.request.path).path
            if self._connections >= _MOST_CONNECTIONS:
                await connection.close(1013, "too many pages are open")
                return
            self._connections += 1
            try:
                if path in self._channels:
                    await self._channels[path](connection)
                elif connection.subprotocol != f"viser-v{viser.__version__}":
                    # viser would print what the page calls itself.
                    await connection.close(1002, "the page is another version's: load it again")
                else:
                    await inner(Sifted(connection))
            finally:
                self._connections -= 1

        return handler

    def _request(self, inner: Any) -> Callable[[Any, Any], Awaitable[Any]]:
        async def process(connection: Any, request: Any) -> Any:
            host, origin = (_only(request.headers.get_all(name)) for name in ("Host", "Origin"))
            refusal = self.refusal(host, origin)
            if refusal is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {refusal}.\n")
            if request.headers.get("Upgrade", "").lower() == "websocket":
                return None
            path = urlsplit(request.path).path
            if path in self._assets:
                asset = self._assets[path]
                response = connection.respond(http.HTTPStatus.OK, "")
                _fill(response, asset.content, asset.kind)
            else:
                response = inner(connection, request) if inner is not None else None
                if inspect.isawaitable(response):
                    response = await response
                if response is not None and response.status_code == 200 and path in ("", "/", "/index.html"):
                    self._add_head(response)
            if response is not None:
                for name, value in _HEADERS.items():
                    response.headers[name] = value
            return response

        return process

    def _add_head(self, response: Any) -> None:
        packed = response.headers.get("Content-Encoding") == "gzip"
        page = gzip.decompress(response.body) if packed else response.body
        page = page.replace(b"</head>", self._head + b"</head>", 1)
        _fill(response, page, "text/html; charset=utf-8")


def _unheard() -> logging.Logger:
    """A log that nobody reads: websockets writes tracebacks of whatever else than a browser connects."""
    log = logging.getLogger("potr_cl.viewer.connections")
    log.setLevel(logging.CRITICAL + 1)
    return log


def _pass_over(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """In place of a traceback, where viser fails at a message."""
    logger.debug("the page's server: %s", type(context.get("exception")).__name__)


def _fill(response: Any, content: bytes, kind: str) -> None:
    response.body = content
    for name, value in {
        "Content-Type": kind,
        "Content-Length": str(len(content)),
        "Content-Encoding": "identity",
    }.items():
        with contextlib.suppress(KeyError):
            del response.headers[name]
        response.headers[name] = value


def _only(values: list[str]) -> str | None:
    """A header's value; an empty one, which is nobody's, if it is given several times."""
    return None if not values else values[0] if len(values) == 1 else ""


def _names(host: str) -> frozenset[str]:
    """Names under which this machine may be asked for, in lower case."""
    if host in _LOOPBACK:
        return frozenset(_LOOPBACK)
    names = {host.lower()}
    if host in ("0.0.0.0", "::", ""):
        names |= {*_LOOPBACK, socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(names - {""})


def _host_and_port(address: str) -> tuple[str | None, int | None]:
    """Of an address; (None, None) for what is none."""
    try:
        parts = urlsplit(address)
        port = parts.port or {"http": 80, "https": 443}.get(parts.scheme)
        return parts.hostname, port
    except ValueError:
        return None, None
