"""What is left of a scene where nobody has photographed it? Files with cameras and without, seen from elsewhere.

    python -m tools.study.elsewhere SCENE … [--presets best smallest] [--width 400] [--json FILE] [--device DEVICE]

A SCENE is a folder with point_cloud.ply and cameras.json. It is encoded with its training cameras and with virtual
ones, and judged by kinds of views that a visitor takes and a photographer has not (:func:`kinds_of_views`): mean PSNR
against the uncompressed scene's pictures, and the PSNR of the worst view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.decoder import decode
from potr_cl.model.camera import Camera, camera_centres, focus, resized, test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.metrics import psnr
from tools.results import Column, Results
from tools.workloads import pictures, read, scene_parser

F64 = NDArray[np.float64]

#: Views of each kind; and what identical pictures count as, dB.
_VIEWS, _IDENTICAL = 12, 99.0


def kinds_of_views(cameras: Sequence[Camera]) -> dict[str, list[Camera]]:
    """Views by what they are: the test views, and training views that are moved or turned.

    "Far" is along the line to the point that the cameras look at; "higher" and "lower" go about it, as the cameras' own
    up says; "aside" turns the camera where it stands.
    """
    views = train_views(cameras)
    at = focus(views)
    up = -np.mean([camera.rotation[1] for camera in views], axis=0)
    up /= np.linalg.norm(up)
    some = [views[number] for number in np.unique(np.linspace(0, len(views) - 1, _VIEWS).astype(int))]

    def moved(camera: Camera, part: float) -> Camera:
        return _posed(camera, camera.rotation, at + part * (camera.centre - at))

    def lifted(camera: Camera, angle: float) -> Camera:
        away = camera.centre - at
        turn = _turn(np.cross(away, up), angle)
        return _posed(camera, camera.rotation @ turn.T, at + turn @ away)

    return {
        "test views": test_views(cameras) or some,
        "between two": [_between(camera, views) for camera in some],
        "half as far": [moved(camera, 0.5) for camera in some],
        "3 times as far": [moved(camera, 3) for camera in some],
        "25° higher": [lifted(camera, 25) for camera in some],
        "25° lower": [lifted(camera, -25) for camera in some],
        "40° aside": [
            _posed(camera, camera.rotation @ _turn(up, 40 * (-1) ** number).T, camera.centre)
            for number, camera in enumerate(some)
        ],
    }


def _posed(camera: Camera, rotation: F64, centre: F64) -> Camera:
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ centre, image_path=None, lens=None)


def _turn(axis: F64, angle: float) -> F64:
    """A rotation by so many degrees about an axis (Rodrigues' formula)."""
    x, y, z = axis / np.linalg.norm(axis)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    t = np.radians(angle)
    return np.asarray(np.eye(3) + np.sin(t) * across + (1 - np.cos(t)) * across @ across)


def _between(camera: Camera, views: Sequence[Camera]) -> Camera:
    """Half way from a view to the nearest other one."""
    distances = np.linalg.norm(camera_centres(views) - camera.centre, axis=1)
    other = views[int(np.argsort(distances, kind="stable")[min(1, len(views) - 1)])]
    left, _, right = np.linalg.svd(camera.rotation + other.rotation)
    return _posed(camera, left @ right, (camera.centre + other.centre) / 2)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = scene_parser(__doc__)
    parser.add_argument("--presets", nargs="+", default=["best", "smallest"])
    parser.add_argument("--width", type=int, default=400, metavar="PIXELS", help="of the views that judge; default 400")
    args = parser.parse_args(argv)
    device = Device(args.device)
    results = Results(device.info, args.json)
    table = None
    for folder in map(Path, args.scenes):
        scene, cameras = read(folder)
        kinds = {
            kind: [resized(view, args.width, round(args.width * view.height / view.width)) for view in views]
            for kind, views in kinds_of_views(cameras).items()
        }
        if table is None:
            table = results.table(
                "elsewhere",
                f"PSNR against the uncompressed scene, mean / worst view, dB; q 0.5, views {args.width} pixels wide",
                Column("scene"),
                Column("preset"),
                Column("cameras"),
                Column("bytes", format=","),
                *(Column(kind, format="{:.1f} / {:.1f}") for kind in kinds),
            )
        wanted = {kind: pictures(device, scene, views) for kind, views in kinds.items()}
        for preset in args.presets:
            for which, given in (("true", cameras), ("virtual", None)):
                views = None if given is None else train_views(given)
                encoded = encode(scene, views, EncodeOptions.for_preset(preset), device=device)
                back = decode(b"".join(encoded.pieces))
                cells = []
                for kind, judges in kinds.items():
                    both = zip(wanted[kind], pictures(device, back, judges), strict=True)
                    found = [min(psnr(a, b), _IDENTICAL) for a, b in both]
                    cells.append([float(np.mean(found)), float(np.min(found))])
                table.add(folder.name, preset, which, encoded.nbytes, *cells)


if __name__ == "__main__":
    main()
