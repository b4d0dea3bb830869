"""Cameras as the original implementation's cameras.json has them: :func:`entry`."""

from __future__ import annotations

from typing import Any

from potr_cl.model.camera import Camera


def entry(number: int, camera: Camera) -> dict[str, Any]:
    """One element of the file's list; ``split`` is what this package adds."""
    return {
        "id": number,
        "img_name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.centre.tolist(),
        "rotation": camera.rotation.T.tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
        "split": camera.split,
    }
