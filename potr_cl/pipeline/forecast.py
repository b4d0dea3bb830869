"""What an encode will take, before it begins (:func:`forecast`): seconds and bytes, roughly.

Nearly all of the time goes into projecting, sorting and compositing splats, view by view. So a few views are rendered,
and the mean of their times, as a unit, is multiplied by what each stage was measured to take in such units. This sees
the device, the scene and the size of the pictures, and what the machine is doing besides, unless that lasts a moment.
``python -m tools.bench.forecast`` measures the units, and how far off a forecast is (docs/benchmarks/forecast.md).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.between.amount import most_needed, needed_of_virtual
from potr_cl.stages.compact import Compact
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.memory import fit_bytes
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.sweep_options import default_memory
from potr_cl.stages.pruning.visible_parts import LEAST_SPLATS
from potr_cl.stages.refit import Refit
from potr_cl.stages.views_between import Between

#: Views that are rendered to see how long one takes; and how often each is at the most, where that takes no longer than
#: so many seconds: other work comes and goes, and may take a device away for longer than a view does.
_SAMPLE, _MOST_OFTEN, _ENOUGH = 4, 9, 0.1
#: Plain encodes that a search takes the time of.
_SEARCH = 3
#: Of the time of a view of a step of the fit at q = 0.5, what is left at q = 0: with q, the splats that it moves become
#: more, from a fifth of lego's at 0.3 to two fifths at 0.5.
_NONE_LEFT = 0.25
#: Bytes of the process with its libraries; a splat, on the host and on the device; a pixel, of the picture that a view
#: is to have; and what is kept of views and besides, as a multiple of these and of what a view's own buffers take.
_PROCESS, _HOST_SPLAT, _DEVICE_SPLAT, _PIXEL, _VIEWS = 180e6, 1550, 154, 12, 1.02


@dataclass(frozen=True)
class Forecast:
    """What an encode is expected to take.

    Attributes:
        seconds: from the first stage to the last; reading, judging and writing come on top.
        memory: bytes at the peak: the whole process's on a CPU, the device's on a GPU.
        sampled: seconds of a picture, as measured.
        pictures: how many pictures' times the stages up to the re-fit are expected to take.
    """

    seconds: float
    memory: float
    sampled: float
    pictures: float


@dataclass(frozen=True)
class Units:
    """What stages take.

    Attributes:
        prepare, prune, compact, refit: once for each training view, as multiples of the time of one picture of the
            uncompressed scene.
        iteration, step: a pruning iteration and a step of the re-fit, for each view, besides.
        fit: a view of a step of the fit, at q = 0.5; it is more where a larger q leaves more splats.
        once: pictures' times that the re-fit takes besides, whatever the number of views.
        compact_splat, refit_splat, code_splat: seconds that compaction, the re-fit and the coding take besides, for
            each splat of the uncompressed scene.
    """

    prepare: float
    prune: float
    iteration: float
    fit: float
    compact: float
    refit: float
    step: float
    once: float
    compact_splat: float
    refit_splat: float
    code_splat: float


#: From tools.bench.forecast for CPUs, and from docs/benchmarks/encode.md for GPUs, where the host does a good part.
UNITS: dict[Family, Units] = {
    "cpu": Units(1.0, 3.0, 0.035, 1.7, 2.0, 4.7, 0.33, 20, 0, 0, 4e-6),
    "gpu": Units(0.9, 2.0, 0.042, 0.9, 0, 0, 0.45, 0, 3.5e-6, 1.45e-6, 1.5e-6),
}


def forecast(
    scene: Scene,
    cameras: Sequence[Camera],
    options: EncodeOptions,
    device: Device,
    search: bool = False,
    kept: KeptScene | None = None,
) -> Forecast:
    """Render a few views, and say from their time what an encode will take.

    Args:
        scene, options, device: of the encode.
        cameras: its training views, at least one.
        search: whether the encode is repeated to meet a size or a PSNR.
        kept: the scene on the device, if it lies there already.

    Raises:
        DeviceError: the device cannot render the views.
    """
    seconds, nbytes = _view(scene if kept is None else kept.drawable(device, scene), cameras, options, device)
    parts = {stage.name: stage for stage in options.stages if stage.asked_for and stage.looks_at(scene)}
    units = UNITS[device.family]
    views, of_a_splat = float(len(cameras)), units.code_splat
    if isinstance(between := parts.get(Between.name), Between) and len(cameras) > 1:
        each, slow = between.views, device.info.kind == "cpu"
        if each == "auto":  # nobody knows yet how many the scene needs
            each = needed_of_virtual(slow) if is_virtual(cameras) else most_needed(len(cameras), slow)
        views *= 1 + each
    pictures = views * units.prepare
    if isinstance(prune := parts.get(Prune.name), Prune):
        pictures += views * (units.prune + units.iteration * prune.iterations)
    if isinstance(fit := parts.get(Fit.name), Fit):
        steps = fit.steps_on(device.family)
        if isinstance(refit := parts.get(Refit.name), Refit) and refit.ground_truth is not None:
            steps += fit.photograph_steps_on(device.family, len(cameras))
        else:
            steps += fit.further_steps_on(device.family)
        pictures += steps * fit.batch * units.fit * (_NONE_LEFT + (1 - _NONE_LEFT) * options.q / 0.5)
        pictures += views * (fit.views_on(device.family) + units.prepare + units.iteration * fit.iterations)
    if Compact.name in parts:
        pictures += views * units.compact
        of_a_splat += units.compact_splat
    if isinstance(refit := parts.get(Refit.name), Refit):
        pictures += units.once + views * (units.refit + units.step * refit.steps)
        pictures += len(refit.at) * views * (units.refit + units.step * refit.at_steps)
        of_a_splat += units.refit_splat
    work = pictures * seconds + len(scene) * of_a_splat
    budget = default_memory(device) if options.memory is None else options.memory
    memory = len(scene) * _DEVICE_SPLAT + min(views * nbytes * _VIEWS, budget)
    if isinstance(fit, Fit):
        pixels = float(np.mean([camera.width * camera.height for camera in cameras]))
        together = fit.batch if device.family == "gpu" else 1
        view = nbytes - _PIXEL * pixels
        needed = fit_bytes(len(scene), len(scene), 3 * scene.sh.shape[1], together, int(views), view, pixels, budget)
        memory = max(memory, needed)
    if device.info.kind == "cpu":
        memory += _PROCESS + len(scene) * _HOST_SPLAT
        if options.memory is not None and len(scene) >= LEAST_SPLATS:
            # Views of large scenes leave room for the host's arrays, and the largest of these lie in files.
            memory = min(memory, options.memory + _PROCESS)
    return Forecast(work * (_SEARCH if search else 1), memory, seconds, pictures)


def _view(drawable: Drawable, cameras: Sequence[Camera], options: EncodeOptions, device: Device) -> tuple[float, float]:
    """Seconds that a picture takes, and bytes of what can be kept of a view: means of a few."""
    chosen = [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, min(_SAMPLE, len(cameras)))]
    seconds: list[list[float]] = []
    nbytes = []
    with Rasterizer(device, drawable, background=options.background) as rasterizer:

        def rendered(camera: Camera) -> float:
            began = time.perf_counter()
            rasterizer.render_device(camera)
            device.queue.finish()
            return time.perf_counter() - began

        rendered(chosen[0])  # the first time buffers are made
        while len(seconds) < _MOST_OFTEN and (not seconds or np.size(seconds) * np.median(seconds) < _ENOUGH):
            seconds.append([rendered(camera) for camera in chosen])
        for camera in chosen:
            before = device.allocated
            with rasterizer.prepare_set([camera]):
                nbytes.append(device.allocated - before + _PIXEL * camera.width * camera.height)
    return float(np.median(seconds, axis=0).mean()), float(np.mean(nbytes))
