"""Scenes from web pages that encode has made: the .potr file in them. Of the rest of a page nothing is looked at."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path

from potr_cl.codec.decoder import decode
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.model.scene import Scene

#: Around the scene in a page.
BEGIN, END = b'<script id="scene" type="model/potr;base64">', b"</script>"


def scene_in(page: bytes) -> bytes:
    """The .potr file in a page.

    Raises:
        DataError: there is none.
    """
    begin = page.find(BEGIN) + len(BEGIN)
    end = page.find(END, begin)
    if begin < len(BEGIN) or end < 0:
        raise DataError("not a page that encode made: there is no scene in it")
    try:
        return base64.b64decode(page[begin:end], validate=True)
    except binascii.Error:
        raise DataError("the page is damaged (its scene is cut off): get the file again") from None


def load(path: Path, trust: bool = False) -> Scene:
    """The scene in a page; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    try:
        return decode(scene_in(path.read_bytes()), trust)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


FORMAT = SceneFormat(
    name="web page",
    suffixes=(".html",),
    note="a .potr file and its viewer in one page, as `encode -o scene.html` makes it",
    load=load,
    not_written="pages are made by the command encode, which reads all that convert reads",
    packed=True,
)
