"""Speed and memory of the codec alone, every splat and every colour kept: stages and peak, a process each.

    python -m tools.bench.codec [--splats N] [--json FILE]

tools.bench.decode measures how fast files decode; ``potr-cl info`` says how large each section is.
"""

from __future__ import annotations

import time

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.quantize import Preset
from potr_cl.formats import load_cameras, load_scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tools.make.large_scene import cameras_beside, default_scene, large_scene
from tools.results import Cell, Results
from tools.workloads import growth, in_process, plain_parser


def as_it_is(preset: Preset, coder: EntropyCoder | None = None) -> EncodeOptions:
    """Options that keep every splat and every colour; coder: another than the preset's."""
    options = EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False, cameras_anyway=True)
    return options if coder is None else options.changed(code={"entropy": coder.name, "zstd_level": coder.level})


def _encode(splats: int, with_views: bool, level: int) -> list[Cell]:
    """Seconds by stage and of all, bytes, and the peak in sizes of the scene."""
    source = default_scene()
    scene = large_scene(load_scene(source), splats)
    views = load_cameras(cameras_beside(source)) if with_views else None
    rows: list[Cell] = []

    def work() -> None:
        began = time.perf_counter()
        encoded = encode(scene, views, as_it_is("paper", EntropyCoder("zstd", level)))
        rows.extend(encoded.seconds[stage] for stage in ("octree", "entropy coding"))
        rows.extend((time.perf_counter() - began, encoded.nbytes / 1e6))

    peak = growth(work)
    return [*rows, 1 + peak / scene.nbytes]


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--splats", type=int, default=10**6, metavar="N")
    args = parser.parse_args()
    table = Results(None, args.json).table(
        "encode", f"Encode without pruning, {args.splats} splats of SH degree 3",
        "zstd level; cameras; octree|s|.2f; quantise and code|s|.2f; all|s|.2f; size|MB|.1f; peak / arrays||.2f",
    )  # fmt: skip
    for level, views in ((9, True), (9, False), (19, True)):
        table.add(level, "yes" if views else "no", *in_process(_encode, args.splats, views, level))


if __name__ == "__main__":
    main()
