"""What a page sends, before anybody acts on it (:class:`Inbox`): checked, the newest of a kind, so much in a second.

Whoever reaches the server can send what they like. Messages that make no sense are passed over and shown to nobody:
viser would end in tracebacks that print them, with whatever they would have a terminal do. Who sends so many that
others would have to wait is disconnected.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Callable, Hashable
from typing import Any

from potr_cl.viewer.comparison import FACTORS, MODES

#: Seconds between two messages that are acted on; a display shows sixty pictures a second.
_PACE = 0.008
#: Messages that may come at once, and in a second in the long run; so many bytes count as one.
_BURST, _RATE, _BYTES = 2000.0, 500.0, 4096
#: Kinds of messages that wait at a time.
_MOST_WAITING = 64
#: Of a text message of the page.
_LONGEST = 1 << 16

#: A message's kind, of which only the newest matters, and what is handed on.
Sound = tuple[Hashable, Any]


class Inbox:
    """The messages of one connection.

    Args:
        connection: of the library websockets.
        sound: says what a message means; None: nothing, and it is passed over.
    """

    def __init__(self, connection: Any, sound: Callable[[str | bytes], Sound | None]) -> None:
        self._connection = connection
        self._sound = sound
        self._waiting: dict[Hashable, Any] = {}
        self._end: Exception | None = None
        self._due = 0.0
        self._left, self._counted = _BURST, time.monotonic()

    async def next(self, part_of_file: bool = False) -> Any:
        """The next message.

        Args:
            part_of_file: whether a message of bytes is awaited: it comes as it is, in its turn.

        Raises:
            Exception: the library's, when the connection is closed.
        """
        while True:
            pause = self._due - time.monotonic()
            if self._waiting and (pause <= 0 or self._end is not None):
                self._due = time.monotonic() + _PACE
                return self._waiting.pop(next(iter(self._waiting)))
            if self._end is not None:
                raise self._end
            try:
                raw = await asyncio.wait_for(self._connection.recv(), pause if self._waiting else None)
            except (asyncio.TimeoutError, TimeoutError):
                continue
            except Exception as error:
                self._end = error
                continue
            awaited = part_of_file and isinstance(raw, bytes)
            await self._count(1 if awaited and len(raw) >= _BYTES else 1 + len(raw) / _BYTES)
            if awaited:
                return raw
            sound = self._sound(raw)
            if sound is not None:
                kind, message = sound
                self._waiting.pop(kind, None)
                self._waiting[kind] = message
                if len(self._waiting) > _MOST_WAITING:
                    del self._waiting[next(iter(self._waiting))]

    async def _count(self, messages: float) -> None:
        now = time.monotonic()
        self._left = min(self._left + (now - self._counted) * _RATE, _BURST) - messages
        self._counted = now
        if self._left < 0:
            self._waiting.clear()
            await self._connection.close(1008, "too many messages")


def said_by_page(raw: str | bytes) -> Sound | None:
    """What our part of the page says, as :mod:`potr_cl.viewer.channel` has it: what makes sense, by name."""
    if isinstance(raw, bytes) or len(raw) > _LONGEST:
        return None
    try:
        # No float holds an integer of hundreds of digits, and Python reads none of thousands.
        content = json.loads(raw, parse_int=lambda digits: int(digits) if len(digits) < 17 else None)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict):
        return None
    known = {name: value for name, value in content.items() if name in _SAID and _SAID[name](value)}
    return (frozenset(known), known) if known else None


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_place(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


#: What our part of the page may say.
_SAID: dict[str, Callable[[Any], bool]] = {
    "divider": _is_number,
    "swap": lambda value: isinstance(value, bool),
    "mode": lambda value: value in MODES,
    "fly": _is_place,
    "rung": _is_place,
    "asked": _is_place,
    "cameras": lambda value: value is True,
    "draws": lambda value: isinstance(value, bool),
    "scene": _is_place,
    "file": lambda value: isinstance(value, dict),
    "cancel": lambda value: True,
}


class Sifted:
    """A connection that viser reads from: it gets what its part of the page says, and nothing else.

    Args:
        connection: of the library websockets.
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._inbox = Inbox(connection, _said_by_visers_page)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """The next message."""
        message: bytes = await self._inbox.next()
        return message


def _said_by_visers_page(raw: str | bytes) -> Sound | None:
    from msgspec import MsgspecError, msgpack

    if isinstance(raw, str) or len(raw) > _LONGEST:
        return None
    try:
        content = msgpack.decode(raw)
    except (MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    name = content.get("type") if isinstance(content, dict) else None
    fields = _VISERS.get(name) if isinstance(name, str) else None
    if fields is None or content.keys() - fields.keys() - {"type"}:
        return None
    if not all(check(content.get(field)) for field, check in fields.items()):
        return None
    return (name, content.get("uuid")), raw


def _is_vector(length: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and len(value) == length and all(map(_is_coordinate, value))


def _is_coordinate(value: object) -> bool:
    return _is_number(value) and abs(value) < 1e15  # type: ignore[arg-type]


def _is_size(value: object) -> bool:
    return _is_place(value) and 0 <= value <= 1 << 16  # type: ignore[operator]


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= 200


def _is_update(value: object) -> bool:
    """Whether only the value of a part of the panel changes; a handle's other properties are viser's own."""
    if not isinstance(value, dict) or value.keys() != {"value"}:
        return False
    new = value["value"]
    return isinstance(new, bool) or _is_coordinate(new) or (isinstance(new, str) and new in (*MODES, *FACTORS))


#: What viser's part of the page may say: the camera, the panel, a click on a camera.
_VISERS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "ViewerCameraMessage": {
        "wxyz": lambda value: _is_vector(4)(value) and 1e-3 < math.hypot(*value) < 1e3,
        "position": _is_vector(3),
        "fov": lambda value: _is_number(value) and 1e-3 < value < 3.14,
        "near": _is_coordinate,
        "far": _is_coordinate,
        "image_height": _is_size,
        "image_width": _is_size,
        "look_at": _is_vector(3),
        "up_direction": _is_vector(3),
    },
    "GuiUpdateMessage": {"uuid": _is_text, "updates": _is_update},
    "SceneNodeClickMessage": {
        "name": _is_text,
        "instance_index": lambda value: value is None or _is_place(value),
        "ray_origin": _is_vector(3),
        "ray_direction": _is_vector(3),
        "screen_pos": _is_vector(2),
        "modifier": lambda value: value is None or _is_text(value),
        "owner": lambda value: value is None or _is_text(value),
    },
}
