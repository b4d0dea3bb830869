"""When to compact the colours within the pruning schedule.

    python -m tools.bench.compact_at SCENE … [--device D]

A SCENE is a folder with point_cloud.ply and cameras.json. For each part of the schedule: splats, bytes, AC sparsity,
and PSNR on test views against the uncompressed scene's renders, after quantisation. Prints Markdown.
"""

from __future__ import annotations

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.model.camera import test_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scene_parser


def main() -> None:
    """Command line."""
    args = scene_parser(__doc__).parse_args()
    device = Device(args.device)
    table = Results(device.info, args.json).table(
        "compact_at",
        "After which part of the pruning schedule the colours are compacted",
        Column("scene"),
        Column("compact at"),
        Column("splats", format=","),
        Column("bytes", format=","),
        Column("AC zeros", format=".1%"),
        Column("PSNR", "dB", ".2f"),
    )
    for folder in args.scenes:
        scene, cameras = read(folder)
        views = test_views(cameras)
        wanted = pictures(device, scene, views)
        settings = [
            (f"{part:g}", EncodeOptions.for_preset("paper", compact={"at": part})) for part in (0, 0.25, 0.5, 0.75, 1)
        ]
        for label, options in [*settings, ("never", EncodeOptions.for_preset("paper", compact=False))]:
            encoded = encode(scene, cameras, options, device=device)
            decoded = decode(b"".join(encoded.pieces))
            got = pictures(device, decoded, views)
            mean = float(np.mean([psnr(a, b) for a, b in zip(wanted, got, strict=True)]))
            zeros = ac_sparsity(decoded.sh, options.parameters.sf_sh)
            table.add(folder.name, label, len(decoded), encoded.nbytes, float(zeros), mean)


if __name__ == "__main__":
    main()
