"""Cameras that are not in the scene's frame: which are found, by which margin, and what keeping unseen splats costs.

    python -m tools.study.frames judge SCENE SCENE … [--json FILE]
    python -m tools.study.frames made [--json FILE]
    python -m tools.study.frames unseen SCENE … [--json FILE] [--device DEVICE] [--preset fast]

``judge`` takes two scenes or more (point_cloud.ply and cameras.json in each), moves each in the ways in which scenes
are moved, and gives it the cameras of the next. It writes by how much the best motion fits better, and how much is
needed: found is what has more. Right cameras must have less. ``made`` does the same with scenes made by rule
(:mod:`tests.reference.captures`), for kinds of which no real one is at hand.

``unseen`` encodes each scene with and without the splats that no training view sees, with all its training views and
with half of them, those of one side.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from potr_cl.codec.decoder import decode
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.camera import Camera, camera_centres, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tests.reference.captures import CAPTURES
from tests.reference.frames import right, without_directions, wrong
from tools.results import Column, Results, Table
from tools.workloads import pictures, read


def judge(args: argparse.Namespace) -> None:
    """Right and wrong cameras of real scenes."""
    _judge(
        Results(None, args.json), "real", "Scenes of captures", {folder.name: read(folder) for folder in args.scenes}
    )


def made(args: argparse.Namespace) -> None:
    """Right and wrong cameras of scenes made by rule."""
    _judge(Results(None, args.json), "made", "Scenes made by rule", {name: make() for name, make in CAPTURES.items()})


def _judge(results: Results, name: str, what: str, scenes: dict[str, tuple[Scene, list[Camera]]]) -> None:
    columns = (
        Column("scene"),
        Column("SH degree"),
        Column("cameras"),
        Column("gain", format="+.2f"),
        Column("needed", format=".2f"),
        Column("time", "s", ".2f"),
        Column("verdict"),
        Column("said"),
    )
    views = {folder: train_views(cameras) for folder, (_, cameras) in scenes.items()}
    names = list(scenes)
    table = results.table(f"{name}_right", f"{what}: cameras in the scene's frame", *columns)
    for folder, scene in _of_both_degrees(scenes):
        for which, cameras in right(scene, views[folder], others=name == "real"):
            _add(table, folder, which, scene, cameras)
    table = results.table(f"{name}_wrong", f"{what}: cameras in another frame", *columns)
    for folder, scene in _of_both_degrees(scenes):
        other = names[(names.index(folder) + 1) % len(names)]
        for which, moved, cameras in wrong(scene, views[folder], views[other]):
            _add(table, folder, which, moved, cameras)


def _of_both_degrees(scenes: dict[str, tuple[Scene, list[Camera]]]) -> Iterator[tuple[str, Scene]]:
    for folder, (scene, _) in scenes.items():
        yield folder, scene
        yield folder, without_directions(scene)


def _add(table: Table, name: str, what: str, scene: Scene, cameras: list[Camera]) -> None:
    began = time.process_time()
    judged = judge_cameras(scene, cameras)
    seconds = time.process_time() - began
    tried = judged.motion is not None
    table.add(
        name,
        scene.sh_degree,
        what,
        judged.gain if tried else None,
        judged.needed if tried else None,
        seconds,
        "refused" if judged.suspicious else "taken",
        judged.motion.name if judged.motion is not None and judged.suspicious else "",
    )


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
    for name, work in (("judge", judge), ("made", made), ("unseen", unseen)):
        command = commands.add_parser(name)
        if work is not made:
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
