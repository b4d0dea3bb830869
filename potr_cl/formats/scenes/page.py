"""Scenes from this package's own files (:data:`POTR`), and in web pages: a .potr file and what shows it, one file that
opens without a server or a network.

What pages are made of, ``page.html`` beside this module, has the viewer, its decoder and their licences in it; ``python
-m tools.make.web`` builds it from web/. Of a page that is read, nothing but the .potr file is looked at.
"""

from __future__ import annotations

import base64
import binascii
import gzip
import html
import json
import re
from pathlib import Path
from typing import Any

from potr_cl.codec.container import MAGIC
from potr_cl.codec.decoder import decode
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.host.atomic_write import write_pieces
from potr_cl.model.scene import Scene
from potr_cl.plain_text import plain

TEMPLATE = Path(__file__).with_name("page.html")
#: Around the scene in a page.
BEGIN, END = b'<script id="scene" type="model/potr;base64">', b"</script>"
_TITLE = "3D scene"
_LONGEST = 200
#: Of scenes that are written as they are; the same as encode's.
_QUALITY = 0.5


def check_viewer() -> None:
    """Raises UsageError if this installation has no viewer to put into pages."""
    if not TEMPLATE.exists():
        raise UsageError(
            "this installation has no viewer for pages: in a clone, 'pip install -e . ziglang' and "
            "'python -m tools.make.web' build it (it needs Node 20 and npm; see docs/web.md)"
        )


def viewer_script() -> bytes | None:
    """The script of the viewer in pages; None if this installation has none."""
    if not TEMPLATE.exists():
        return None
    found = re.search(rb'<script id="viewer"[^>]*>([^<]*)<', TEMPLATE.read_bytes())
    assert found is not None
    return gzip.decompress(base64.b64decode(found[1]))


def potr_of(scene: Scene, source: Path | None, **quality: float) -> bytes:
    """A scene as a .potr file.

    Args:
        scene: all of its splats are written, rounded.
        source: of the scene; the .potr file that it is, or has in it, is taken as it is.
        quality: how finely to round, as of :meth:`potr_cl.codec.quantize.HyperParameters.from_quality`; as ``encode``
            does, if not given.

    Raises:
        DataError: no splat is left, or a value is too large.
    """
    if source is not None:
        with source.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                return MAGIC + file.read()
        if source.suffix.lower() in FORMAT.suffixes:
            return scene_in(source.read_bytes())
    clean, _ = scene.cleaned()
    if not len(clean):
        raise DataError("the scene has no splats")
    return b"".join(code_scene(clean, HyperParameters.from_quality(**{"q": _QUALITY, **quality}, preset="best")).pieces)


def page_around(
    potr: bytes, splats: int, title: str | None = None, author: str | None = None, view: dict[str, Any] | None = None
) -> list[bytes]:
    """The pieces of a page.

    Args:
        potr: the .potr file.
        splats: in it.
        title, author: shown on the page, as text.
        view: where its visitor begins: position, target, up, and fov in degrees.
    """
    check_viewer()
    title, author = (None if text is None else plain(text.strip(), _LONGEST) for text in (title, author))
    words = [title, author and f"by {author}", f"{splats:,} splats, {len(potr) / 1e6:.2f} MB"]
    about = {"words": " · ".join(filter(None, words)), "view": view}
    content = {
        "title": html.escape(title or _TITLE),
        "author": html.escape(author or ""),
        "about": json.dumps(about).replace("<", "\\u003c"),
    }
    # In one go: what a title says is not looked at.
    page = re.sub("@(title|author|about)@", lambda found: content[found[1]], TEMPLATE.read_text("utf-8"))
    before, after = page.encode().split(b"@scene@" + END)
    return [before, base64.b64encode(potr), END + after]


def sizes(page: bytes) -> dict[str, int]:
    """Bytes of a page by what they are for, besides the .potr file itself."""
    viewer = TEMPLATE.stat().st_size if TEMPLATE.exists() else 0
    return {"viewer": viewer, "as text": len(page) - viewer - len(scene_in(page))}


def scene_in(page: bytes) -> bytes:
    """The .potr file in a page. Raises DataError if there is none."""
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


def save(
    path: Path, scene: Scene, title: str | None = None, author: str | None = None, source: Path | None = None
) -> None:
    """Write a page; see :class:`potr_cl.formats.declaration.SceneSaver`.

    Args:
        path: of the page.
        scene: to write: all of its splats, rounded as encode rounds them.
        title, author: as of :func:`page_around`.
        source: of the scene; the .potr file that it is, or has in it, goes into the page as it is.
    """
    check_viewer()
    write_pieces(path, page_around(potr_of(scene, source), len(scene), title, author))


#: They are only read here: what makes them is the whole pipeline of encode.
POTR = SceneFormat(
    name="potr_cl",
    suffixes=(".potr",),
    note="this package's own: what `encode` makes of a scene in any of these formats",
    load=decode,
    not_written="a .potr file is made by the command encode, which reads all that convert reads",
    starts=(MAGIC,),
    packed=True,
)

FORMAT = SceneFormat(
    name="web page",
    suffixes=(".html",),
    note="a .potr file and its viewer in one page to send: [On the web](web.md)",
    load=load,
    save=save,
    choices=("title", "author", "source"),
    packed=True,
)
