"""A city of any size: copies of trained scenes side by side on a grid, with views of each copy and some across.

    python -m tools.make.city SCENE... -o OUT --splats 10e6 --views 300 [--test-views 20] [--size 1600x1064]

A SCENE is a folder that holds point_cloud.ply and cameras.json, or a .ply file with its cameras after a comma. OUT gets
the same two files. The scenes take turns on the grid; each copy is turned about the up axis, with its SH coefficients,
and is as large as its cameras stand apart, so that these fit into its cell too. What lies outside of the cell is left
out; of the last copy some splats, drawn at random. The PLY is written copy by copy. Every run writes the same bytes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import Camera, camera_centres, focus, test_views, train_views
from potr_cl.model.scene import Scene
from tests.reference.captures import looking
from tests.reference.frames import moved
from tools.workloads import camera_entry

F64 = NDArray[np.float64]

#: A cell's half edge, in the largest distance of the copy's cameras from its axis.
_HALF_CELL = 1.1
#: Copies of a scene are turned by one of so many angles, which are no multiples of each other.
_TURNS, _ANGLE = 4, 2.4
#: Which part of the views look from a corner of a cell at the middle of another.
_ACROSS = 0.1


@dataclass(frozen=True)
class Building:
    """A trained scene, upright on its cell: z is up, the middle of what its cameras look at the origin.

    Attributes:
        scene: within the cell.
        cameras: each within the cell.
    """

    scene: Scene
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(scene: Scene, cameras: Sequence[Camera]) -> Building:
        """Turn a scene upright, and make it so large that its cameras stand at distances up to 1 from the axis."""
        trained = train_views(cameras)
        up = -np.mean([camera.rotation[1] for camera in trained], axis=0)
        up /= np.linalg.norm(up)
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(up, across), up])
        middle = focus(trained)
        offsets = (camera_centres(cameras) - middle) @ axes.T
        scale = 1 / float(np.hypot(offsets[:, 0], offsets[:, 1]).max())
        shift = -scale * axes @ middle
        upright = moved(scene, axes, scale, shift.tolist())
        inside = (np.abs(upright.means[:, :2]) <= _HALF_CELL).all(axis=1)
        turned = [_moved_camera(camera, axes, scale, shift) for camera in cameras]
        return Building(upright.subset(np.flatnonzero(inside)), tuple(turned))


@dataclass(frozen=True)
class City:
    """Copies of buildings on a grid.

    Attributes:
        buildings: that take turns.
        splats: of all copies together.
    """

    buildings: Sequence[Building]
    splats: int

    @property
    def copies(self) -> int:
        """How many there are; the last may lack some splats."""
        sizes = [len(building.scene) for building in self.buildings]
        rounds, left = divmod(self.splats, sum(sizes))
        return rounds * len(sizes) + sum(before < left for before in accumulate(sizes[:-1], initial=0))

    def parts(self) -> Iterator[Scene]:
        """The copies one after another, as they stand."""
        turned = lru_cache(maxsize=_TURNS * len(self.buildings))(self._turned)
        left = self.splats
        for copy in range(self.copies):
            scene = turned(copy % len(self.buildings), self._turn(copy))
            if left < len(scene):
                some = np.random.default_rng(0).permutation(len(scene))[:left]
                scene = scene.subset(np.sort(some))
            left -= len(scene)
            yield dataclasses.replace(scene, means=scene.means + self._place(copy).astype(np.float32))

    def views(self, count: int, width: int, height: int, split: str = "train", across: float = _ACROSS) -> list[Camera]:
        """Views of a split, the same number of each copy as nearly as may be; ``across`` of them look across cells."""
        looking_across = round(count * across) if self.copies > 1 else 0
        found = []
        for number in range(count - looking_across):
            copy = number * self.copies // (count - looking_across)
            building = self.buildings[copy % len(self.buildings)]
            views = (train_views if split == "train" else test_views)(building.cameras) or list(building.cameras)
            # The golden ratio spreads any number of them over the views of a copy.
            chosen = views[int(len(views) * (number * 0.6180339887498949 % 1))]
            found.append(_moved_camera(chosen, _yaw(self._turn(copy)), 1.0, self._place(copy)))
        for number in range(looking_across):
            copy = number * self.copies // looking_across
            here = self._place(copy) + _HALF_CELL * np.array([1.0, 1.0, 0.6])
            there = self._place((copy + self.copies // 2 + (split == "test")) % self.copies)
            found.append(looking(here, there))
        return [
            of_size(dataclasses.replace(camera, name=f"{split}_{number:04}", split=split), width, height)
            for number, camera in enumerate(found)
        ]

    def _turn(self, copy: int) -> int:
        return copy // len(self.buildings) % _TURNS

    def _turned(self, building: int, turn: int) -> Scene:
        return moved(self.buildings[building].scene, _yaw(turn))

    def _place(self, copy: int) -> F64:
        columns = math.isqrt(self.copies - 1) + 1
        return 2 * _HALF_CELL * np.array([copy % columns, copy // columns, 0.0])


def write_city(folder: Path, city: City, cameras: Sequence[Camera]) -> None:
    """Write point_cloud.ply, copy by copy, and cameras.json."""
    folder.mkdir(parents=True, exist_ok=True)
    write_cameras(folder, cameras)
    ply.save_parts(folder / "point_cloud.ply", city.parts(), city.splats)


def write_cameras(folder: Path, cameras: Sequence[Camera]) -> None:
    """Write cameras.json alone."""
    (folder / "cameras.json").write_text(json.dumps([camera_entry(n, view) for n, view in enumerate(cameras)]))


def _yaw(turn: int) -> F64:
    c, s = math.cos(_ANGLE * turn), math.sin(_ANGLE * turn)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _moved_camera(camera: Camera, axes: F64, scale: float, shift: F64) -> Camera:
    rotation = camera.rotation @ axes.T
    centre = scale * axes @ camera.centre + shift
    return dataclasses.replace(camera, rotation=rotation, translation=-rotation @ centre, image_path=None, lens=None)


def of_size(camera: Camera, width: int, height: int) -> Camera:
    """The same field from left to right, with square pixels and the principal point in the middle."""
    focal = camera.fx * width / camera.width
    return dataclasses.replace(camera, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def building_of(source: str) -> Building:
    """That of a folder with point_cloud.ply and cameras.json, or of "scene.ply,cameras.json"."""
    file, _, cameras = source.partition(",")
    scene = Path(file)
    if not cameras:
        scene, cameras = scene / "point_cloud.ply", str(scene / "cameras.json")
    return Building.of(load_scene(scene), load_cameras(cameras))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="a folder, or scene.ply,cameras.json")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="a folder")
    parser.add_argument("--splats", type=float, required=True, metavar="N")
    parser.add_argument("--views", type=int, default=300, metavar="N", help="training views")
    parser.add_argument("--test-views", type=int, default=20, metavar="N")
    parser.add_argument("--across", type=float, default=_ACROSS, metavar="PART", help="of the views look across cells")
    parser.add_argument("--size", default="1600x1064", metavar="WxH")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    city = City([building_of(source) for source in args.scenes], int(args.splats))
    cameras = [
        *city.views(args.views, width, height, "train", args.across),
        *city.views(args.test_views, width, height, "test", args.across),
    ]
    write_city(args.output, city, cameras)
    print(f"{city.splats} splats, {city.copies} copies, {len(cameras)} views in {args.output}")


if __name__ == "__main__":
    main()
