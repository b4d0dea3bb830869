"""Do the viewer's memory and time stay bounded, however long its cameras move?

    python -m tools.stress.viewer SCENE [COMPRESSED] [--minutes 10] [--tabs 2]

Tabs without a browser (:mod:`tools.viewer_tab`) move from view to view, stand still, change how they compare, and are
closed and opened anew, once a tenth of the time. Each tenth has a row: pictures, the longest wait for one, the
process's memory, its threads and the device's memory. It fails if memory or threads grow from the second tenth to the
last by more than measuring varies, if a tab waited longer than ten seconds for a picture, or if work goes on after the
last is closed.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import potr_cl
from potr_cl.opencl.device import Device
from potr_cl.viewer.comparison import MODES
from potr_cl.viewer.pose import gaze_on
from tools.results import Column, Results
from tools.viewer_tab import Tab, around

#: Bytes by which a process may vary: caches of the allocator and of the drivers.
_VARIES = 150 << 20
_WAIT = 10.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a folder with point_cloud.ply and cameras.json, or a scene's file")
    parser.add_argument("compressed", nargs="?", type=Path, help="to compare with it")
    parser.add_argument("--cameras", type=Path, help="where the scene is a file")
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--tabs", type=int, default=2)
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--json", type=Path, help="also keep the results here")
    args = parser.parse_args()
    folder = args.scene.is_dir()
    device = Device(args.device)
    table = Results(device.info, args.json).table(
        "viewer_stress",
        f"{args.minutes:g} minutes of movement in {args.tabs} tabs",
        Column("until", "s", ".0f"),
        Column("pictures"),
        Column("longest wait", "s", ".2f"),
        Column("process", "MB", ".0f"),
        Column("threads"),
        Column("device", "MB", ".0f"),
    )
    wrong: list[str] = []
    with potr_cl.view(
        args.scene / "point_cloud.ply" if folder else args.scene,
        args.compressed,
        args.scene / "cameras.json" if folder else args.cameras,
        device=device,
    ) as viewer:
        gazes = [gaze_on(camera, 4 / 3) for camera in viewer.losses.views]
        rows = []
        began = time.monotonic()
        for tenth in range(10):
            end = began + args.minutes * 6 * (tenth + 1)
            tabs = [Tab(viewer.url, 640 - 80 * k, 480 - 60 * k) for k in range(args.tabs)]
            while (now := time.monotonic()) < end:
                passed = now - began
                if passed % 5 < 4:  # and a second of standing still
                    for number, tab in enumerate(tabs):
                        tab.look(around(gazes, passed + 3 * number))
                for number, visitor in enumerate(viewer.painter.visitors):
                    mode = MODES[(int(passed / 2) + number) % len(MODES)]
                    if visitor.mode != mode:
                        visitor.mode = mode
                        viewer.painter.wake(visitor, look=True)
                time.sleep(1 / 30)
            # Read before the tabs are closed: what they hold counts.
            waits = [b.when - a.when for tab in tabs for a, b in pairwise(tab.pictures)]
            count = sum(len(tab.pictures) for tab in tabs)
            row = (end - began, count, max(waits, default=0.0), _memory() / 1e6, threading.active_count(),
                   device.allocated / 1e6)  # fmt: skip
            rows.append(row)
            table.add(*row)
            if max(waits, default=_WAIT + 1) > _WAIT:
                wrong.append(f"a tab waited {max(waits, default=0):.1f} s for a picture, of {count}")
            for tab in tabs:
                tab.close()
            deadline = time.monotonic() + 10
            while viewer.painter.visitors and time.monotonic() < deadline:
                time.sleep(0.05)
            if viewer.painter.visitors:
                wrong.append("a closed tab is still painted for")
        time.sleep(1)
        before = time.process_time()
        time.sleep(3)
        spent = time.process_time() - before
        print(f"\nwithout tabs, {spent:.2f} s of processor time in 3 s")
        if spent > 0.5:
            wrong.append("work goes on without a tab")
    if (rows[-1][3] - rows[1][3]) * 1e6 > _VARIES:
        wrong.append(f"the process has grown from {rows[1][3]:.0f} to {rows[-1][3]:.0f} MB")
    if rows[-1][4] > rows[1][4] + 8:
        wrong.append(f"threads have grown from {rows[1][4]} to {rows[-1][4]}")
    for each in dict.fromkeys(wrong):
        print(f"wrong: {each}", file=sys.stderr)
    return 1 if wrong else 0


def _memory() -> int:
    """Bytes of this process in memory; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


if __name__ == "__main__":
    sys.exit(main())
