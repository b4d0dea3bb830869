"""When to compact the colours within the pruning schedule: python -m tools.bench.compact_at SCENE … [--device D]

A SCENE is a folder with point_cloud.ply and cameras.json. For each part of the schedule: splats, bytes, AC sparsity,
and PSNR on test views against the uncompressed scene's renders, after quantisation. Prints Markdown.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, test_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from potr_cl.raster.rasterizer import Rasterizer


def pictures(device: Device, scene: Scene, views: list[Camera]) -> list[FloatArray]:
    """Renders, clamped to [0, 1]."""
    rasterizer = Rasterizer(device, scene)
    images = [np.clip(rasterizer.render(view)[0], 0, 1) for view in views]
    rasterizer.free()
    return images


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--device")
    args = parser.parse_args()
    device = Device(args.device)
    print(f"{device.info}\n\n| scene | compact at | splats | bytes | AC zeros | PSNR |\n|---|---|---|---|---|---|")
    for folder in args.scenes:
        scene, cameras = load_scene(folder / "point_cloud.ply"), load_cameras(folder / "cameras.json")
        views = test_views(cameras)
        wanted = pictures(device, scene, views)
        settings = [(f"{part:g}", EncodeOptions(compact_at=part)) for part in (0, 0.25, 0.5, 0.75, 1)]
        for label, options in [*settings, ("never", EncodeOptions(compact=False))]:
            encoded = encode(scene, cameras, options, device=device)
            decoded = decode(b"".join(encoded.pieces))
            got = pictures(device, decoded, views)
            mean = float(np.mean([psnr(a, b) for a, b in zip(wanted, got, strict=True)]))
            zeros = 100 * ac_sparsity(decoded.sh, options.parameters.sf_sh)
            print(
                f"| {folder.name} | {label} | {len(decoded)} | {encoded.nbytes} | {zeros:.1f} % | {mean:.2f} dB |",
                flush=True,
            )


if __name__ == "__main__":
    main()
