"""How many virtual views, how large, how wide? What each choice costs in bytes, time and memory.

    python -m tools.study.virtual_views SCENE … [--views 96x700@80 300x600@50 …] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json. It is encoded with its training cameras at the qualities of
--qualities, and then with virtual views of each number, size and field of view (NUMBERxPIXELS@DEGREES). PSNR is the
mean over the true test views, against the uncompressed scene's renders. Bytes are compared at the PSNR that the true
cameras reach at the first quality, interpolated in the logarithm of the bytes; time is that of the encodes at the first
quality, as a multiple of the true cameras'; memory is the most that the device had given away whenever the encode
reported how far it was.

--fraction F takes all pictures smaller, and --iterations N prunes in fewer iterations: enough to compare placements on
a CPU, not for publication.
"""

from __future__ import annotations

import dataclasses
import math
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.virtual_cameras import place_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scaled, scene_parser

#: Number, size and field that are tried unless told otherwise; the first were the default while views were narrow.
VIEWS = (
    "300x600@50", "128x500@50", "48x700@90", "64x600@80", "64x700@90", "96x500@80", "96x600@65", "96x700@80",
    "96x800@90", "128x600@65", "128x600@80", "192x500@65",
)  # fmt: skip
QUALITIES = (0.5, 0.6)


@dataclass(frozen=True)
class Outcome:
    """What the encodes with some views came to.

    Attributes:
        nbytes, psnr: of each quality.
        seconds, memory: of the first one; memory in bytes.
    """

    nbytes: list[int]
    psnr: list[float]
    seconds: float
    memory: int

    def bytes_at(self, decibels: float) -> float:
        """Bytes at a PSNR, along the line through the qualities' first and last."""
        low, high = (math.log(self.nbytes[i]) for i in (0, -1))
        slope = (high - low) / (self.psnr[-1] - self.psnr[0])
        return math.exp(low + (decibels - self.psnr[0]) * slope)


class Judge:
    """Encodes a scene with any views, and judges by the true test views.

    Args:
        device: computes.
        scene: to encode.
        judges: the true test views.
        options: of the encodes.
        qualities: to encode at, two at least.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        judges: Sequence[Camera],
        options: EncodeOptions,
        qualities: Sequence[float],
    ) -> None:
        self._device, self._scene, self._judges, self._options = device, scene, judges, options
        self._qualities = qualities
        self._wanted: list[FloatArray] = pictures(device, scene, judges)

    def outcome(self, views: Sequence[Camera]) -> Outcome:
        """Encode with these training views."""
        nbytes, reached, seconds, most = [], [], 0.0, 0

        def note(stage: str, done: float) -> None:
            nonlocal most
            most = max(most, self._device.allocated)

        for number, q in enumerate(self._qualities):
            began = time.perf_counter()
            encoded = encode(self._scene, views, dataclasses.replace(self._options, q=q), note, self._device)
            if number == 0:
                seconds = time.perf_counter() - began
            got = pictures(self._device, decode(b"".join(encoded.pieces)), self._judges)
            reached.append(float(np.mean([psnr(a, b) for a, b in zip(self._wanted, got, strict=True)])))
            nbytes.append(encoded.nbytes)
            print(f"  {len(views)} views, q {q:g}: {nbytes[-1]} B, {reached[-1]:.2f} dB", file=sys.stderr, flush=True)
        return Outcome(nbytes, reached, seconds, most)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--views", nargs="+", default=VIEWS, metavar="NxSIZE@DEGREES", help="what to try")
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--fraction", type=float, default=1.0, help="of the width and height of all views")
    parser.add_argument("--iterations", type=int, help="of pruning; default: the preset's")
    args = parser.parse_args()
    device = Device(args.device)
    options = EncodeOptions.for_preset("best")
    if args.iterations:
        options = options.changed(prune={"iterations": args.iterations})
    table = Results(device.info, args.json).table(
        "study",
        "Virtual views by number, size and field: bytes at the true cameras' PSNR, time and memory",
        Column("scene"),
        Column("views"),
        Column("width and height", "pixels"),
        Column("field", "degrees"),
        Column("pixels", "million", ".0f"),
        Column("bytes", "%", "+.1f"),
        Column("PSNR at q = 0.5", "dB", ".2f"),
        Column("time", "s", ".1f"),
        Column("time of the true cameras'", format=".2f"),
        Column("memory", "MB", ".0f"),
        Column("memory of the true cameras'", format=".2f"),
    )
    for folder in args.scenes:
        measure(folder, device, options, args.views, args.qualities, args.fraction, table.add)


def measure(
    folder: Path,
    device: Device,
    options: EncodeOptions,
    views: Sequence[str],
    qualities: Sequence[float],
    fraction: float,
    add: Callable[..., None],
) -> None:
    """The rows of one scene."""
    scene, cameras = read(folder)
    judge = Judge(device, scene, [scaled(c, fraction) for c in test_views(cameras)], options, qualities)
    judge.outcome([scaled(train_views(cameras)[0], 0.1)])  # builds the kernels
    own = [scaled(c, fraction) for c in train_views(cameras)]
    true = judge.outcome(own)
    sizes = f"{own[0].width} x {own[0].height}"
    megapixels = sum(c.width * c.height for c in own) / 1e6
    field = f"{math.degrees(2 * math.atan(own[0].width / (2 * own[0].fx))):.0f}"
    add(
        folder.name,
        f"{len(own)} true",
        sizes,
        field,
        megapixels,
        0.0,
        true.psnr[0],
        true.seconds,
        1.0,
        true.memory / 1e6,
        1.0,
    )
    for text in views:
        count, size, degrees = (int(number) for number in re.split("[x@]", text))
        placed = [scaled(c, fraction) for c in train_views(place_cameras(scene, count, size, degrees))]
        got = judge.outcome(placed)
        add(
            folder.name,
            f"{count}",
            f"{placed[0].width} x {placed[0].height}",
            f"{degrees}",
            sum(c.width * c.height for c in placed) / 1e6,
            100 * (got.bytes_at(true.psnr[0]) / true.nbytes[0] - 1),
            got.psnr[0],
            got.seconds,
            got.seconds / true.seconds,
            got.memory / 1e6,
            got.memory / true.memory,
        )


if __name__ == "__main__":
    main()
