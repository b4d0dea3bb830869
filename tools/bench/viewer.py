"""How many pictures a second does the viewer show while a camera moves, and of what size?

    python -m tools.bench.viewer SCENE … [--compressed FILE.potr …] [--size 640x480] [--said 60] [--json FILE]

For each scene a viewer is started, and a tab without a browser (:mod:`tools.viewer_tab`) goes from view to view. What
is counted are pictures that have arrived there: rendered, put together, made a JPEG, and sent. First at full size
whatever it takes, then as users have it, at the size that keeps the pictures coming. With ``--compressed``, one file
for each scene, both scenes are shown under the divider too.

A picture is made when the camera has moved, so there cannot be more of them than ``--said``, the times a second that
the tab says where its camera is. The page in a browser says it at most 66 times a second.
"""

from __future__ import annotations

import statistics
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import potr_cl
from potr_cl.opencl.device import Device
from potr_cl.viewer.pace import Pace
from potr_cl.viewer.pose import gaze_on
from potr_cl.viewer.server import Viewer
from tools.results import Column, Results
from tools.viewer_tab import Arrived, Tab, around
from tools.workloads import scene_parser

#: Seconds of movement before those that count, in which the size settles.
_SETTLE = 4.0


class _Always(Pace):
    """Pictures of full size."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        return width, height


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--compressed", type=Path, nargs="*", default=[], metavar="FILE", help="one for each scene")
    parser.add_argument("--size", default="640x480", help="of the tab's picture; default 640x480")
    parser.add_argument("--said", type=float, default=60, help="times a second that the camera's place is told")
    parser.add_argument("--seconds", type=float, default=10, help="of movement that count")
    args = parser.parse_args()
    width, height = (int(part) for part in args.size.split("x"))
    device = Device(args.device)
    results = Results(device.info, args.json)
    table = results.table(
        "viewer",
        f"Pictures a second while the camera moves, in a tab of {width} x {height} pixels",
        Column("scene"),
        Column("shown"),
        Column("size of the pictures"),
        Column("pictures", "/s", ".1f"),
        Column("95 of 100 come within", "ms", ".0f"),
    )
    for number, folder in enumerate(args.scenes):
        pairs: list[tuple[str, Any]] = [("one scene", None)]
        if number < len(args.compressed):
            pairs.append(("two, divider", args.compressed[number]))
        for shown, other in pairs:
            cameras = potr_cl.read_cameras(folder / "cameras.json")
            with potr_cl.view(folder / "point_cloud.ply", other, cameras, device=device) as viewer:
                for full in (True, False):
                    arrived = _moved(viewer, width, height, full, args.said, args.seconds)
                    how = "full size" if full else "as it keeps up"
                    table.add(folder.name, f"{shown}, {how}", *_figures(arrived, args.seconds))


def _moved(viewer: Viewer, width: int, height: int, full: bool, said: float, seconds: float) -> list[Arrived]:
    tests = [camera for camera in viewer.losses.views if camera.split == "test"] or viewer.losses.views
    gazes = [gaze_on(camera, width / height) for camera in tests]
    tab = Tab(viewer.url, width, height)
    try:
        tab.look(gazes[0])
        while not viewer.painter.visitors:
            time.sleep(0.01)
        (visitor,) = viewer.painter.visitors
        if full:
            visitor.paces = {"one": _Always(), "two": _Always()}
        began = time.monotonic()
        while (passed := time.monotonic() - began) < _SETTLE + seconds:
            tab.look(around(gazes, passed))
            time.sleep(1 / said - (time.monotonic() - began) % (1 / said))
        return [each for each in tab.pictures if began + _SETTLE <= each.when < began + _SETTLE + seconds]
    finally:
        tab.close()
        while viewer.painter.visitors:
            time.sleep(0.01)


def _figures(arrived: list[Arrived], seconds: float) -> tuple[str, float, float | None]:
    if len(arrived) < 3:
        return "–", len(arrived) / seconds, None
    middle = sorted(arrived, key=lambda each: each.width)[len(arrived) // 2]
    waits = [1000 * (b.when - a.when) for a, b in pairwise(arrived)]
    return f"{middle.width} x {middle.height}", len(arrived) / seconds, statistics.quantiles(waits, n=20)[-1]


if __name__ == "__main__":
    main()
