"""Cameras that are not in the scene's frame: which are found, by which margin, and what keeping unseen splats costs.

    python -m tools.study.frames judge SCENE SCENE … [--json FILE]
    python -m tools.study.frames unseen SCENE … [--json FILE] [--device DEVICE] [--preset fast]

``judge`` takes two scenes or more (point_cloud.ply, cameras.json and images in each, perhaps a COLMAP model in
sparse/0). It moves each as people do, and judges it by its photographs, by its points, and by neither; then it leaves
the scenes where they are, and changes photographs and parts of the scene. Last it counts what is found by neither,
of the same scenes and of such that are made by rule (:mod:`tests.reference.captures`).

``unseen`` encodes each scene with and without the splats that no training view sees, with all its training views and
with half of them, those of one side.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.formats.cameras.points import points_beside
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.camera import Camera, camera_centres, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.evidence import by_photographs, evidence_of
from potr_cl.quality.metrics import psnr
from tests.reference.captures import CAPTURES
from tests.reference.frames import ORDINARY, PHOTOGRAPHS, changed, moved, parts, right, without_directions, wrong
from tools.results import Column, Results
from tools.workloads import pictures, read

_COLUMNS = (
    Column("correlation", format=".2f"),
    Column("by photographs"),
    Column("contrast", format=".1f"),
    Column("by points"),
    Column("by neither"),
    Column("time", "s", ".2f"),
)


def judge(args: argparse.Namespace) -> None:
    """Scenes that were moved and scenes that were not, by what lies beside their cameras."""
    results = Results(None, args.json)
    scenes = {folder: read(folder) for folder in args.scenes}
    views = {folder: _with_points(folder, train_views(cameras)) for folder, (_, cameras) in scenes.items()}
    table = results.table("moved", "Scenes that were moved", Column("scene"), Column("motion"), *_COLUMNS)
    for folder, (scene, _) in scenes.items():
        for what, motion in ORDINARY.items():
            table.add(folder.name, what, *_verdicts(moved(scene, *motion), views[folder]))
    table = results.table("right", "Scenes that were not moved", Column("scene"), Column("what"), *_COLUMNS)
    for folder, (scene, _) in scenes.items():
        for what, cameras in right(scene, views[folder], others=False):
            table.add(folder.name, what, *_verdicts(scene, cameras))
        table.add(folder.name, "SH degree 0", *_verdicts(without_directions(scene), views[folder]))
        smooth = dataclasses.replace(scene, antialiased=True)
        table.add(folder.name, "said to be antialiased", *_verdicts(smooth, views[folder]))
        for what in PHOTOGRAPHS:
            with tempfile.TemporaryDirectory() as place:
                table.add(
                    folder.name, f"photographs {what}", *_verdicts(scene, changed(views[folder], what, Path(place)))
                )
        for splats in (50_000, 10_000, 1_500):
            for number, part in enumerate(parts(scene, splats, 6)):
                table.add(folder.name, f"{splats:,} splats of it ({number})", *_verdicts(part, views[folder]))
    table = results.table(
        "blind",
        "Without photographs and points: frames that are refused",
        Column("scene"),
        Column("SH degree"),
        Column("wrong ones"),
        Column("of them taken"),
        Column("right ones"),
    )
    blind = {folder.name: (scene, _bare(views[folder])) for folder, (scene, _) in scenes.items()}
    blind |= {name: (scene, train_views(cameras)) for name, (scene, cameras) in ((n, m()) for n, m in CAPTURES.items())}
    names = list(blind)
    for name, (scene, cameras) in blind.items():
        other = blind[names[(names.index(name) + 1) % len(names)]][1]
        for one in (scene, without_directions(scene)):
            bad = {what: judge_cameras(each, seen).suspicious for what, each, seen in wrong(one, cameras, other)}
            good = [judge_cameras(one, each).suspicious for _, each in right(one, cameras, others=False)]
            taken = ", ".join(what for what, refused in bad.items() if not refused)
            table.add(name, one.sh_degree, f"{sum(bad.values())} of {len(bad)}", taken, f"{sum(good)} of {len(good)}")


def _with_points(folder: Path, cameras: list[Camera]) -> list[Camera]:
    points = points_beside(folder / "sparse" / "0", "points3D.bin")
    return [dataclasses.replace(camera, points_path=points) for camera in cameras]


def _bare(cameras: Sequence[Camera]) -> list[Camera]:
    return [dataclasses.replace(camera, image_path=None, points_path=None) for camera in cameras]


def _verdicts(scene: Scene, cameras: Sequence[Camera]) -> list[float | str | None]:
    """What is measured and decided by photographs, by points, and by neither, and the time that an encode takes."""
    began = time.process_time()
    judge_cameras(scene, cameras, evidence_of(scene, cameras))
    seconds = time.process_time() - began
    cells: list[float | str | None] = []
    without = [dataclasses.replace(camera, image_path=None) for camera in cameras]
    for found in (by_photographs(scene, [c for c in cameras if c.image_path]), evidence_of(scene, without)):
        agreed = judge_cameras(scene, cameras, found)
        verdict = "refused" if agreed.suspicious else "taken"
        if found is not None and found.agrees is None and found.text:
            verdict = "warned of"
        cells += [None, None] if found is None else [found.measured, verdict]
    return [*cells, "refused" if judge_cameras(scene, cameras).suspicious else "taken", seconds]


def unseen(args: argparse.Namespace) -> None:
    """Bytes and PSNR with unseen splats kept and dropped."""
    device = Device(args.device)
    results = Results(device.info, args.json)
    table = results.table(
        "unseen",
        f"Splats that no training view sees, kept or dropped, preset {args.preset}, PSNR on the test views",
        Column("scene"),
        Column("training views"),
        Column("unseen splats", format=","),
        Column("of the opacity-weighted area", format=".3%"),
        Column("bytes, dropped", format=","),
        Column("bytes, kept", format=","),
        Column("PSNR, dropped", "dB", ".3f"),
        Column("PSNR, kept", "dB", ".3f"),
    )
    for folder in args.scenes:
        scene, cameras = read(folder)
        views, judges = train_views(cameras), test_views(cameras)[:: args.every]
        wanted = pictures(device, scene, judges)
        beside = np.argsort(camera_centres(views)[:, 0], kind="stable")[: len(views) // 2]
        for which, used in (("all", views), ("half, of one side", [views[view] for view in beside])):
            row = []
            for choice in ("drop", "keep"):
                options = EncodeOptions.for_preset(args.preset, prune={"unseen": choice})
                encoded = encode(scene, used, options, device=device)
                got = pictures(device, decode(b"".join(encoded.pieces)), judges)
                mean = float(np.mean([psnr(a, b) for a, b in zip(wanted, got, strict=True)]))
                row.append((encoded.nbytes, mean))
                found = encoded.unseen
            assert found is not None
            (dropped, without), (kept, with_them) = row
            table.add(folder.name, which, found.splats, found.area, dropped, kept, without, with_them)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, work in (("judge", judge), ("unseen", unseen)):
        command = commands.add_parser(name)
        command.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
        command.add_argument("--json", type=Path, help="also keep the results here")
        command.set_defaults(run=work)
    command.add_argument("--device", help="as for potr-cl")
    command.add_argument("--preset", default="best")
    command.add_argument("--every", type=int, default=1, metavar="N", help="judge by every N-th test view only")
    args = parser.parse_args(argv)
    args.run(args)


if __name__ == "__main__":
    main()
