"""A page in the browser that shows scenes: :func:`view`."""

from __future__ import annotations

import os
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    DeviceSource,
    SceneSource,
    bytes_of_source,
    cameras_of,
    chosen_views,
    colour_of,
    device_of,
    name_of,
    rules_of,
    scene_of,
)
from potr_cl.api.views import Viewpoints
from potr_cl.errors import UsageError
from potr_cl.formats.ladder import Ladder, ladder_at, read_ladder
from potr_cl.model.camera import within_photographs
from potr_cl.opencl.device import Device
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rules import RasterRules

if TYPE_CHECKING:
    from potr_cl.viewer.server import Viewer

#: Where the page is, unless told otherwise: on this machine alone.
HOST, PORT = "127.0.0.1", 8080


def view(
    a: SceneSource | Ladder,
    b: SceneSource | Ladder | None = None,
    cameras: CamerasSource | None = None,
    *,
    truth: str | os.PathLike[str] | None = None,
    host: str = HOST,
    port: int = 0,
    browser: bool = False,
    device: DeviceSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    trust: bool = False,
    antialiased: bool | None = None,
) -> Viewer:
    """Show a scene in the browser, or two beside each other, as the command ``view`` does.

    The page is served by threads of this program until the result is closed or the program ends. In a notebook the
    result shows the page itself.

    Args:
        a: the scene, or the reference of two; or a ladder (:func:`potr_cl.encode_ladder`), or where one is.
        b: to compare with it; of a ladder the page has a slider to choose the quality.
        cameras: views to fly to, or their file; None: some are placed around the scene.
        truth: a folder of photographs named after the views: they fade over the pictures, and the views are judged by
            them.
        host: the address to listen on; by default only this machine can connect.
        port: 0: any that is free.
        browser: whether to open the page in the user's browser.
        device: to render on, or what it is called; the one that should be fastest by default.
        rules: of the rasterizer to follow: inria or gsplat.
        background: R, G, B from 0 to 1, or a colour's name.
        trust, antialiased: as of :func:`potr_cl.load_scene`. Files that are dropped on the page are never trusted.

    Raises:
        UsageError: an option is out of range, viser is missing, or the port is taken.
        DataError: a file is damaged.
        DeviceError: there is no device.
    """
    from potr_cl.viewer.server import Viewer, check_address, check_viser
    from potr_cl.viewer.session import Exhibit

    check_viser()
    check_address(host, port)
    colour, wanted = colour_of(background), rules_of(rules)
    if truth is not None and cameras is None:
        raise UsageError("--truth needs --cameras, the views that the photographs show")
    ladder = _ladder_of(b) if b is not None else _ladder_of(a)
    if b is not None and _ladder_of(a) is not None:
        raise UsageError("a ladder is compared with a scene: give the scene first, then the ladder")
    given = cameras_of(cameras)

    def exhibit(source: SceneSource) -> Exhibit:
        scene = scene_of(source, trust, antialiased)
        nbytes = bytes_of_source(source)
        path = Path(source) if isinstance(source, (str, os.PathLike)) and Path(source).is_file() else None
        return Exhibit(scene, name_of(source).name, scene.nbytes if nbytes is None else nbytes, path)

    first = None if isinstance(a, Ladder) or (b is None and ladder is not None) else exhibit(a)
    second = None if b is None or ladder is not None or isinstance(b, Ladder) else exhibit(b)
    if given is not None:
        given = within_photographs(given) if truth is not None else given
        tests = chosen_views(given)
        start = tests[0]
        views = [start, *(camera for camera in given if camera is not start)]
    else:
        known = first.scene if first is not None else None
        if known is None and ladder is not None:
            known = scene_of(ladder.file(ladder.rungs[0]), trust, antialiased)
        assert known is not None
        views = Viewpoints().placed(known)
    photographs = GroundTruth(Path(truth), views, colour) if truth is not None else None
    viewer = Viewer(
        first,
        second,
        views=views,
        cameras=views if given is not None else [],
        photographs=photographs,
        ladder=ladder,
        open_device=_opener(device_of(device)),
        rules=wanted,
        background=colour,
        host=host,
        port=port,
        antialiased=antialiased,
    )
    if browser:
        webbrowser.open(viewer.url)
    return viewer


def _ladder_of(source: SceneSource | Ladder) -> Ladder | None:
    if isinstance(source, Ladder):
        return source
    found = ladder_at(source) if isinstance(source, (str, os.PathLike)) else None
    return None if found is None else read_ladder(found)


def _opener(device: Device) -> Callable[[], Device]:
    """Gives a device that is open already, and opens it anew whenever it is asked again: something has failed then."""
    opened = [device]
    return lambda: opened.pop() if opened else Device(device.info, family=device.family)
