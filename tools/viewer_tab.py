"""A tab of a browser without the browser (:class:`Tab`): moves its camera as viser's page does, and counts pictures."""

from __future__ import annotations

import io
import re
import threading
import time
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from viser import transforms
from websockets.sync.client import connect

from potr_cl.viewer.pose import Gaze


@dataclass(frozen=True)
class Arrived:
    """A picture that has come.

    Attributes:
        when: by the monotonic clock.
        nbytes: of its JPEG file.
        width, height: in pixels.
    """

    when: float
    nbytes: int
    width: int
    height: int


class Tab:
    """Connects to a viewer, and takes all that it sends in a thread of its own, until it is closed.

    Args:
        url: of the viewer.
        width, height: of its picture.
    """

    def __init__(self, url: str, width: int, height: int) -> None:
        self.pictures: list[Arrived] = []
        self.key = ""
        self._size = width, height
        address = url.replace("http://", "ws://")
        protocol: Any = f"viser-v{viser.__version__}"
        self._socket = connect(address, subprotocols=[protocol], max_size=None, compression=None)
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def look(self, gaze: Gaze) -> None:
        """Say where the camera is."""
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": transforms.SO3.from_matrix(gaze.rotation).wxyz.tolist(),
            "position": gaze.position.tolist(),
            "fov": gaze.fov,
            "near": 0.01,
            "far": 1000.0,
            "image_height": self._size[1],
            "image_width": self._size[0],
            "look_at": (gaze.position + gaze.rotation[:, 2]).tolist(),
            "up_direction": (-gaze.rotation[:, 1]).tolist(),
        }
        self._socket.send(msgspec.msgpack.encode(message))

    def close(self) -> None:
        """As a user closes a tab."""
        self._socket.close()
        self._thread.join(5)

    def _receive(self) -> None:
        unpacking = zstandard.ZstdDecompressor()
        try:
            for frame in self._socket:
                assert isinstance(frame, bytes)
                size, packed = (int.from_bytes(frame[k : k + 8], "little") for k in (0, 8))
                content = msgspec.msgpack.decode(unpacking.decompress(frame[16 : 16 + packed], size))
                parts, start = [], 16 + packed
                for length in content["binaryBufferLengths"]:
                    start += -start % 8
                    parts.append(frame[start : start + length])
                    start += length
                for message in content["messages"]:
                    self._take(message, parts)
        except Exception as error:
            if type(error).__module__.split(".")[0] != "websockets":
                raise

    def _take(self, message: dict[str, Any], parts: list[bytes]) -> None:
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
            data = message["rgb_data"]
            data = parts[data["__binary_index"]] if isinstance(data, dict) else data
            with Image.open(io.BytesIO(data)) as image:
                self.pictures.append(Arrived(time.monotonic(), len(data), *image.size))
        elif message["type"] == "GuiHtmlMessage":
            found = re.search(r'data-potr-key="([^"]+)"', message["props"]["content"])
            if found:
                self.key = found[1]


def around(gazes: list[Gaze], seconds: float, a_second: float = 0.5) -> Gaze:
    """Where a camera is that goes smoothly from view to view, ``a_second`` views a second."""
    place = seconds * a_second
    start, end = gazes[int(place) % len(gazes)], gazes[(int(place) + 1) % len(gazes)]
    part = place - int(place)
    first, last = (transforms.SO3.from_matrix(gaze.rotation) for gaze in (start, end))
    rotation = first @ transforms.SO3.exp((first.inverse() @ last).log() * part)
    position = np.asarray(start.position * (1 - part) + end.position * part)
    return Gaze(position, rotation.as_matrix(), start.fov)
