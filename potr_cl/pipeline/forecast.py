"""What an encode will take, before it begins (:func:`forecast`): seconds and bytes, roughly.

Nearly all of the time goes into projecting, sorting and compositing splats, view by view. So a few views are rendered
(:mod:`potr_cl.pipeline.sampled_views`), and their time, as a unit, is multiplied by what each stage was measured to
take in such units. This sees the device, the scene and the size of the pictures, and what the machine is doing besides,
unless that lasts a moment. On a CPU a splat that is not in the picture is a unit of its own: the larger a scene, the
fewer of its splats a view shows, but the re-fit goes through all that are left.
``python -m tools.bench.forecast`` measures the units, and how far off a forecast is (docs/benchmarks/forecast.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.pipeline.host_memory import for_views
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.sampled_views import PIXEL, SampledViews, sample_views
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.view_cache import GEOMETRY
from potr_cl.stages.between.amount import most_needed, needed_of_virtual
from potr_cl.stages.compact import Compact
from potr_cl.stages.fit import ITERATIONS, Fit
from potr_cl.stages.fitting.fit import FitOptions
from potr_cl.stages.fitting.memory import fit_bytes
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.sweep_options import default_memory
from potr_cl.stages.pruning.visible_parts import LEAST_SPLATS
from potr_cl.stages.refit import Refit
from potr_cl.stages.refitting.placement import left_for_views, placed
from potr_cl.stages.views_between import Between

#: Plain encodes that a search takes the time of.
_SEARCH = 3
#: Of the time of a view of a step of the fit at q = 0.5, what is left at q = 0: with q, the splats that it moves become
#: more, from a fifth of lego's at 0.3 to two fifths at 0.5.
_NONE_LEFT = 0.25
#: Bytes of the process with its libraries; a splat, on the host and on the device; and what is kept of views and
#: besides, as a multiple of what a view's own buffers take.
_PROCESS, _HOST_SPLAT, _DEVICE_SPLAT, _VIEWS = 180e6, 1550, 154, 1.02
#: The part of the splats that pruning leaves at q = 0.5, in the middle of what was measured, 0.31 to 0.56; and with
#: which power of q it grows.
_LEFT, _LEFT_GROWS = 0.45, 0.3


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
        again, again_step: the same for a view that the memory has no room for.
        fit: a view of a step of the fit, at q = 0.5; it is more where a larger q leaves more splats.
        projections: what preparing a view takes besides, as a multiple of the time of the splats that it projects; and
            geometry: an iteration for a view of which only the projection has no room.
        colours, step_colours: what the re-fit and a step of it take for a view besides, as multiples of what projecting
            the splats takes that are left; and vectors, step_vectors: the same whatever the number of views.
        compact_splat, refit_splat, code_splat: seconds that compaction, the re-fit and the coding take besides, for
            each splat of the uncompressed scene.
    """

    prepare: float
    prune: float
    iteration: float
    fit: float
    step: float
    code_splat: float
    compact: float = 0
    refit: float = 0
    again: float = 0
    again_step: float = 0
    projections: float = 0
    geometry: float = 0
    colours: float = 0
    step_colours: float = 0
    vectors: float = 0
    step_vectors: float = 0
    compact_splat: float = 0
    refit_splat: float = 0


#: From tools.bench.forecast for CPUs, and from docs/benchmarks/encode.md for GPUs, where the host does a good part.
UNITS: dict[Family, Units] = {
    "cpu": Units(
        prepare=1.0, projections=2, prune=3.0, iteration=0.035, again=2.0, geometry=1, fit=1.7, compact=2.0, refit=4.7,
        step=0.33, again_step=0.9, colours=20, step_colours=4.75, vectors=100, step_vectors=50, code_splat=2.5e-6,
    ),
    "gpu": Units(
        prepare=0.9, prune=2.0, iteration=0.042, fit=0.9, step=0.45,
        compact_splat=3.5e-6, refit_splat=1.45e-6, code_splat=1.5e-6,
    ),
}  # fmt: skip
#: Steps that the re-fit takes besides those that are asked for: at its beginning and end, and with rounded colours.
_STEPS_BESIDES = 5


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
    sampled = sample_views(scene, cameras, device, options.background, kept)
    views = _views(scene, cameras, options, device, sampled)
    pictures, splats, of_a_splat = _work(scene, cameras, views, options, device, sampled)
    work = pictures * sampled.picture + splats * sampled.splat
    seconds = (work + len(scene) * of_a_splat) * (_SEARCH if search else 1)
    memory = _memory(scene, cameras, views, options, device, sampled)
    return Forecast(seconds, memory, sampled.seconds, work / max(sampled.seconds, 1e-9))


def _views(
    scene: Scene, cameras: Sequence[Camera], options: EncodeOptions, device: Device, sampled: SampledViews
) -> float:
    """Views that are looked at, those between the given ones included."""
    views = float(len(cameras))
    between = next((stage for stage in options.stages if isinstance(stage, Between) and stage.asked_for), None)
    if between is None or len(cameras) < 2:
        return views
    if between.views != "auto":
        return views * (1 + between.views)
    slow = device.info.kind == "cpu"  # nobody knows yet how many the scene needs
    each = needed_of_virtual(slow) if is_virtual(cameras) else most_needed(len(cameras), slow)
    if device.family == "cpu":  # only as many are added as there is room for
        fit = _room_of_pruning(scene, options, device) / max(sampled.nbytes, 1)
        each = min(each, max(fit / views - 1, 0))
    return views * (1 + each)


def _work(
    scene: Scene,
    cameras: Sequence[Camera],
    views: float,
    options: EncodeOptions,
    device: Device,
    sampled: SampledViews,
) -> tuple[float, float, float]:
    """Pictures whose time all takes, splats whose projection it takes besides, and seconds for each of the scene's."""
    parts = {stage.name: stage for stage in options.stages if stage.asked_for and stage.looks_at(scene)}
    units = UNITS[device.family]
    of_a_splat = units.code_splat
    pictures = views * units.prepare
    splats = views * units.projections * sampled.splats
    left = float(len(scene))
    if isinstance(prune := parts.get(Prune.name), Prune):
        pictures += views * (units.prune + units.iteration * prune.iterations)
        room = _room_of_pruning(scene, options, device)
        kept, whole = _kept(views, sampled.splats, sampled.lists, room)
        pictures += (views - kept) * units.again * prune.iterations
        of_iteration = (views - kept) * units.projections + (kept - whole) * units.geometry
        splats += of_iteration * sampled.splats * prune.iterations
        left = _left(len(scene), prune, options.q)
    if isinstance(fit := parts.get(Fit.name), Fit):
        steps = fit.steps_on(device.family)
        if isinstance(refit := parts.get(Refit.name), Refit) and refit.ground_truth is not None:
            steps += fit.photograph_steps_on(device.family, len(cameras))
        else:
            steps += fit.further_steps_on(device.family)
        of_fit = steps * FitOptions.batch * units.fit * (_NONE_LEFT + (1 - _NONE_LEFT) * options.q / 0.5)
        of_fit += views * (fit.views_on(device.family) + units.prepare + units.iteration * ITERATIONS)
        pictures += of_fit
        splats += of_fit * left
    if Compact.name in parts:
        pictures += views * units.compact
        of_a_splat += units.compact_splat
    if isinstance(refit := parts.get(Refit.name), Refit):
        splats += views * len(scene)  # for the pictures to come near to
        of_views = _room_of_refit(left, scene, options, device)
        kept = views if of_views is None else _kept(views, left, sampled.lists * left / len(scene), of_views)[0]
        for steps in (refit.steps, *[refit.at_steps] * len(refit.at)):
            pictures += views * (units.refit + units.step * steps)
            pictures += (views - kept) * units.again_step * (steps + _STEPS_BESIDES)
            colours = views * (units.colours + units.step_colours * steps)
            splats += left * (colours + units.vectors + units.step_vectors * steps)
        of_a_splat += units.refit_splat
    return pictures, splats, of_a_splat


def _left(splats: int, prune: Prune, q: float) -> float:
    """Splats that pruning leaves, as far as one can know."""
    if prune.count is not None:
        return min(prune.count, splats)
    return splats * (min(_LEFT * (q / 0.5) ** _LEFT_GROWS, 1) if prune.keep is None else prune.keep)


def _kept(views: float, splats: float, lists: float, room: float) -> tuple[float, float]:
    """Views whose lists stay in the memory, and those that keep their projection too.

    Args:
        views: that there are.
        splats: that are projected for each.
        lists: bytes of its lists and the like.
        room: bytes of the memory.
    """
    geometry = GEOMETRY * max(splats, 1)
    free = max(room - geometry, 0)  # those without a projection share one
    kept = min(views, free / max(lists, 1))
    return kept, min(kept, (free + geometry - kept * lists) / geometry)


def _room_of_pruning(scene: Scene, options: EncodeOptions, device: Device) -> float:
    """Bytes that there are for views while splats are removed."""
    room = for_views(device, options.memory, len(scene))
    return float(default_memory(device) if room is None else room)


def _room_of_refit(left: float, scene: Scene, options: EncodeOptions, device: Device) -> int | None:
    """Bytes that the re-fit leaves for views; None: as many as there are."""
    splats, sh_count, memory = int(left), scene.sh.shape[1], for_views(device, options.memory, len(scene))
    place = placed(device, splats, sh_count, memory)
    return left_for_views(splats, sh_count, memory) if place is None else place.views


def _memory(
    scene: Scene,
    cameras: Sequence[Camera],
    views: float,
    options: EncodeOptions,
    device: Device,
    sampled: SampledViews,
) -> float:
    """Bytes at the peak: the whole process's on a CPU, the device's on a GPU."""
    budget = default_memory(device) if options.memory is None else options.memory
    memory = len(scene) * _DEVICE_SPLAT + min(views * sampled.nbytes * _VIEWS, budget)
    fit = next((stage for stage in options.stages if isinstance(stage, Fit) and stage.asked_for), None)
    if fit is not None and fit.looks_at(scene):
        pixels = float(np.mean([camera.width * camera.height for camera in cameras]))
        together = FitOptions.batch if device.family == "gpu" else 1
        view = sampled.nbytes - PIXEL * pixels
        needed = fit_bytes(len(scene), len(scene), 3 * scene.sh.shape[1], together, int(views), view, pixels, budget)
        memory = max(memory, needed)
    if device.info.kind == "cpu":
        memory += _PROCESS + len(scene) * _HOST_SPLAT
        if options.memory is not None and len(scene) >= LEAST_SPLATS:
            # Views of large scenes leave room for the host's arrays, and the largest of these lie in files.
            memory = min(memory, options.memory + _PROCESS)
    return memory
