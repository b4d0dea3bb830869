"""What does a file of another format take beyond the encode itself: rounding, the choice of its colours, its bytes?

    python -m tools.bench.outputs SCENE [--splats N] [--formats .spz .sog …] [--threads T] [--json OUT.json]

The scene is drawn again until it has N splats (:mod:`tools.make.large_scene`), and what the re-fit would tell of their
colours is made up: each splat is seen from 24 of the scene's cameras, and counts more or less at random. So no view is
rendered, and all that is measured is the output's own work (:class:`potr_cl.outputs.output.Output`).
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.spherical_harmonics import ac_basis
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Request
from potr_cl.outputs.registry import output_of_suffix
from potr_cl.pipeline.options import EncodeOptions
from tools.make.large_scene import large_scene
from tools.results import Column, Results
from tools.workloads import read

_FORMATS = (".spz:2", ".spz:4", ".compressed.ply", ".sog", ".glb", ".ply")
#: Cameras that see a splat, and splats worked on at a time.
_SEEN_FROM, _BLOCK = 24, 1 << 14


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("--splats", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--formats", nargs="+", default=_FORMATS)
    parser.add_argument("--threads", type=int, default=0, help="of the host; 0: one a processor")
    parser.add_argument("--device", help="what it is called")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    device = Device(args.device)
    like, cameras = read(args.scene)
    scene = large_scene(like, args.splats)
    blocks = made_up_blocks(scene, cameras)
    table = Results(device.info, args.json).table(
        "outputs_time",
        f"Time of an output's own work for {args.splats:,} splats of SH degree {scene.sh_degree}",
        Column("format"),
        Column("geometry", "s", ".2f"),
        Column("AC coefficients", "s", ".2f"),
        Column("file", "s", ".2f"),
        Column("together", "s", ".2f"),
        Column("processor time", "s", ".2f"),
        Column("size", "MB", ".2f"),
    )
    for name in args.formats:
        table.add(name, *measured(name, scene, cameras, blocks, device, args.threads))


def measured(
    name: str, scene: Scene, cameras: list[Camera], blocks: FloatArray, device: Device, threads: int
) -> tuple[float, float, float, float, float, float]:
    """Seconds of the three steps, of all, of the processor, and megabytes."""
    suffix, _, version = name.partition(":")
    output = output_of_suffix(suffix, version=int(version) if version else None)
    options = EncodeOptions(q=0.5, output=output)
    coefficients = scene.sh.shape[1]
    diagonals = np.cumsum([0, *range(coefficients, 1, -1)])
    worth = np.ascontiguousarray(blocks[diagonals].T) * np.float32(32**2 * options.parameters.delta_mse_max / 50)
    request = Request(options.parameters, cameras, device, threads=threads, blocks=lambda: blocks)
    seconds: list[float] = []

    def timed(work: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        found = work()
        seconds.append(time.perf_counter() - began)
        return found

    used = sum(os.times()[:2])
    rounded = timed(lambda: output.geometry(scene, request))
    rounded, sh = timed(lambda: output.fix_ac(rounded, scene.sh, worth, request))
    coded = timed(lambda: output.file(replace(scene, sh=sh), rounded, replace(request, blocks=None)))
    used = sum(os.times()[:2]) - used
    nbytes = sum(map(len, coded.pieces))
    return seconds[0], seconds[1], seconds[2], sum(seconds), used, nbytes / 1e6


def made_up_blocks(scene: Scene, cameras: list[Camera], seed: int = 0) -> FloatArray:
    """(M (M + 1) / 2, N) float32, as :attr:`Request.blocks` returns them: sums over cameras that see a splat."""
    rng = np.random.default_rng(seed)
    centres = camera_centres(cameras)
    centres = centres[rng.permutation(len(centres))[:_SEEN_FROM]]
    coefficients = scene.sh.shape[1]
    rows, columns = np.triu_indices(coefficients)
    packed = np.empty((len(rows), len(scene)), np.float32)
    for start in range(0, len(scene), _BLOCK):
        means = scene.means[start : start + _BLOCK].astype(np.float64)
        rays = means[:, None] - centres
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        basis = np.empty((len(means), len(centres), 16), np.float32)
        basis[..., 0], basis[..., 1:] = 0.28209479, ac_basis(rays.reshape(-1, 3)).reshape(len(means), -1, 15)
        # How much a splat counts, and how much in each view.
        counts = rng.lognormal(0, 1.5, (len(means), 1)) * rng.lognormal(0, 1, (len(means), len(centres)))
        basis = basis[..., :coefficients]
        block = np.matmul(basis.transpose(0, 2, 1) * (counts / len(centres)).astype(np.float32)[:, None], basis)
        packed[:, start : start + _BLOCK] = block[:, rows, columns].T
    return packed


if __name__ == "__main__":
    main()
