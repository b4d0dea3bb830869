"""The viewer's own part of the page: :func:`head` for the page's head, and the :func:`assets` that it asks for."""

from __future__ import annotations

from importlib.resources import files
from string import Template

from potr_cl.formats.scenes.page import viewer_script
from potr_cl.report.style import ACCENT, STAGE, TEST_VIEW, TRAINING_VIEW, WARNING
from potr_cl.viewer.access import Asset

_FOLDER = "/potr_cl"
#: Where the page's own WebSocket connects to.
CHANNEL = f"{_FOLDER}/channel"
#: What draws scenes in the page: the viewer of pages that encode makes, where it is built.
DRAWING = f"{_FOLDER}/viewer.js"


def head() -> str:
    """HTML that makes a page of viser's load what is ours.

    Where WebGL is slow, viser lowers its resolution in steps, and asks for as much smaller pictures. Ours are rendered
    elsewhere and cost the browser little: they keep the resolution of the screen.
    """
    return (
        '<script>{ const here = new URL(location); here.searchParams.set("fixedDpr", window.devicePixelRatio || 1);'
        ' history.replaceState(null, "", here); }</script>'
        f'<link rel="stylesheet" href="{_FOLDER}/page.css"><script src="{_FOLDER}/page.js" defer></script>'
    )


def assets() -> dict[str, Asset]:
    """The files of the page by their paths."""
    folder = files(__package__)
    style = Template(folder.joinpath("page.css").read_text("utf-8")).substitute(
        accent=ACCENT,
        warning=WARNING,
        stage=STAGE,
        training=TRAINING_VIEW,
        test=TEST_VIEW,
    )
    script = folder.joinpath("page.js").read_bytes()
    drawing = viewer_script()
    return {
        **({DRAWING: Asset("text/javascript; charset=utf-8", drawing)} if drawing else {}),
        f"{_FOLDER}/page.css": Asset("text/css; charset=utf-8", style.encode()),
        f"{_FOLDER}/page.js": Asset("text/javascript; charset=utf-8", script),
    }
