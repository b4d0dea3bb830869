"""Does a process that encodes, renders and compares all day grow?

    python -m tools.stress.long_life [--work encode render compare] [--count N] [--each-opens-a-device] [--json FILE]

Does the same work of the bundled excerpt again and again in one process, and prints what is resident after the first,
the third, the tenth … time (Linux only). Of several works each is done in every turn. Python's objects tell whether the
package keeps something; what malloc_trim gives back is the allocator's; the rest is the driver's, or lost. Exits with 1
if more than 1.3 times as much as after the tenth turn is resident at the end, without what malloc_trim gives back.
"""

from __future__ import annotations

import ctypes
import gc
import sys
import time
from collections.abc import Callable

import potr_cl
from potr_cl.opencl.device import Device
from tools.results import Results
from tools.workloads import TEST_DATA, plain_parser, resident

_SCENE, _CAMERAS = TEST_DATA / "plush_excerpt.ply", TEST_DATA / "plush_excerpt_cameras.json"
#: The turn with which others are compared, and how many times as much memory may be resident.
_TENTH, _MOST_GROWTH = 10, 1.3

WORKS: dict[str, Callable[[Device | None], object]] = {
    "encode": lambda device: potr_cl.encode(_SCENE, _CAMERAS, device=device),
    "render": lambda device: potr_cl.render(_SCENE, _CAMERAS, device=device),
    "compare": lambda device: potr_cl.compare(_SCENE, _SCENE, _CAMERAS, device=device),
}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--work", nargs="+", choices=list(WORKS), default=list(WORKS), help="default: all")
    parser.add_argument("--count", type=int, default=300, metavar="N", help="turns; default 300")
    parser.add_argument("--each-opens-a-device", action="store_true", help="default: one is opened for all")
    parser.add_argument("--device", help="as for potr-cl")
    args = parser.parse_args()
    device = Device(args.device)
    opened = ", on a device that each opens" if args.each_opens_a_device else ""
    table = Results(device.info, args.json).table(
        "long_life", f"Memory of a process that does the same again: {', '.join(args.work)}{opened}",
        "turns||,; time|s|.0f; resident|MB|.0f; after malloc_trim|MB|.0f; on the device|MB|.1f; Python's objects||,",
    )  # fmt: skip
    tenth, began = 0.0, time.perf_counter()
    for turn in range(1, args.count + 1):
        for work in args.work:
            WORKS[work](Device(args.device) if args.each_opens_a_device else device)
        if turn == args.count or str(turn).strip("0") in ("1", "3"):
            gc.collect()
            before = resident("VmRSS") / 1e9
            ctypes.CDLL(None).malloc_trim(0)
            now = resident("VmRSS") / 1e9
            tenth = now if turn == _TENTH else tenth
            objects = len(gc.get_objects())
            table.add(turn, time.perf_counter() - began, 1e3 * before, 1e3 * now, device.allocated / 1e6, objects)
    if tenth and now > _MOST_GROWTH * tenth:
        sys.exit(f"{now / tenth:.2f} times the memory of the {_TENTH}th turn")


if __name__ == "__main__":
    main()
