"""What views between the training views bring, and what they take.

    python -m tools.bench.views_between SCENE … [--few 50 25 8] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json. Each is encoded at several qualities with its training views
alone, with as many views between them as the scene needs (auto), and with the numbers and spreads of --variants
(NUMBER@SPREAD); once with all training views, and with fewer of them, spread evenly over their order. PSNR is the mean
over the test views, against the uncompressed scene's renders, and over the training views. Bytes are compared at the
PSNR that the training views alone reach, interpolated between the qualities in the logarithm of the bytes. With all
training views the time is the least of --repeats encodes, one after the other.

--fraction F takes all pictures smaller, and --iterations N prunes in fewer iterations: for a CPU, not for publication.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scaled, scene_parser

QUALITIES = (0.3, 0.5, 0.7)
VARIANTS = ("auto", "1@0.3", "2@0.1", "2@0.3", "2@1.0", "3@0.3")
#: Training views of the scenes with few of them, unless told otherwise.
FEW = (8,)


@dataclass(frozen=True)
class Point:
    """One encode: quality, views, splats, bytes, PSNR on test views and on training views, and seconds.

    ``shown_by`` is as :class:`potr_cl.stages.views_between.Added` has it.
    """

    q: float
    added: int
    shown_by: float | None
    splats: int
    nbytes: int
    test: float
    training: float
    seconds: float


class Bench:
    """Encodes one scene with some training views.

    Args:
        device: computes.
        scene, views, judges: the scene, its training views, its test views.
        options: of the encodes.
    """

    def __init__(
        self, device: Device, scene: Scene, views: Sequence[Camera], judges: Sequence[Camera], options: EncodeOptions
    ) -> None:
        self._device, self._scene, self._views, self._options = device, scene, views, options
        self._judges, self._seen = judges, views[:: max(len(views) // 16, 1)]
        self._wanted = [pictures(device, scene, some) for some in (self._judges, self._seen)]

    def point(self, q: float, variant: str, again: int = 0) -> Point:
        """Encode at a quality with a variant: "off", "auto", or number@spread; and again, for the time alone."""
        encoded, seconds = self._encoded(q, variant)
        seconds = min([seconds, *[self._encoded(q, variant)[1] for _ in range(again)]])
        decoded = decode(b"".join(encoded.pieces))
        test, training = (
            self._mean(pictures(self._device, decoded, some), wanted)
            for some, wanted in zip((self._judges, self._seen), self._wanted, strict=True)
        )
        of_views = (0, None) if encoded.between is None else (encoded.between.added, encoded.between.shown_by)
        return Point(q, *of_views, len(encoded.order), encoded.nbytes, test, training, seconds)

    def _encoded(self, q: float, variant: str) -> tuple[Encoded, float]:
        """An encode and its seconds."""
        between: dict[str, float | str] = {"views": 0.0 if variant == "off" else variant}
        if "@" in variant:
            number, spread = map(float, variant.split("@"))
            between = {"views": number, "spread": spread}
        options = dataclasses.replace(self._options.changed(between=between), q=q)
        began = time.perf_counter()
        encoded = encode(self._scene, self._views, options, device=self._device)
        return encoded, time.perf_counter() - began

    @staticmethod
    def _mean(got: Sequence[FloatArray], wanted: Sequence[FloatArray]) -> float:
        return float(np.mean([psnr(a, b) for a, b in zip(wanted, got, strict=True)]))


def bytes_at(points: Sequence[Point], decibels: float) -> float:
    """Bytes at a PSNR on test views, along the line through the two points that are nearest to it."""
    near = sorted(sorted(points, key=lambda p: abs(p.test - decibels))[:2], key=lambda p: p.test)
    slope = math.log(near[1].nbytes / near[0].nbytes) / (near[1].test - near[0].test)
    return near[0].nbytes * math.exp((decibels - near[0].test) * slope)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--qualities", nargs="+", type=float, default=QUALITIES)
    parser.add_argument("--variants", nargs="*", default=VARIANTS, metavar="N@SPREAD")
    parser.add_argument(
        "--few", nargs="*", type=int, default=FEW, metavar="N", help="training views of scenes with few"
    )
    parser.add_argument("--repeats", type=int, default=1, metavar="N", help="encodes with all training views")
    parser.add_argument("--fraction", type=float, default=1.0, help="of the width and height of all views")
    parser.add_argument("--iterations", type=int, help="of pruning; default: the preset's")
    args = parser.parse_args()
    device = Device(args.device)
    options = EncodeOptions.for_preset("best")
    if args.iterations:
        options = options.changed(prune={"iterations": args.iterations})
    table = Results(device.info, args.json).table(
        "between",
        "Views between the training views: bytes at the PSNR on test views that the training views alone reach",
        Column("scene"),
        Column("training views"),
        Column("between"),
        Column("views that show a part", format="g"),
        Column("added views", format=","),
        Column("q", format="g"),
        Column("splats", format=","),
        Column("bytes", format=","),
        Column("PSNR on test views", "dB", ".2f"),
        Column("on training views", "dB", ".2f"),
        Column("time", "s", ".1f"),
        Column("time of the training views alone", format=".2f"),
        Column("bytes at equal PSNR", "%", "+.1f"),
    )
    for folder in args.scenes:
        scene, cameras = read(folder)
        judges = [scaled(c, args.fraction) for c in test_views(cameras)]
        every = [scaled(c, args.fraction) for c in train_views(cameras)]
        for count in (len(every), *args.few):
            views = [every[round(i)] for i in np.linspace(0, len(every) - 1, count)]
            again = args.repeats - 1 if count == len(every) else 0
            bench = Bench(device, scene, views, judges, options)
            if count == len(every):
                bench.point(args.qualities[0], "off")  # builds the kernels
            variants = ("off", *args.variants)
            points = [{variant: bench.point(q, variant, again) for variant in variants} for q in args.qualities]
            for variant in variants:
                curve = [of_variant[variant] for of_variant in points]
                for point, own in zip(curve, [of_variant["off"] for of_variant in points], strict=True):
                    more = 100 * (bytes_at(curve, own.test) / own.nbytes - 1) if len(curve) > 1 else None
                    row = (point.splats, point.nbytes, point.test, point.training, point.seconds)
                    which = (folder.name, count, variant, point.shown_by, point.added, point.q)
                    table.add(*which, *row, point.seconds / own.seconds, more)
            print(f"{folder.name}: done with {count} views", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
