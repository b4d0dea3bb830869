"""A small scene, and photographs of it as files: what fits to photographs are tried on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats.images import to_8_bits, write_png
from potr_cl.model.camera import Camera
from potr_cl.model.lens import Lens
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tests.reference.scenes import random_scene

#: What becomes of a picture before it is written; the same generator is given for all pictures.
Change = Callable[[FloatArray, np.random.Generator], FloatArray]


def photographed_scene() -> Scene:
    """200 splats that cover some pixels each in pictures of 48 x 48."""
    return dataclasses.replace(random_scene(200, 1), log_scales=np.full((200, 3), -2, np.float32))


def photographs(
    folder: Path, device: Device, scene: Scene, cameras: Sequence[Camera], change: Change | None = None
) -> Path:
    """Write what the cameras see of a scene as files named after them; returns the folder."""
    generator = np.random.default_rng(7)
    with Rasterizer(device, scene) as rasterizer:
        for camera in cameras:
            picture = rasterizer.render(camera)[0]
            if change is not None:
                picture = change(picture, generator)
            with (folder / f"{camera.name}.png").open("wb") as file:
                write_png(file, to_8_bits(picture))
    return folder


def bent(picture: FloatArray, view: Camera, lens: Lens) -> NDArray[np.uint8]:
    """The photograph that a lens makes of what a view shows, of the nearest pixels."""
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    x, y = lens.undistorted(((columns - lens.cx) / lens.fx).ravel(), ((rows - lens.cy) / lens.fy).ravel())[0]
    columns = (x * view.fx + view.cx).astype(int).clip(0, view.width - 1)
    rows = (y * view.fy + view.cy).astype(int).clip(0, view.height - 1)
    return to_8_bits(picture[rows, columns].reshape(lens.height, lens.width, 3))
