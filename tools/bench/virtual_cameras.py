"""What encoding without cameras costs, and what is left of places: judged from where people stand.

    python -m tools.bench.virtual_cameras SCENE … [--q 0.5] [--without-guard] [--json FILE]

A SCENE is a folder with point_cloud.ply (or meta.json, lod-meta.json), and, if there are some, cameras.json. It is
encoded without cameras. PSNR, against the uncompressed scene's renders, is told as ``encode`` tells it, by the views
that it holds out itself, and from where people stand: in the test views of cameras.json. Where that has training views
too, the scene is encoded with these as well, at this quality and a tenth more, and bytes are compared at equal PSNR.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.metrics import psnr
from tools.results import Results
from tools.workloads import log, pictures, scene_parser

_FILES = ("point_cloud.ply", "meta.json", "lod-meta.json")


@dataclasses.dataclass(frozen=True)
class Judged:
    """An encode, judged by some views."""

    nbytes: int
    mean: float
    worst: float


class Judge:
    """Compares files with a scene in its own pictures."""

    def __init__(self, device: Device, scene: Scene, views: Sequence[Camera]) -> None:
        self._device, self._views = device, views
        self._wanted = pictures(device, scene, views)

    def __call__(self, encoded: Encoded) -> Judged:
        got = pictures(self._device, decode(encoded.data), self._views)
        values = [psnr(a, b) for a, b in zip(self._wanted, got, strict=True)]
        return Judged(encoded.nbytes, float(np.mean(values)), min(values))


def bytes_at(points: Sequence[Judged], decibels: float) -> float:
    """Bytes at a PSNR, on the line through two encodes."""
    low, high = points
    slope = math.log(high.nbytes / low.nbytes) / (high.mean - low.mean)
    return low.nbytes * math.exp((decibels - low.mean) * slope)


def main() -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--q", type=float, default=0.5)
    parser.add_argument("--without-guard", action="store_true", help="also encode without the guard")
    args = parser.parse_args()
    device = Device(args.device)
    results = Results(device.info, args.json)
    table = results.table(
        "places",
        f"Without cameras, preset best, q = {args.q:g}",
        "scene; splats||,; views; placed in|s|.1f; resolved|%|.1f; encoded in|s|.1f; bytes||,; PSNR told|dB|.1f; "
        "worst told|dB|.1f; where people stand|dB|.1f; worst there|dB|.1f; bytes against true cameras|%|+.1f",
    )
    best = EncodeOptions.for_preset("best")
    for folder in args.scenes:
        scene = load_scene(next(folder / name for name in _FILES if (folder / name).exists()))
        cameras = load_cameras(folder / "cameras.json") if (folder / "cameras.json").exists() else []
        encode(scene.subset(np.arange(0, len(scene), 100)), place_cameras(scene, 8, 64), best, device=device)  # kernels
        began = time.perf_counter()
        placed = place_cameras(scene, device=device)
        placing = time.perf_counter() - began
        people = Judge(device, scene, test_views(cameras)) if test_views(cameras) else None
        told = Judge(device, scene, test_views(placed))
        for guarded in (True, False) if args.without_guard else (True,):
            options = best if guarded else best.changed(prune={"unseen": "drop"})
            began = time.perf_counter()
            encoded = encode(scene, placed, dataclasses.replace(options, q=args.q), device=device)
            seconds = time.perf_counter() - began
            here, there = told(encoded), people(encoded) if people is not None else None
            unseen = encoded.unseen
            more = None
            if guarded and people is not None and there is not None and train_views(cameras):
                more = _against_true(device, scene, cameras, placed, args.q, people, there)
            table.add(
                folder.name + ("" if guarded else ", without the guard"), len(scene),
                f"{len(train_views(placed))} of {placed[0].width}", placing,
                100 * (1 - unseen.splats / unseen.of) if guarded and unseen is not None else None, seconds,
                encoded.nbytes, here.mean, here.worst, *((there.mean, there.worst) if there else (None, None)), more,
            )  # fmt: skip


def _against_true(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    placed: Sequence[Camera],
    q: float,
    people: Judge,
    there: Judged,
) -> float:
    """Bytes without cameras, in per cent more than with the true ones at their PSNR."""
    true = people(encode(scene, train_views(cameras), EncodeOptions.for_preset("best", q=q), device=device))
    further = people(encode(scene, placed, EncodeOptions.for_preset("best", q=q + 0.1), device=device))
    log(f"with the true cameras: {true}")
    return 100 * (bytes_at((there, further), true.mean) / true.nbytes - 1)


if __name__ == "__main__":
    main()
