"""What memory an encode will take, before it begins (:func:`memory_needed`): what its stages keep, added up.

:func:`log_forecast` reports it, with the device that does the work.

How long it takes is not foretold: the first part of each stage says that (:mod:`potr_cl.cli.progress`).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import ResidentScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.fit import FitOptions
from potr_cl.stages.refitting.coefficients import fits_in_one_piece, in_one_piece
from potr_cl.stages.views_between import Between, most_needed
from potr_cl.views.budget import default_memory
from potr_cl.views.visibility import LEAST_SPLATS

_log = logging.getLogger("potr_cl")

#: Splats times views from which on the work may take long enough to be worth a forecast.
_LONG = 2_000_000
#: Bytes of the process with its libraries; a splat, on the host and on the device; and what is kept of views and
#: besides, as a multiple of what a view's own buffers take.
_PROCESS, _HOST_SPLAT, _DEVICE_SPLAT, _VIEWS = 180e6, 1550, 154, 1.02
#: Of a large scene, bytes of a splat in pruning besides the scene (sums, states, scores); the part of its splats that
#: is left, at qualities that people ask for; and of what the re-fit's vectors leave, what its views take.
_PRUNED_SPLAT, _LEFT, _OF_REST = 62, 0.3, 0.4
#: Bytes of a pixel of the picture that a view is to have; and of what is measured of an intersection, on CPUs.
_PIXEL, _SUM = 12, 8


def log_forecast(
    device: Device, scene: Scene, cameras: Sequence[Camera], options: EncodeOptions, kept: ResidentScene | None = None
) -> None:
    """Report the device and its kernels; and where the work may take long, roughly its memory.

    Args:
        cameras: of which the training views are looked at.
        device, scene, options, kept: as of :func:`memory_needed`.

    Raises:
        UsageError: there is no training view.
    """
    views = train_views(cameras)
    if not _log.isEnabledFor(logging.INFO):
        return
    _log.debug("driver: %s, %s", device.info.platform, device.info.version)
    width, height = max((view.width, view.height) for view in views)
    work = f"{len(scene):,} splats, {len(views)} views of {width} x {height}"
    # At once: to measure takes seconds.
    _log.info("on %s, kernels for %ss: %s", device.info, device.family.upper(), work)
    if len(scene) * len(views) >= _LONG:
        try:
            memory = memory_needed(scene, views, options, device, kept)
        except DeviceError as error:
            _log.debug("no forecast: %s", error)  # the encode goes on with less memory, or elsewhere
        else:
            size = f"{memory / 1e9:.1f} GB" if memory >= 1e9 else f"{max(memory / 1e6, 1):.0f} MB"
            _log.info("about %s of memory%s", size, "" if device.info.kind == "cpu" else " of the device")


def memory_needed(
    scene: Scene, cameras: Sequence[Camera], options: EncodeOptions, device: Device, kept: ResidentScene | None = None
) -> float:
    """Bytes at the peak: the whole process's on a CPU, the device's on a GPU; roughly.

    Args:
        scene, options, device: of the encode.
        cameras: its training views, at least one.
        kept: the scene on the device, if it lies there already.

    Raises:
        DeviceError: the device cannot prepare a view.
    """
    budget = float(default_memory(device) if options.memory is None else options.memory)
    views, of_views, lists, pixels = _views(cameras, options, device), budget, 0.0, 0.0
    if len(scene) < LEAST_SPLATS:  # of larger ones a view's lists are not known before, but they fill the budget
        # The middle one: not each is worth looking at.
        camera = cameras[len(cameras) // 2]
        pixels = float(camera.width * camera.height)
        lists = _lists(scene if kept is None else kept.drawable(device, scene), camera, device, options)
        of_views = min(views * (lists + _PIXEL * pixels) * _VIEWS, budget)
    memory = len(scene) * _DEVICE_SPLAT + of_views
    if len(scene) >= LEAST_SPLATS and not device.info.shares_host_memory:
        memory = _of_large(scene, of_views, options.memory, device)
    fit = next((stage for stage in options.stages if isinstance(stage, Fit) and stage.asked_for), None)
    if fit is not None and lists and fit.looks_at(scene):
        together = FitOptions.batch if device.family == "gpu" else 1
        coefficients = 3 * scene.sh.shape[1]
        needed = fit_bytes(len(scene), len(scene), coefficients, together, int(views), lists, pixels, budget)
        memory = max(memory, needed)
    if device.info.kind == "cpu":
        memory += _PROCESS + len(scene) * _HOST_SPLAT
        if options.memory is not None and len(scene) >= LEAST_SPLATS:
            # Views of large scenes leave room for the host's arrays, and the largest of these lie in files.
            memory = min(memory, options.memory + _PROCESS)
    return memory


def _of_large(scene: Scene, of_views: float, memory: int | None, device: Device) -> float:
    """The same of a large scene on a GPU: what pruning takes, or the re-fit of what it leaves."""
    pruning = scene.nbytes + _PRUNED_SPLAT * len(scene) + of_views
    free = device.info.memory - scene.nbytes
    vectors: float = in_one_piece(int(_LEFT * len(scene)), scene.sh.shape[1])
    if not fits_in_one_piece(vectors, free, memory):
        # In slices, with the views, they take what is given, or what is free.
        return max(pruning, scene.nbytes + min(free if memory is None else memory, free))
    views = _OF_REST * (free - vectors) if memory is None else memory - vectors
    return max(pruning, scene.nbytes + vectors + views)


def _views(cameras: Sequence[Camera], options: EncodeOptions, device: Device) -> float:
    """Views that are looked at, with as many between the given ones as may be added."""
    views = float(len(cameras))
    between = next((stage for stage in options.stages if isinstance(stage, Between) and stage.asked_for), None)
    if between is None or len(cameras) < 2:
        return views
    if between.views != "auto":
        return views * (1 + between.views)
    slow = device.info.kind == "cpu"
    return views if is_virtual(cameras) else views * (1 + most_needed(len(cameras), slow))


def _lists(scene: Drawable, camera: Camera, device: Device, options: EncodeOptions) -> float:
    """Bytes that can be kept of a view besides its picture."""
    with Rasterizer(device, scene, background=options.background) as rasterizer:
        before = device.allocated
        with rasterizer.prepare_set([camera]) as views:
            sums = _SUM * views.views[0].intersection_count if device.family == "cpu" else 0
            return device.allocated - before + sums


#: Buffers of all parameters: the rasterizer's, the gradient, the parameters, the best ones, averages, two moments.
_VECTORS = 7
#: Bytes of a splat in each view of a batch besides the prepared view: its sums, its bounds.
_OF_SPLAT = 72 + 8
#: Bytes of a splat in what a rasterizer keeps to render pictures one by one: its projection, and a list of four
#: intersections with their sort keys.
_FRAME = 144
#: Bytes of a pixel's colour.
_TARGET_PIXEL = 12


def fit_bytes(
    splats: int, source: int, sh_columns: int, together: int, views: int, view: float, pixels: float, room: float
) -> float:
    """Bytes of the device's memory that a fit takes at its peak, about.

    Args:
        splats: that are fitted. source: of the scene that renders the targets.
        sh_columns: SH coefficients of a splat, all channels.
        together: views that are prepared at a time: a batch on GPUs, one on CPUs.
        views: in all.
        view: bytes of a prepared view.
        pixels: of a view.
        room: bytes that target pictures may take.
    """
    parameters = 4 * (11 + sh_columns)
    prepared = together * (view + splats * _OF_SPLAT)
    pictures = min(views * _TARGET_PIXEL * pixels, room) + (together + 2) * _TARGET_PIXEL * pixels
    return splats * (parameters * _VECTORS + _FRAME) + source * (parameters + _FRAME) + prepared + pictures
