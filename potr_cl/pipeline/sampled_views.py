"""What a view takes on a device, measured with few of all views: :func:`sample_views`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.culling import parts_seen
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.raster.view_cache import GEOMETRY
from potr_cl.stages.pruning.visible_parts import LEAST_SPLATS, LIKELY, groups_of_large

F64 = NDArray[np.float64]

#: Views that are rendered to see how long one takes; and how often each is at the most, where that takes no longer than
#: so many seconds: other work comes and goes, and may take a device away for longer than a view does.
_SAMPLE, _MOST_OFTEN, _ENOUGH = 4, 9, 0.1
#: Bytes of a pixel, of the picture that a view is to have; and of what is measured of an intersection, which is not
#: counted on GPUs.
PIXEL, _SUM = 12, 8
#: Seconds that a clock may be coarse.
_FINE = 1e-4
#: Parts of a scene that differ by less tell nothing about why views take longer than others.
_SAME = 0.02


@dataclass(frozen=True)
class SampledViews:
    """What views take, on the average.

    Attributes:
        picture: seconds of a picture of the uncompressed scene, without ``splat``.
        splat: seconds that each splat takes besides which is projected for a picture, whether or not it is in it. 0 on
            GPUs, where it is not told apart.
        splats: that are projected for a view while splats are removed.
        nbytes: of what can be kept of a view.
    """

    picture: float
    splat: float
    splats: float
    nbytes: float

    @property
    def seconds(self) -> float:
        """Of a picture as it is rendered while splats are removed."""
        return self.picture + self.splat * self.splats

    @property
    def lists(self) -> float:
        """Bytes of what can be kept of a view besides its projection."""
        return max(self.nbytes - GEOMETRY * self.splats, 0.0)


def sample_views(
    scene: Scene,
    cameras: Sequence[Camera],
    device: Device,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    kept: KeptScene | None = None,
) -> SampledViews:
    """Render a few views, each with the splats that pruning would look at it with.

    On a CPU the views are chosen by how much of the scene they may draw: a few that look far across a large scene take
    many times as long as most.

    Args:
        scene: clean.
        cameras: at least one.
        device, background: of the encode.
        kept: the scene on the device, if it lies there already.

    Raises:
        DeviceError: the device cannot render the views.
    """
    count = min(_SAMPLE, len(cameras))
    if device.family != "cpu":
        chosen = [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, count)]
        with Rasterizer(device, _whole(scene, device, kept), background=background) as rasterizer:
            seconds, nbytes = _taken(rasterizer, chosen).wall, _nbytes(rasterizer, chosen)
        return SampledViews(float(seconds.mean()), 0.0, len(scene), float(nbytes.mean()))
    parts = parts_seen(scene, cameras, INRIA.near)
    order = np.argsort(parts, kind="stable")
    numbers = order[((np.arange(count) + 0.5) * len(cameras) / count).astype(int)].tolist()
    chosen, away = [cameras[number] for number in numbers], _away(scene, cameras[0])
    splats = np.full(count, float(len(scene)))
    if len(scene) >= LEAST_SPLATS and parts.mean() <= LIKELY:
        wall, work, nothing, nbytes = np.empty((4, count))
        for place, rasterizer in enumerate(_of_what_each_sees(scene, chosen, device, background)):
            with rasterizer:
                splats[place] = rasterizer.splats
                taken = _taken(rasterizer, [chosen[place], away])
                wall[place], (work[place], nothing[place]) = taken.wall[0], taken.work
                nbytes[place] = _nbytes(rasterizer, [chosen[place]])[0]
        of_a_splat = float(nothing.sum() / splats.sum())
    else:
        with Rasterizer(device, _whole(scene, device, kept), background=background) as rasterizer:
            taken, nbytes = _taken(rasterizer, [*chosen, away]), _nbytes(rasterizer, chosen)
        wall, work, of_a_splat = taken.wall[:-1], taken.work[:-1], float(taken.work[-1]) / len(scene)
    slow = float(wall.sum() / max(work.sum(), 1e-9))
    pictures = np.maximum(work - of_a_splat * splats, 0)
    picture, projected, held = (_mean(of, parts[numbers], parts) for of in (pictures, splats, nbytes))
    return SampledViews(slow * picture, slow * of_a_splat, min(projected, len(scene)), held)


@dataclass(frozen=True)
class _Taken:
    """What pictures took, each a median.

    Attributes:
        wall: (views,) seconds.
        work: (views,) of the processors, where the device is one and they are counted finely enough: other work on the
            machine changes that less than wall time. Elsewhere the same as ``wall``.
    """

    wall: F64
    work: F64


def _whole(scene: Scene, device: Device, kept: KeptScene | None) -> Drawable:
    return scene if kept is None else kept.drawable(device, scene)


def _of_what_each_sees(
    scene: Scene, cameras: Sequence[Camera], device: Device, background: tuple[float, float, float]
) -> Iterator[Rasterizer]:
    """For each view a rasterizer of the splats that it may draw, one after the other; the caller closes them."""
    with thread_pool() as pool:
        groups = groups_of_large(scene, pool.map)
    assert groups is not None, "the scene is large"
    for seen in groups.visible_by(cameras, INRIA.near):
        splats = groups.splats(seen)
        yield Rasterizer(device, scene.subset(splats if len(splats) else np.zeros(1, np.int64)), background=background)


def _away(scene: Scene, camera: Camera) -> Camera:
    """The same view from where all of the scene is behind it."""
    return replace(camera, translation=np.array([0.0, 0.0, -4 * float(np.abs(scene.means).max()) - 1]))


def _taken(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> _Taken:
    """Render views, each several times where that takes no time."""
    of_host = rasterizer.device.info.kind == "cpu" and time.get_clock_info("process_time").resolution < _FINE

    def rendered(camera: Camera) -> tuple[float, float]:
        began, worked = time.perf_counter(), time.process_time()
        rasterizer.render_device(camera)
        rasterizer.device.queue.finish()
        wall, work = time.perf_counter() - began, time.process_time() - worked
        return wall, work if of_host else wall

    rendered(cameras[0])  # the first time buffers are made
    found: list[list[tuple[float, float]]] = []
    seconds = 0.0
    while len(found) < _MOST_OFTEN and (not found or seconds < _ENOUGH):
        found.append([rendered(camera) for camera in cameras])
        seconds = float(len(found) * len(cameras) * np.median(np.array(found)[..., 0]))
    wall, work = np.median(found, axis=0).T
    return _Taken(wall, work)


def _nbytes(rasterizer: Rasterizer, cameras: Sequence[Camera]) -> F64:
    """(views,) bytes that can be kept of them."""
    nbytes = []
    for camera in cameras:
        before = rasterizer.device.allocated
        with rasterizer.prepare_set([camera]) as views:
            held = rasterizer.device.allocated - before
            sums = _SUM * views.views[0].intersection_count if rasterizer.device.family == "cpu" else 0
        nbytes.append(held + sums + PIXEL * camera.width * camera.height)
    return np.array(nbytes, float)


def _mean(sampled: F64, parts: F64, of_all: F64) -> float:
    """The mean over all views of what was measured with few, which grows with the part of the scene that a view sees.

    Args:
        sampled: (few,) what was measured.
        parts: (few,) what these views see.
        of_all: (views,) what all views see.
    """
    off = parts - parts.mean()
    slope = max(float(off @ sampled) / float(off @ off), 0.0) if np.ptp(parts) > _SAME else 0.0
    return max(float(sampled.mean()) + slope * float(of_all.mean() - parts.mean()), float(sampled.min()))
