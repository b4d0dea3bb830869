"""Files that are dropped on the page, and the other things that it says."""

from __future__ import annotations

import asyncio
import json
import os
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest

import potr_cl
from potr_cl.viewer import uploads
from potr_cl.viewer.channel import Channel
from potr_cl.viewer.uploads import MOST_BYTES, Upload

ConnectionClosedOK = pytest.importorskip("websockets.exceptions").ConnectionClosedOK

pytestmark = pytest.mark.one_runtime


class Tab:
    """Notes what it is told."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, Any]] = []
        self.exhibits: list[tuple[str, Any]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda value: self.heard.append((name, value))

    def connected(self, send: Any) -> None:
        send({"state": {"a": 1}})
        send({"state": {"b": 2}})

    def dropped(self, which: str, exhibit: Any) -> None:
        self.exhibits.append((which, exhibit))


class Connection:
    """What a page sends, one message after the other; then it is closed, once all answers are there."""

    def __init__(self, messages: list[str | bytes], key: str = "right") -> None:
        self.request = type("Request", (), {"path": f"/potr_cl/channel?key={key}"})
        self.messages = messages
        self.sent: list[dict[str, Any]] = []
        self.closed: int | None = None

    async def send(self, message: str | bytes) -> None:
        self.sent.append({"part": message} if isinstance(message, bytes) else json.loads(message))

    async def close(self, code: int, _reason: str) -> None:
        self.closed = code

    async def recv(self) -> str | bytes:
        await asyncio.sleep(0.02)  # longer than between two messages that are acted on
        if not self.messages or self.closed is not None:
            raise ConnectionClosedOK(None, None)
        return self.messages.pop(0)


def spoken(messages: list[Any], key: str = "right") -> tuple[Tab, Connection]:
    tab, connection = Tab(), Connection([m if isinstance(m, (bytes, str)) else json.dumps(m) for m in messages], key)
    with ThreadPoolExecutor(1) as readers:
        channel = Channel(lambda given: tab if given == "right" else None, readers, None)
        asyncio.run(channel.serve(connection))
    return tab, connection


def uploads_told(connection: Connection) -> list[dict[str, Any]]:
    return [message["upload"] for message in connection.sent if "upload" in message]


def refused(name: Any, size: Any, *parts: bytes | dict[str, bool]) -> str:
    """Why a file is; what is said afterwards is heard."""
    tab, connection = spoken([{"file": {"name": name, "size": size}}, *parts, {"fly": 1}])
    assert not tab.exhibits
    assert tab.heard == [("fly", 1)]
    return uploads_told(connection)[-1]["error"]


def test_what_the_page_says_is_obeyed() -> None:
    tab, connection = spoken(
        [{"divider": 0.25}, {"divider": 7}, {"swap": True}, {"fly": 3}, {"rung": 1, "asked": 4}, {"mode": "heat map"}]
    )
    assert tab.heard == [
        ("divide", 0.25), ("divide", 1.0), ("swap", True), ("fly", 3), ("climb", 1), ("acknowledge", 4),
        ("choose_mode", "heat map")
    ]  # fmt: skip
    assert connection.sent[0] == {"state": {"a": 1, "b": 2}}, "what waits is told at once"


NONSENSE = [
    {"divider": "x"}, {"divider": True}, {"divider": float("nan")}, {"swap": 1}, {"fly": True}, {"fly": 1.5}, [], 7,
    None, {"mode": 3}, {"mode": []}, {"divider": 10**400}, {"fly": -(10**400)}, {"divider": 1e999}, {"rung": "1"},
    {"draws": 1}, {"scene": "/etc/passwd"}, {"scene": 1.5}, {"unknown": {}}, {"file": "name"},
]  # fmt: skip


def test_nonsense_is_passed_over() -> None:
    tab, connection = spoken([*NONSENSE, "{", "[" * 20000, b"bytes that nobody waits for", {"fly": 1}])
    assert tab.heard == [("fly", 1)]
    assert connection.closed is None


@pytest.mark.parametrize("file", [b"x" * 3_000_000, potr_cl.UsageError("shown no longer"), OSError("/its/path")])
def test_a_scene_is_given_to_a_page_that_draws(file, monkeypatch) -> None:
    def give(_self: Tab, number: int) -> bytes:
        assert number == 7
        if isinstance(file, Exception):
            raise file
        return file

    monkeypatch.setattr(Tab, "file", give, raising=False)
    tab, connection = spoken([{"scene": 7}, *[{"draws": k % 2 == 0} for k in range(9)]])
    scenes, parts = ([sent[kind] for sent in connection.sent if kind in sent] for kind in ("scene", "part"))
    assert b"".join(parts) == (file if isinstance(file, bytes) else b"")
    told = {"bytes": len(file)} if isinstance(file, bytes) else {"error": scenes[0]["error"]}
    assert scenes == [{"number": 7, **told}]
    assert "/its/path" not in str(scenes)
    assert tab.heard[-1] == ("draw", True)


def test_without_the_key_nothing_is_heard() -> None:
    tab, connection = spoken([{"fly": 1}], key="wrong")
    assert connection.closed == 1008
    assert tab.heard == []


def test_a_dropped_scene_is_read(data) -> None:
    content = (data / "plush_excerpt.ply").read_bytes()
    parts = [content[k : k + 50_000] for k in range(0, len(content), 50_000)]
    assert len(parts) > 5
    announced = {"file": {"name": "x\u202e<b>.PLY", "size": len(content), "as": "A"}}
    tab, connection = spoken([announced, *parts, {"fly": 1}])
    ((which, exhibit),) = tab.exhibits
    assert which == "A"
    assert len(exhibit.scene) == 1500
    assert exhibit.nbytes == len(content)
    assert exhibit.name.isprintable()
    assert uploads_told(connection)[-1] == {"shown": f"{exhibit.name} is A"}
    assert tab.heard == [("fly", 1)], "it goes on afterwards"


@pytest.mark.parametrize(
    ("name", "size", "said"),
    [
        ("scene.ply", MOST_BYTES + 1, "GB: name the file on the command line"),
        ("scene.ply", -1, "how large"),
        ("scene.ply", "7", "how large"),
        ("scene.ply", True, "how large"),
        ("scene.exe", 7, "no scene that is known by its name"),
        ("ply", 7, "no scene that is known by its name"),
        (None, 7, "no scene that is known by its name"),
        (["scene.ply"], 7, "no scene that is known by its name"),
    ],
)
def test_what_is_no_scene_is_refused_before_a_byte_comes(name, size, said) -> None:
    assert said in refused(name, size)


def test_more_bytes_than_announced_are_refused() -> None:
    assert "more bytes" in refused("scene.ply", 10, b"0123456789012")


def test_a_damaged_file_is_told_by_its_own_name_and_leaves_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    error = refused("mine.ply", 7, b"no ply!")
    assert "'mine.ply'" in error
    assert str(tmp_path) not in error
    assert os.listdir(tmp_path) == []


def test_a_cancelled_file_is_forgotten() -> None:
    assert "cancelled" in refused("mine.ply", 7, b"no", {"cancel": True})


@pytest.mark.parametrize("name", ["../../x.ply", "/etc/passwd.ply", "C:\\x.ply", "a/b.spz", ".ply", "x.ply.gz"])
def test_names_lead_nowhere(name, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with Upload(name, 3) as upload:
        upload.take(b"abc")
        files = [path for path in tmp_path.rglob("*") if path.is_file()]
        assert [path.stem.split(".")[0] for path in files] == ["scene"]
        assert upload.is_complete
    assert os.listdir(tmp_path) == []


def test_a_full_disk_is_told() -> None:
    def full(_: bytes) -> None:
        raise OSError(28, "No space left on device")

    with (
        Upload("x.ply", 3) as upload,
        patch.object(upload, "_file", SimpleNamespace(write=full)),
        pytest.raises(potr_cl.UsageError, match="No space left"),
    ):
        upload.take(b"abc")


def test_a_potr_file_may_be_dropped(data) -> None:
    content = min(data.glob("golden_*.potr")).read_bytes()
    tab, _ = spoken([{"file": {"name": "a.potr", "size": len(content), "as": "B"}}, content])
    assert [which for which, _ in tab.exhibits] == ["B"]


def test_the_limit_is_what_the_documentation_says() -> None:
    assert uploads.MOST_BYTES == 2 << 30
