"""What the page says and is told beyond viser (:class:`Channel`): the divider, the flicker key, clicks on the list of
views, dropped files.

A connection is a tab's second one. It names the tab by a key that viser's page of that tab was given, and speaks JSON:

- from the page: ``{"divider": 0.4}``, ``{"swap": true}``, ``{"fly": 3}``, ``{"rung": 2, "asked": 5}`` (the fifth time),
  ``{"mode": "heat map"}``, ``{"cameras": true}`` to show or hide them, and ``{"file": {"name", "size", "as"}}``, after
  which the file follows as binary messages; ``{"scene": 7}`` asks for a scene to draw, and ``{"draws": true}`` says
  that the page draws what is to be seen, and needs no pictures;
- to the page: ``{"state": {…}}``, ``{"upload": {…}}``, and ``{"scene": {"number", "bytes"}}``, after which the file
  follows as binary messages.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from concurrent.futures import Executor
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from potr_cl.errors import PotrError
from potr_cl.plain_text import plain
from potr_cl.viewer.inbox import Inbox, said_by_page
from potr_cl.viewer.session import Which
from potr_cl.viewer.uploads import Upload

if TYPE_CHECKING:
    from potr_cl.viewer.tab import TabHandle

#: Bytes after which the page is told how much has come.
_TOLD_EVERY = 4 << 20
#: Bytes of a scene that are sent at a time.
_PART = 1 << 20
#: Seconds without a part of a file after which it is given up: others wait for its place.
_SILENCE = 60.0
#: Files that may be on their way at a time, of all tabs.
_MOST_UPLOADS = 2


class Channel:
    """Takes the page's connections.

    Args:
        find: the tab of a key.
        readers: threads that read dropped files.
        antialiased: as of :func:`potr_cl.load_scene`.
    """

    def __init__(self, find: Callable[[str], TabHandle | None], readers: Executor, antialiased: bool | None) -> None:
        self._find = find
        self._readers = readers
        self._antialiased = antialiased
        self._uploads = 0

    async def serve(self, connection: Any) -> None:
        """Serve one connection until it is closed."""
        key = parse_qs(urlsplit(connection.request.path).query).get("key", [""])[0]
        tab = self._find(key)
        if tab is None:
            await connection.close(1008, "no such tab")
            return
        loop, mail = asyncio.get_running_loop(), _Mail()

        def send(message: dict[str, Any]) -> None:
            with contextlib.suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(mail.put, message)

        async def deliver() -> None:
            while True:
                await connection.send(json.dumps(await mail.take()))

        tasks, inbox = [asyncio.ensure_future(deliver())], Inbox(connection, said_by_page)
        try:
            tab.connected(send)
            while True:
                content = await inbox.next()
                if "scene" in content and (len(tasks) < 2 or tasks[-1].done()):  # the page asks for one at a time
                    tasks[1:] = [asyncio.ensure_future(_give(connection, tab, content["scene"]))]
                if "file" in content:
                    await self._receive(inbox, tab, content["file"], mail.put)
                else:
                    _obey(tab, content)
        except Exception as error:
            if type(error).__module__.split(".")[0] != "websockets":  # it has been closed: nothing is wrong
                raise
        finally:
            for task in tasks:
                task.cancel()

    async def _receive(
        self, inbox: Inbox, tab: TabHandle, announced: dict[str, Any], put: Callable[[dict[str, Any]], None]
    ) -> None:
        which: Which = "A" if announced.get("as") == "A" else "B"
        if self._uploads >= _MOST_UPLOADS:
            put({"upload": {"error": "other files are on their way: wait until they are there"}})
            return
        self._uploads += 1
        try:
            with Upload(announced.get("name"), announced.get("size")) as upload:
                put({"upload": {"ready": True}})
                told = 0
                while not upload.is_complete:
                    part = await asyncio.wait_for(inbox.next(part_of_file=True), _SILENCE)
                    if isinstance(part, dict):
                        if "cancel" in part:
                            put({"upload": {"error": f"'{upload.name}' was cancelled"}})
                            return
                        _obey(tab, part)
                        continue
                    upload.take(part)
                    if upload.received - told >= _TOLD_EVERY:
                        told = upload.received
                        put({"upload": {"name": upload.name, "received": told, "size": upload.size}})
                put({"upload": {"reading": upload.name}})
                loop = asyncio.get_running_loop()
                exhibit = await loop.run_in_executor(self._readers, upload.read, self._antialiased)
            tab.dropped(which, exhibit)
            put({"upload": {"shown": f"{exhibit.name} is {which}"}})
        except PotrError as error:
            put({"upload": {"error": plain(error)}})
        except MemoryError:
            put({"upload": {"error": "not enough memory for this scene"}})
        except (asyncio.TimeoutError, TimeoutError):
            put({"upload": {"error": "the file has stopped coming: drop it again"}})
        finally:
            self._uploads -= 1


async def _give(connection: Any, tab: TabHandle, number: int) -> None:
    """Send a scene for the page to draw."""
    try:
        data = await asyncio.to_thread(tab.file, number)
    except (PotrError, OSError, MemoryError) as error:
        said = plain(error) if isinstance(error, PotrError) else "its file cannot be read again"
        await connection.send(json.dumps({"scene": {"number": number, "error": said}}))
        return
    await connection.send(json.dumps({"scene": {"number": number, "bytes": len(data)}}))
    for at in range(0, len(data), _PART):
        await connection.send(data[at : at + _PART])


class _Mail:
    """What the page has not been told yet; what is out of date by then it is never told."""

    def __init__(self) -> None:
        self._waiting: dict[str, dict[str, Any]] = {}
        self._some = asyncio.Event()

    def put(self, message: dict[str, dict[str, Any]]) -> None:
        for kind, content in message.items():
            self._waiting[kind] = {**self._waiting.get(kind, {}), **content} if kind == "state" else content
        self._some.set()

    async def take(self) -> dict[str, dict[str, Any]]:
        await self._some.wait()
        self._some.clear()
        taken, self._waiting = self._waiting, {}
        return taken


def _obey(tab: TabHandle, content: dict[str, Any]) -> None:
    if "divider" in content:
        tab.divide(min(max(float(content["divider"]), 0.0), 1.0))
    acts: tuple[tuple[str, Callable[[Any], None]], ...] = (
        ("swap", tab.swap),
        ("mode", tab.choose_mode),
        ("fly", tab.fly),
        ("draws", tab.draw),
        ("rung", tab.climb),
        ("asked", tab.acknowledge),
    )
    for name, act in acts:
        if name in content:
            act(content[name])
    if "cameras" in content:
        tab.toggle_cameras()
