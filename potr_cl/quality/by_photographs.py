"""Judge a scene and its file by photographs: :func:`judge_by_photographs`."""

from __future__ import annotations

from collections.abc import Sequence

from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.quality.ground_truth import GroundTruth, PhotographFigures
from potr_cl.quality.judging import Judging, Looks
from potr_cl.raster.resident import ResidentScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.workers.pool import Pool


def judge_by_photographs(
    ground_truth: GroundTruth,
    cameras: Sequence[Camera],
    scenes: tuple[Scene | ResidentScene, Drawable],
    device: Device,
    background: Colour = (0.0, 0.0, 0.0),
    pool: Pool | None = None,
) -> PhotographFigures:
    """Judge a scene and its file by photographs of test views; where no test view has one, of training views.

    Args:
        ground_truth: the photographs.
        cameras: all of the scene's.
        scenes: uncompressed, and as a decoder sees the file.
        device: to render on.
        background: behind both.
        pool: workers that views are shared out to, if they are devices of this computer, which has the photographs.

    Raises:
        UsageError, DataError: a photograph cannot be read.
        DeviceError: a view does not fit the device.
    """
    views, kind = ground_truth.of(test_views(cameras)), "test"
    if not views:
        views, kind = ground_truth.of(train_views(cameras)), "train"
    reference, candidate = scenes
    near = pool if pool is not None and pool.in_process else None
    with Judging(device, reference, views, Looks(background), near) as judging:
        psnrs = judging.by_photographs(candidate, ground_truth)
    names = [camera.name for camera in views]
    return PhotographFigures(
        names, kind, [of_reference for of_reference, _ in psnrs], [of_file for _, of_file in psnrs]
    )
