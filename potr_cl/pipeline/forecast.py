"""What an encode will take, before it begins (:func:`forecast`): seconds and bytes, roughly.

Nearly all of the time goes into projecting, sorting and compositing splats, view by view. So a few views are rendered,
and their mean time, as a unit, is multiplied by what each stage was measured to take in such units. This sees the
device, the scene and the size of the pictures, and whatever else the machine is doing.
``python -m tools.bench.forecast`` measures the units, and how far off a forecast is.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.sweep_options import default_memory
from potr_cl.stages.refit import Refit

#: Views that are rendered to see how long one takes.
_SAMPLE = 4
#: Plain encodes that a search takes the time of.
_SEARCH = 3
#: Bytes of the process with its libraries; a splat, on the host and on the device; a pixel, of the picture that a view
#: is to have; and what is kept of views and besides, as a multiple of these and of what a view's own buffers take.
_PROCESS, _HOST_SPLAT, _DEVICE_SPLAT, _PIXEL, _VIEWS = 180e6, 1550, 154, 12, 1.02


@dataclass(frozen=True)
class Forecast:
    """What an encode is expected to take.

    Attributes:
        seconds: from the first stage to the last; reading, judging and writing come on top.
        memory: bytes at the peak: the whole process's on a CPU, the device's on a GPU.
        sampled: seconds of a view, as measured.
    """

    seconds: float
    memory: float
    sampled: float


@dataclass(frozen=True)
class Units:
    """What stages take, as multiples of the time of one picture of the uncompressed scene, for each training view.

    Attributes:
        prepare, prune, compact, refit: once a view.
        iteration, step: a pruning iteration and a step of the re-fit, besides.
        splat: seconds to quantise and code a splat that is left.
    """

    prepare: float
    prune: float
    iteration: float
    compact: float
    refit: float
    step: float
    splat: float


#: Measured by tools.bench.forecast.
UNITS: dict[Family, Units] = {
    "cpu": Units(prepare=1.1, prune=2.0, iteration=0.12, compact=2.0, refit=1.0, step=0.65, splat=4e-6),
    "gpu": Units(prepare=0.8, prune=2.0, iteration=0.04, compact=6.0, refit=2.5, step=1.2, splat=3e-6),
}


def forecast(
    scene: Scene, cameras: Sequence[Camera], options: EncodeOptions, device: Device, search: bool = False
) -> Forecast:
    """Render a few views, and say from their time what an encode will take.

    Args:
        scene, options, device: of the encode.
        cameras: its training views, at least one.
        search: whether the encode is repeated to meet a size or a PSNR.

    Raises:
        DeviceError: the device cannot render the views.
    """
    seconds, nbytes = _view(scene, cameras, options, device)
    parts = {stage.name: stage for stage in options.stages if stage.asked_for and stage.looks_at(scene)}
    units = UNITS[device.family]
    of_a_view = units.prepare
    if isinstance(prune := parts.get(Prune.name), Prune):
        of_a_view += units.prune + units.iteration * prune.iterations
    if Compact.name in parts:
        of_a_view += units.compact
    if isinstance(refit := parts.get(Refit.name), Refit):
        of_a_view += units.refit + units.step * refit.steps
    work = len(cameras) * seconds * of_a_view + len(scene) * units.splat
    budget = default_memory(device) if options.memory is None else options.memory
    memory = len(scene) * _DEVICE_SPLAT + min(len(cameras) * nbytes * _VIEWS, budget)
    if device.info.kind == "cpu":
        memory += _PROCESS + len(scene) * _HOST_SPLAT
    return Forecast(work * (_SEARCH if search else 1), memory, seconds)


def _view(scene: Scene, cameras: Sequence[Camera], options: EncodeOptions, device: Device) -> tuple[float, float]:
    """Seconds that a picture takes, and bytes of what can be kept of a view: means of a few."""
    chosen = [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, min(_SAMPLE, len(cameras)))]
    seconds, nbytes = [], []
    with Rasterizer(device, scene, background=options.background) as rasterizer:
        for number, camera in enumerate([chosen[0], *chosen]):
            began = time.perf_counter()
            rasterizer.render_device(camera)
            device.queue.finish()
            if number:  # the first time buffers are made
                seconds.append(time.perf_counter() - began)
        for camera in chosen:
            before = device.allocated
            with rasterizer.prepare_set([camera]):
                nbytes.append(device.allocated - before + _PIXEL * camera.width * camera.height)
    return float(np.mean(seconds)), float(np.mean(nbytes))
