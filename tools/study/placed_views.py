"""What placed views cost by how many they are, how large, and how much colours are held to their start.

    python -m tools.study.placed_views SCENE … [--views NxSIZE …] [--priors X …] [--qualities Q …] [--true Q …]
        [--json FILE]

A SCENE is a folder with point_cloud.ply and a cameras.json whose test views say where people stand; an encode is not
told of them. "usual" views are those that ``encode`` places itself. With --true, encodes with the scene's own cameras
at some qualities say what a file takes more than theirs at its PSNR.
"""

from __future__ import annotations

import time

from potr_cl.codec.decoder import open_file
from potr_cl.model.camera import train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.pipeline.encode import encode
from potr_cl.placement.virtual import place_cameras
from tools.results import Results
from tools.study.evaluation import EvaluatedScene
from tools.study.rate_distortion import encode_options
from tools.study.time_error import encoded, gap
from tools.workloads import scene_parser


def _asked(text: str) -> tuple[int | None, int | None]:
    """Number and size of views; None: the usual ones."""
    if text == "usual":
        return None, None
    count, size = map(int, text.split("x"))
    return count, size


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--views", nargs="+", type=_asked, default=[(None, None)], metavar="NxSIZE")
    parser.add_argument("--priors", nargs="+", type=float, default=[0.3], metavar="X")
    parser.add_argument("--qualities", nargs="+", type=float, default=[0.5], metavar="Q")
    parser.add_argument("--true", nargs="+", type=float, default=[], metavar="Q")
    args = parser.parse_args()
    device = Device(choose_device(args.device))
    results = Results(device.info, args.json)
    table = results.table(
        "placed", "Placed views, by how many they are and how large",
        "scene; views; prior||.1f; q||.2f; bytes||,; PSNR where people stand|dB|.2f; worst|dB|.1f; an encode|s|.0f; "
        "bytes against true cameras|%|+.1f",
    )  # fmt: skip
    for folder in args.scenes:
        with EvaluatedScene(folder, device) as evaluator:
            curve = [encoded(evaluator, device, "best", q, {}) for q in args.true]
            for count, size in args.views:
                for prior in args.priors:
                    for q in args.qualities:
                        options = encode_options({"preset": "best", "q": q, "refit.prior": prior})
                        began = time.perf_counter()
                        cameras = place_cameras(evaluator.source, count, size, device=device)
                        made = encode(evaluator.source, cameras, options, device=device)
                        seconds = time.perf_counter() - began
                        psnr, worst = evaluator.mean_and_worst(open_file(b"".join(made.pieces)).scene())
                        placed = train_views(cameras)
                        said = f"{len(placed)} of {placed[0].width}"
                        more = gap(curve, {"bytes": made.nbytes, "psnr": psnr}) if curve else None
                        table.add(evaluator.name, said, prior, q, made.nbytes, psnr, worst, seconds, more)


if __name__ == "__main__":
    main()
