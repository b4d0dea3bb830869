"""Cut the small excerpts in tests/data out of the scene plush.

    python -m tools.make.test_data SCENES

SCENES holds the folder ``plush`` with point_cloud.ply, cameras.json, and a COLMAP model in sparse/0. Every run writes
the same bytes. No other scene of ours may be used: plush alone is from photographs under a free licence.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from potr_cl.formats import load_cameras
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from tools.workloads import camera_entry

_DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
_SPLATS = 1500
#: The brooch at the toy's chest: many small splats of many colours.
_MIDDLE = np.array([-0.76, 1.57, 2.78])
_TRAIN_VIEWS, _TEST_VIEWS = 9, 3
#: Pixels and focal length of the excerpt's views.
_WIDTH, _HEIGHT, _FOCAL = 240, 180, 750.0
_VIEWS_OF_THE_WHOLE = 17  # three of them test views by the every-8th rule


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder that holds plush")
    source = parser.parse_args().scenes / "plush"
    _DATA.mkdir(exist_ok=True)
    excerpt = _splats(source / "point_cloud.ply")
    views = _views_of_the_excerpt(load_cameras(source / "cameras.json"), excerpt)
    _write_json(_DATA / "plush_excerpt_cameras.json", [camera_entry(number, view) for number, view in enumerate(views)])
    _write_transforms(views)
    _views_of_the_whole(source)
    print(f"{sum(f.stat().st_size for f in _DATA.rglob('*') if f.is_file())} bytes in {_DATA}")


def _splats(source: Path) -> Scene:
    """A cube: neighbours stay neighbours, as an octree expects them."""
    scene = ply.load(source)
    distance = np.abs(scene.means - _MIDDLE).max(axis=1)
    excerpt = scene.subset(np.sort(np.argsort(distance, kind="stable")[:_SPLATS]))
    ply.save(_DATA / "plush_excerpt.ply", excerpt)
    return excerpt


def _views_of_the_excerpt(cameras: Sequence[Camera], excerpt: Scene) -> list[Camera]:
    """Training and test views that see all of it, spread over those that do.

    They are taken from where the photographs were taken, but turned towards the excerpt, and show little more than it.
    """
    seeing = [view for view in map(_turned, cameras) if _sees_all(view, excerpt)]
    chosen = []
    for views, count in ((train_views(seeing), _TRAIN_VIEWS), (test_views(seeing), _TEST_VIEWS)):
        chosen += [views[round(place)] for place in np.linspace(0, len(views) - 1, count)]
    return chosen


def _turned(camera: Camera) -> Camera:
    forward = _MIDDLE - camera.centre
    forward /= np.linalg.norm(forward)
    right = camera.rotation[0] - forward * (camera.rotation[0] @ forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        name=camera.name, width=_WIDTH, height=_HEIGHT, fx=_FOCAL, fy=_FOCAL, cx=_WIDTH / 2, cy=_HEIGHT / 2,
        rotation=rotation, translation=-rotation @ camera.centre, split=camera.split,
    )  # fmt: skip


def _sees_all(camera: Camera, scene: Scene) -> bool:
    x, y, z = camera.rotation @ (scene.means.T.astype(float) - camera.centre[:, None])
    if z.min() <= 0:
        return False
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool(column.min() > 0 and column.max() < camera.width and row.min() > 0 and row.max() < camera.height)


def _write_transforms(cameras: Sequence[Camera]) -> None:
    """The same views as Blender's transforms_train.json and transforms_test.json."""
    for split in ("train", "test"):
        views = [camera for camera in cameras if camera.split == split]
        content = {
            "camera_angle_x": 2 * math.atan(views[0].width / (2 * views[0].fx)),
            "frames": [{"file_path": f"./images/{v.name}", "transform_matrix": _blenders(v)} for v in views],
        }
        _write_json(_DATA / "plush_transforms" / f"transforms_{split}.json", content)


def _blenders(camera: Camera) -> list[list[float]]:
    """Camera to world with y up and looking along -z."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T * [1, -1, -1]
    matrix[:3, 3] = camera.centre
    rows: list[list[float]] = matrix.tolist()
    return rows


def _views_of_the_whole(source: Path) -> None:
    views = json.loads((source / "cameras.json").read_text())[:_VIEWS_OF_THE_WHOLE]
    _write_json(_DATA / "plush_cameras.json", views)
    model = pycolmap.Reconstruction(source / "sparse" / "0")
    names = {view["img_name"] for view in views}
    for image in list(model.images.values()):
        if Path(image.name).stem not in names:
            model.deregister_frame(image.frame_id)
    model.delete_all_points2D_and_points3D()
    for ending, write in (("binary", model.write_binary), ("text", model.write_text)):
        folder = _DATA / f"plush_sparse_{ending}"
        folder.mkdir(exist_ok=True)
        write(folder)
        for part in ("points3D", "frames", "rigs"):  # not needed for the views
            for file in folder.glob(f"{part}.*"):
                file.unlink()


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
