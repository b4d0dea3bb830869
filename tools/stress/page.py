"""Send the viewer's server what no honest page would: to both of a tab's connections, of several tabs at a time.

    python -m tools.stress.page [--count N] [--seed N] [--tabs N] [--json FILE]

A viewer of the bundled excerpt runs in a process of its own; only this machine's loopback is used. Messages are those
of honest pages with parts exchanged, added or left out, among them texts that would act on a terminal, and some are no
messages at all; now and then a tab floods, or something connects that is no browser. Meanwhile an honest tab asks for
one thing after the other. Exits with 1 if the viewer prints anything, ends, leaves the honest tab without an answer or
does not end when it is told to.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from tools.results import Column, Results

_DATA = Path(__file__).parents[2] / "tests" / "data"
_COLUMNS = (
    Column("messages", "", ","),
    Column("tabs closed", "", ","),
    Column("answers to the honest tab"),
    Column("longest wait of it", "s", ".2f"),
    Column("bytes printed"),
)
#: Seconds that the honest tab waits for an answer at most, and that tabs send without a pause.
_PATIENCE, _LIFE = 60.0, 400
_FAREWELL = b"potr-cl: interrupted; no file is left half written\n"
_ESCAPES = "\x1b]0;title\x07\x1b[2J\x1b[Hpassword: "
_CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "fov": 1.0, "near": 0.01, "far": 1000.0,
    "image_height": 24, "image_width": 32, "look_at": [0.0, 0.0, 1.0], "up_direction": [0.0, -1.0, 0.0],
    "position": [0.0, 0.0, -3.0],
}  # fmt: skip
_CLICK: dict[str, Any] = {
    "type": "SceneNodeClickMessage", "name": "/views/0", "instance_index": None, "ray_origin": [0.0, 0.0, 0.0],
    "ray_direction": [0.0, 0.0, 1.0], "screen_pos": [0.5, 0.5], "modifier": None, "owner": "",
}  # fmt: skip
_OURS: list[dict[str, Any]] = [
    {"divider": 0.5}, {"swap": True}, {"swap": False}, {"fly": 1}, {"rung": 0}, {"mode": "heat map"}, {"mode": "A"},
    {"cameras": True}, {"cancel": True}, {"file": {"name": "x.ply", "size": 9, "as": "A"}},
    {"file": {"name": "x.potr", "size": 40, "as": "B"}},
]  # fmt: skip
_OTHER_TYPES = sorted(each.__name__ for each in viser.infra.Message.get_subclasses())


@dataclass
class Count:
    """What has been sent and has happened so far."""

    messages: int = 0
    closed: int = 0
    answers: int = 0
    longest: float = 0.0
    wrong: list[str] = field(default_factory=list)


def hostile_value(rng: Random) -> Any:
    """What stands where something else belongs."""
    return rng.choice(
        [
            _ESCAPES, "", "a" * 70_000, "\ud800", 0, -1, True, None, 10**15, 2**63, -(2**63), 1e308, -0.0, 5e-324,
            float("nan"), float("inf"), [], [[]], {}, {"a": {"b": _ESCAPES}}, [1.0, 2.0, _ESCAPES], [float("nan")] * 4,
            [0.0] * 4, [1e300] * 3, "value", b"bytes",
        ]
    )  # fmt: skip


def changed(rng: Random, message: dict[str, Any], uuids: list[str]) -> dict[str, Any]:
    """A message with some of its parts exchanged, added or left out; one in five stays as it is."""
    made: dict[str, Any] = json.loads(json.dumps(message))
    for _ in range(rng.choice([0, 1, 1, 2, 3])):
        name = rng.choice(list(made) or ["x"])
        match rng.randrange(5):
            case 0:
                made.pop(name, None)
            case 1:
                made[rng.choice(["x", _ESCAPES, "update_cb", "removed", "owner", "uuid"])] = hostile_value(rng)
            case 2 if isinstance(made.get(name), list) and made[name]:
                made[name][rng.randrange(len(made[name]))] = hostile_value(rng)
            case 3:
                made["type"] = rng.choice(_OTHER_TYPES)
            case _:
                made[name] = hostile_value(rng)
    if "uuid" in made and uuids and rng.random() < 0.8:
        made["uuid"] = rng.choice(uuids)
    return made


def viser_message(rng: Random, uuids: list[str]) -> bytes | str:
    """For viser's connection."""
    if rng.random() < 0.05:
        return rng.choice([b"\x91" * 60_000, b"\x81" * 3000, rng.randbytes(200)]) if rng.random() < 0.7 else _ESCAPES
    names = ["value", "value", "value", "visible", "removed", "update_cb", "__class__"]
    value = rng.choice([0.3, 1e9, True, "A", "heat map", "100", _ESCAPES, float("nan"), None, [1]])
    update = {"type": "GuiUpdateMessage", "uuid": "x", "updates": {rng.choice(names): value}}
    made = changed(rng, rng.choice([_CAMERA, _CAMERA, _CLICK, update]), uuids)
    try:
        return bytes(msgspec.msgpack.encode(made))
    except (OverflowError, UnicodeEncodeError):  # MessagePack has no such integer, nor half a character
        return b"\xc1"


def our_message(rng: Random) -> bytes | str:
    """For the channel of our part of the page."""
    match rng.randrange(20):
        case 0:
            return rng.randbytes(rng.choice([0, 1, 9, 40, 5000]))
        case 1:
            digits = "9" * rng.choice([400, 5000])
            return rng.choice(["[" * 20_000, "{", _ESCAPES, f'{{"fly": {digits}}}', f'{{"divider": {digits}}}', "null"])
        case _:
            made = changed(rng, rng.choice(_OURS), [])
            return json.dumps(made, default=repr, ensure_ascii=rng.random() < 0.9).encode("utf-8", "replace").decode()


class Tab:
    """One page, made of its two connections; ``async with``.

    Args:
        address: of the server.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._stack = contextlib.AsyncExitStack()
        self._tasks: list[asyncio.Task[None]] = []
        self.uuids: list[str] = []
        self.heard: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    async def __aenter__(self) -> Tab:
        options: dict[str, Any] = {"max_size": None, "compression": None, "ping_interval": None, "close_timeout": 1}
        protocols: Any = [f"viser-v{viser.__version__}"]
        page = connect(self._address, subprotocols=protocols, open_timeout=_PATIENCE, **options)
        self.page: ClientConnection = await self._stack.enter_async_context(page)
        await self.page.send(msgspec.msgpack.encode(_CAMERA))
        key: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._begin(self._read_page(key))
        place = f"{self._address}/potr_cl/channel?key={await asyncio.wait_for(key, _PATIENCE)}"
        channel = connect(place, open_timeout=_PATIENCE, **options)
        self.channel: ClientConnection = await self._stack.enter_async_context(channel)
        self._begin(self._read_channel())
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        with contextlib.suppress(WebSocketException, OSError, asyncio.TimeoutError):
            await self._stack.aclose()

    async def is_told(self, divider: float) -> None:
        """Wait until the page is told that the divider is there."""
        while (await self.heard.get()).get("state", {}).get("divider") != divider:
            pass

    def _begin(self, work: Any) -> None:
        self._tasks.append(asyncio.ensure_future(work))

    async def _read_page(self, key: asyncio.Future[str]) -> None:
        with contextlib.suppress(WebSocketException, OSError):
            async for raw in self.page:
                assert isinstance(raw, bytes)
                size = int.from_bytes(raw[8:16], "little")
                text = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
                self.uuids += {each.decode() for each in re.findall(rb"uuid\xd9?.([\w-]{32,36})", text)}
                if (found := re.search(rb'data-potr-key="([\w-]+)"', text)) and not key.done():
                    key.set_result(found[1].decode())

    async def _read_channel(self) -> None:
        with contextlib.suppress(WebSocketException, OSError):
            async for raw in self.channel:
                self.heard.put_nowait(json.loads(raw))


async def attack(address: str, rng: Random, count: Count, most: int) -> None:
    """Be one hostile tab after the other."""
    while count.messages < most and not count.wrong:
        try:
            await asyncio.wait_for(be_hostile(address, rng, count), _PATIENCE)
        except (WebSocketException, OSError, asyncio.TimeoutError):
            count.closed += 1
        if rng.random() < 0.1:
            await be_no_browser(address, rng)


async def be_hostile(address: str, rng: Random, count: Count) -> None:
    """Be one tab that sends nonsense; one in twenty floods."""
    async with Tab(address) as tab:
        floods = rng.random() < 0.05
        for _ in range(20_000 if floods else rng.randrange(20, _LIFE)):
            if rng.random() < 0.5:
                await tab.page.send(viser_message(rng, tab.uuids))
            else:
                await tab.channel.send(our_message(rng))
            count.messages += 1
            if not floods:
                await asyncio.sleep(0.001)


async def be_no_browser(address: str, rng: Random) -> None:
    """Connect, and send what is no HTTP, or asks for what viser does not know."""
    host, port = address.removeprefix("ws://").split(":")
    said = rng.choice([b"\x16\x03\x01\x02", b"SSH-2.0-x\r\n", b"GET " + b"/" * 9000, b"GET /\0 HTTP/1.1\r\n\r\n", b""])
    with contextlib.suppress(OSError, asyncio.TimeoutError):
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(said)
        await asyncio.wait_for(reader.read(100), 0.5)
        writer.close()
    with contextlib.suppress(WebSocketException, OSError):
        protocols: Any = ["viser-v0.0.0-liar"]
        async with connect(address, subprotocols=protocols) as page:
            await page.recv()


async def be_honest(address: str, count: Count, over: asyncio.Event) -> None:
    """Ask for one thing after the other, and expect to be told each time that it is so."""
    async with Tab(address) as tab:
        number = 0
        while not over.is_set():
            number += 1
            place, began = (number % 97) / 97, time.monotonic()
            await tab.channel.send(json.dumps({"divider": place}))
            await tab.channel.send(json.dumps({"swap": number % 2 == 1}))
            try:
                await asyncio.wait_for(tab.is_told(place), _PATIENCE)
            except asyncio.TimeoutError:
                count.wrong.append(f"the honest tab has waited {_PATIENCE:.0f} s for its {number}th answer")
                return
            count.answers, count.longest = number, max(count.longest, time.monotonic() - began)
            await asyncio.sleep(0.1)


async def campaign(address: str, seed: int, tabs: int, most: int) -> Count:
    """All tabs at a time, until enough has been sent."""
    count, over = Count(), asyncio.Event()
    honest = asyncio.ensure_future(be_honest(address, count, over))
    await asyncio.gather(*(attack(address, Random(f"{seed}/{number}"), count, most) for number in range(tabs)))
    over.set()
    try:
        await honest
    except (WebSocketException, OSError, asyncio.TimeoutError) as error:
        count.wrong.append(f"the honest tab was closed: {error!r}")
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, metavar="N", help="of messages; default 100000")
    parser.add_argument("--seed", type=int, default=1, help="default 1")
    parser.add_argument("--tabs", type=int, default=6, help="hostile ones at a time; default 6")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep the figures")
    args = parser.parse_args()
    results = Results(None, args.json)
    table = results.table("page", "Messages that no honest page would send", *_COLUMNS)
    scene = _DATA / "plush_excerpt.ply"
    command = [sys.executable, "-m", "potr_cl", "view", str(scene), str(scene), "--cameras",
               str(_DATA / "plush_excerpt_cameras.json"), "--no-browser", "--port", "0"]  # fmt: skip
    with tempfile.TemporaryFile() as printed:
        viewer = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        try:
            content = b""
            while (found := re.search(rb"http://([\d.]+:\d+)[^\n]*\n", content)) is None:
                if viewer.poll() is not None:
                    sys.exit(f"the viewer does not start:\n{content!r}")
                time.sleep(0.1)
                printed.seek(0)
                content = printed.read()
            count = asyncio.run(campaign(f"ws://{found[1].decode()}", args.seed, args.tabs, args.count))
            if viewer.poll() is not None:
                count.wrong.append(f"the viewer has ended with {viewer.returncode}")
            viewer.send_signal(signal.SIGINT)
            try:
                viewer.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                count.wrong.append("the viewer does not end when it is told to")
        finally:
            viewer.kill()
            viewer.wait()
        printed.seek(0)
        more = printed.read()[found.end() :].removeprefix(_FAREWELL)
    if more:
        count.wrong.append(f"the viewer prints {more[:3000]!r}")
    table.add(count.messages, count.closed, count.answers, count.longest, len(more))
    print("\n".join(count.wrong), file=sys.stderr)
    sys.exit(1 if count.wrong else 0)


if __name__ == "__main__":
    main()
