"""Speed, memory and size of the codec alone: every splat and every colour is kept.

    python -m tools.bench.codec [--part PART …] [--splats N] [--json FILE]

Parts (default: both): encode (stages and peak memory, each in a process of its own), sizes (bytes a splat of every
section, lego and plush). tools.bench.decode measures how fast files decode.
"""

from __future__ import annotations

import time
from pathlib import Path

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import open_file
from potr_cl.codec.quantize import Preset
from potr_cl.formats import load_cameras, load_scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.file import file_report
from tools.make.large_scene import cameras_beside, default_scene, large_scene
from tools.results import Cell, Column, Results
from tools.workloads import SCENES, growth, in_process, plain_parser, read


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


def encodes(results: Results, splats: int) -> None:
    table = results.table(
        "encode", f"Encode without pruning, {splats} splats of SH degree 3",
        "zstd level; cameras; octree|s|.2f; quantise and code|s|.2f; all|s|.2f; size|MB|.1f; peak / arrays||.2f",
    )  # fmt: skip
    for level, views in ((9, True), (9, False), (19, True)):
        table.add(level, "yes" if views else "no", *in_process(_encode, splats, views, level))


def sizes(results: Results, _: int) -> None:
    coders = {f"zstd {level}": EntropyCoder("zstd", level) for level in (9, 19, 22)}
    for folder in filter(Path.exists, (SCENES / "lego", SCENES / "plush")):
        scene, cameras = read(folder)
        reports = {}
        for name, coder in {**coders, "best": None}.items():
            encoded = encode(scene, cameras, as_it_is("paper" if coder else "best", coder))
            reports[name] = file_report(open_file(b"".join(encoded.pieces)))
        table = results.table(
            folder.name, f"Bytes a splat, {folder.name}, {len(scene)} splats, q = 0.5, nothing pruned",
            "section; serialised||.2f", *(Column(name, format=".2f") for name in reports),
        )  # fmt: skip
        serialised = {name: each["serialised_bytes"] for name, each in reports["zstd 9"]["sections"].items()}
        for section, raw in serialised.items():
            coded = [report["sections"][section]["bytes"] / len(scene) for report in reports.values()]
            table.add(section, raw / len(scene), *coded)
        table.add("all", sum(serialised.values()) / len(scene), *(r["bytes_a_splat"] for r in reports.values()))


PARTS = {"encode": encodes, "sizes": sizes}


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--part", action="append", choices=list(PARTS), dest="parts")
    parser.add_argument("--splats", type=int, default=10**6, metavar="N")
    args = parser.parse_args()
    results = Results(None, args.json)
    for part in args.parts or PARTS:
        PARTS[part](results, args.splats)


if __name__ == "__main__":
    main()
