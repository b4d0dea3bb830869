"""Cut the small excerpts in tests/data out of the full scenes.

    python -m tools.make.test_data SCENES

SCENES holds the folders ``lego`` and ``plush``, each with point_cloud.ply and cameras.json, lego with its
transforms_train.json and transforms_test.json, plush with a COLMAP model in sparse/0. Every run writes the same bytes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from potr_cl.formats.scenes import ply

_DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
_SPLATS = 1500
_PLUSH_VIEWS = 17  # three of them test views by the every-8th rule


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder that holds lego and plush")
    scenes = parser.parse_args().scenes
    _DATA.mkdir(exist_ok=True)
    _lego_splats(scenes / "lego" / "point_cloud.ply")
    names = _lego_cameras(scenes / "lego" / "cameras.json")
    for split in ("train", "test"):
        _lego_transforms(scenes / "lego" / f"transforms_{split}.json", names)
    _plush_views(scenes / "plush")
    print(f"{sum(f.stat().st_size for f in _DATA.rglob('*') if f.is_file())} bytes in {_DATA}")


def _lego_splats(source: Path) -> None:
    """A cube around the middle of the model: neighbours stay neighbours, as an octree expects them."""
    scene = ply.load(source)
    distance = np.abs(scene.means - np.median(scene.means, axis=0)).max(axis=1)
    nearest = np.sort(np.argsort(distance, kind="stable")[:_SPLATS])
    ply.save(_DATA / "lego_excerpt.ply", scene.subset(nearest))


def _lego_cameras(source: Path) -> set[str]:
    """Nine training and three test views, spread over the file."""
    views = json.loads(source.read_text())
    train = [view for view in views if view["split"] == "train"]
    test = [view for view in views if view["split"] == "test"]
    chosen = train[:: len(train) // 9][:9] + test[:: len(test) // 3][:3]
    _write_json(_DATA / "lego_cameras.json", chosen)
    return {view["img_name"] for view in chosen}


def _lego_transforms(source: Path, names: set[str]) -> None:
    content = json.loads(source.read_text())
    content["frames"] = [frame for frame in content["frames"] if Path(frame["file_path"]).name in names]
    _write_json(_DATA / "lego_transforms" / source.name, content)


def _plush_views(source: Path) -> None:
    views = json.loads((source / "cameras.json").read_text())[:_PLUSH_VIEWS]
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
