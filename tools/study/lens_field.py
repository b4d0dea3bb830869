"""Which pinhole view should stand for a distorted photograph when a scene is encoded?

The cameras of a scene are given a lens that bends, as if its photographs had been taken with one. The scene is encoded
three times: looked at from the pinhole part of the cameras (the same size, focal length and principal point), from the
largest views that the photographs fill, and from those that cover their field. All are judged by the test views, in the
pixels that the bent photographs show.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl import EncodeOptions, encode, load_cameras, load_scene
from potr_cl.codec.decoder import open_file
from potr_cl.model.camera import Camera, test_views
from potr_cl.model.lens import Lens, Pinhole
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder with point_cloud.ply and cameras.json")
    parser.add_argument("--k1", type=float, default=-0.15, help="of the lens; default -0.15, a barrel")
    parser.add_argument("--divide", type=int, default=3, metavar="N", help="the pictures' sides; default 3")
    parser.add_argument("--preset", default="fast")
    args = parser.parse_args()
    scene, cameras = load_scene(args.scene / "point_cloud.ply"), load_cameras(args.scene / "cameras.json")
    lens = _lens(cameras[0], args.k1, args.divide)
    covering = lens.covering()[0]
    ways = {"pinhole part": _pinhole_part(lens), "filled": lens.within(), "covering": covering}
    shown = _shown(lens, covering)
    middle = shown & _within(covering, ways["pinhole part"])
    device = Device()
    tests = [replace(camera, **covering._asdict()) for camera in test_views(cameras)]
    wanted = _pictures(device, scene, tests)
    print(f"{100 * (1 - middle.sum() / shown.sum()):.1f} % of the photographs are outside of the pinhole part\n")
    print("| views | size | bytes | PSNR, dB | inside the pinhole part | outside |")
    print("|---|---|---|---|---|---|")
    for name, view in ways.items():
        looked = [replace(camera, **view._asdict()) for camera in cameras]
        encoded = encode(scene, looked, EncodeOptions.for_preset(args.preset), device=device)
        decoded = open_file(b"".join(encoded.pieces)).scene()
        found = _pictures(device, decoded, tests)
        cells = [_psnr(wanted, found, where) for where in (shown, middle, shown & ~middle)]
        print(f"| {name} | {view.width} x {view.height} | {encoded.nbytes:,} | {' | '.join(cells)} |", flush=True)


def _lens(camera: Camera, k1: float, divide: int) -> Lens:
    width, height = camera.width // divide, camera.height // divide
    return Lens(width, height, camera.fx / divide, camera.fy / divide, width / 2, height / 2, radial=(k1,))


def _pinhole_part(lens: Lens) -> Pinhole:
    return Pinhole(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)


def _points(view: Pinhole) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and y on the image plane of all pixels."""
    x, y = np.arange(view.width) + 0.5, np.arange(view.height) + 0.5
    across, down = np.meshgrid((x - view.cx) / view.fx, (y - view.cy) / view.fy)
    return across, down


def _shown(lens: Lens, view: Pinhole) -> NDArray[np.bool_]:
    """(height, width): the pixels of a view that the photograph shows."""
    u, v = lens.distorted(*_points(view))
    shown: NDArray[np.bool_] = (np.abs(u * lens.fx) <= lens.width / 2) & (np.abs(v * lens.fy) <= lens.height / 2)
    return shown


def _within(view: Pinhole, other: Pinhole) -> NDArray[np.bool_]:
    """(height, width): the pixels of a view that another one shows too."""
    x, y = _points(view)
    inside: NDArray[np.bool_] = (np.abs(x * other.fx) <= other.width / 2) & (np.abs(y * other.fy) <= other.height / 2)
    return inside


def _pictures(device: Device, scene: Scene, cameras: list[Camera]) -> list[NDArray[np.float32]]:
    with Rasterizer(device, scene) as rasterizer:
        return [np.clip(rasterizer.render(camera)[0], 0, 1) for camera in cameras]


def _psnr(wanted: list[NDArray[np.float32]], found: list[NDArray[np.float32]], where: NDArray[np.bool_]) -> str:
    """Mean over the pictures that differ in some pixels of each; what there is to say where none does."""
    if not where.any():
        return "-"
    errors = np.array([((a - b)[where].astype(np.float64) ** 2).mean() for a, b in zip(wanted, found, strict=True)])
    return f"{np.mean(-10 * np.log10(errors[errors > 0])):.2f}" if errors.any() else "identical"


if __name__ == "__main__":
    main()
