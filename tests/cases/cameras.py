"""Camera files that tests write, and what is asked of views that were read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from potr_cl import Camera, DataError, PotrError
from potr_cl.formats import load_cameras
from potr_cl.model.camera import resized


def assert_same_views(a: list[Camera], b: list[Camera], tolerance: float = 1e-5) -> None:
    """The same views, in any order."""
    by_name = {camera.name: camera for camera in b}
    assert sorted(camera.name for camera in a) == sorted(by_name)
    for one in a:
        two = by_name[one.name]
        np.testing.assert_allclose(one.rotation, two.rotation, atol=tolerance, err_msg=one.name)
        np.testing.assert_allclose(one.centre, two.centre, atol=tolerance, err_msg=one.name)
        for field in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(one, field) == pytest.approx(getattr(two, field), rel=1e-6), (one.name, field)
        assert one.split == two.split, one.name


def write_json(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def write_image(path: Path, width: int = 8, height: int = 6) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (width, height)).save(path)
    return path


def refused(path: Path, message: str, kind: type[PotrError] = DataError) -> None:
    with pytest.raises(kind, match=message) as caught:
        load_cameras(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def small(camera: Camera, width: int = 80) -> Camera:
    """The same view in so many columns."""
    return resized(camera, width, round(camera.height * width / camera.width))


def pixel(camera: Camera, point: list[float]) -> tuple[float, float]:
    """Where a world point appears, by Camera's definition."""
    t = camera.rotation @ np.array(point) + camera.translation
    assert t[2] > 0, "behind the camera"
    return camera.fx * t[0] / t[2] + camera.cx, camera.fy * t[1] / t[2] + camera.cy


def view(**changes: Any) -> dict[str, Any]:
    base = {
        "id": 0,
        "img_name": "a",
        "width": 40,
        "height": 30,
        "position": [1.0, 2.0, -5.0],
        "rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
        "fx": 50.0,
        "fy": 60,
    }
    return base | changes


IDENTITY = np.eye(4).tolist()


def nerfstudio(files: list[str], **changes: Any) -> dict[str, Any]:
    frames = [{"file_path": f"images/{file}", "transform_matrix": IDENTITY} for file in files]
    base = {"camera_model": "OPENCV", "fl_x": 50, "fl_y": 60, "cx": 21, "cy": 14, "w": 40, "h": 30, "k1": 0.0, "p1": 0}
    return base | {"frames": frames} | changes
