"""Encoder: the stages from a scene to the bytes of a .potr file, in order."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import Geometry, quantise_geometry
from potr_cl.host.atomic_write import replacing
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual, place_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.fallback import on_device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.reduction import Progress, reduce_scene
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.refitting.refit import RefitOptions, Refitted, active_coefficients, refit_colours
from potr_cl.stages.refitting.targets import GroundTruthTargets, RenderedTargets


@dataclass(frozen=True)
class Encoded:
    """A finished encode.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        nbytes: their number.
        order: (N,) index in the source scene of each splat of the file.
        pruned: what pruning did; None if it was left out.
        refitted: what the re-fit of the colours did; None if it was left out.
        device: that the views were looked at on, another than asked for where that had too little memory; None if there
            was nothing to look at.
        seconds: wall time by stage.
    """

    pieces: list[bytes]
    nbytes: int
    order: NDArray[np.int64]
    pruned: Pruned | None
    refitted: Refitted | None
    device: Device | None
    seconds: dict[str, float]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all.

        Raises:
            UsageError: it cannot be written there.
            PotrError: the system failed to write.
        """
        with replacing(path) as file:
            for piece in self.pieces:
                file.write(piece)


@dataclass(frozen=True)
class Reduced:
    """A scene between the two halves of an encode.

    Attributes:
        scene: what is left to code.
        pruned, refitted, device: as :class:`Encoded` has them.
        geometry: of the scene, if the colours were re-fitted on it.
    """

    scene: Scene
    pruned: Pruned | None
    refitted: Refitted | None
    device: Device | None
    geometry: Geometry | None = None


class Stopwatch:
    """Passes progress on and notes how long each stage took; a stage within another counts for itself alone.

    Attributes:
        seconds: wall time by stage, in the order in which they began.
    """

    def __init__(self, progress: Progress | None = None) -> None:
        self._progress = progress
        self._running: str | None = None
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: float) -> None:
        now = time.perf_counter()
        self.seconds.setdefault(stage, 0.0)
        self.seconds[self._running or stage] += now - self._last
        self._running, self._last = stage if done < 1 else None, now
        if self._progress is not None:
            self._progress(stage, done)


def encode(
    scene: Scene,
    cameras: Sequence[Camera] | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
) -> Encoded:
    """Encode a scene.

    Args:
        scene: clean (:meth:`potr_cl.model.scene.Scene.cleaned`), at least one splat.
        cameras: the training views among them decide which splats may go, and how coarse centres may be. None: virtual
            ones are placed if the options ask for anything that looks at views; if not, γ alone decides about centres.
        options: defaults to quality 0.5 of preset best.
        progress: told how far each stage is.
        device: to prune on; the best one there is by default. Where its memory is too small, less is kept in it, and
            if that is not enough a CPU does the work; either is said by a warning.

    Raises:
        UsageError: options out of range, or cameras without a training view.
        DataError: a value too large to quantise.
        DeviceError: no device does the work.
    """
    options = options or EncodeOptions.for_preset("best")
    watch = Stopwatch(progress)
    if cameras is None and needs_views(scene, options):
        watch("place cameras", 0.0)
        cameras = place_cameras(scene)
        watch("place cameras", 1.0)
    views = [] if cameras is None else train_views(cameras)
    return code(scene, reduce(scene, views, options, watch, device), views, options, watch)


def needs_views(scene: Scene, options: EncodeOptions) -> bool:
    """Whether the options ask for a stage that looks at views."""
    return options.prune or options.refit > 0 or (options.compact and scene.sh_degree > 0)


def reduce(
    scene: Scene, views: Sequence[Camera], options: EncodeOptions, watch: Stopwatch, device: Device | None = None
) -> Reduced:
    """The first half of :func:`encode`: fewer splats with sparser colours, as far as views and options allow."""
    return refit(scene, thin(scene, views, options, watch, device), views, options, watch)


def thin(
    scene: Scene, views: Sequence[Camera], options: EncodeOptions, watch: Stopwatch, device: Device | None = None
) -> Reduced:
    """The part of :func:`reduce` that comes before the re-fit: pruning and compaction."""
    if not views or not needs_views(scene, options):
        return Reduced(scene, None, None, None)

    def work(device: Device, options: EncodeOptions) -> Reduced:
        return Reduced(*reduce_scene(scene, views, options, watch, device), None, device)

    return on_device(device or Device(), options, work)[0]


def refit(scene: Scene, thinned: Reduced, views: Sequence[Camera], options: EncodeOptions, watch: Stopwatch) -> Reduced:
    """The rest of :func:`reduce`: re-fit the colours, if the options ask for it.

    On the geometry and the opacities that a decoder will see, so that the colours make up for quantised geometry too.

    Args:
        scene: the uncompressed one.
        thinned: of :func:`thin`; not changed, so that it may be re-fitted for other options again.
        views, options, watch: as :func:`thin` takes them.
    """
    if not options.refit or thinned.device is None:
        return thinned
    watch("refit", 0.0)
    with thread_pool(options.threads) as pool:
        geometry = quantise_geometry(thinned.scene, options.parameters, views, pool.map)

    def work(device: Device, options: EncodeOptions) -> Reduced:
        refitted = _refit(scene, thinned.scene, geometry, views, options, watch, device)
        return Reduced(replace(thinned.scene, sh=refitted.sh), thinned.pruned, refitted, device, geometry)

    return on_device(thinned.device, options, work)[0]


def _refit(
    scene: Scene,
    reduced: Scene,
    geometry: Geometry,
    views: Sequence[Camera],
    options: EncodeOptions,
    watch: Stopwatch,
    device: Device,
) -> Refitted:
    watch("refit", 0.0)
    parameters = options.parameters
    decoded = geometry.decoded(reduced.sh)
    active = active_coefficients(reduced.sh, parameters.sf_sh) if options.compact else None
    how = RefitOptions(steps=options.refit, drop=parameters.drop, memory=options.sweep.memory)
    targets: RenderedTargets | GroundTruthTargets
    with ExitStack() as stack:
        stack.callback(watch, "refit", 1.0)
        if options.ground_truth is None:
            rasterizer = Rasterizer(device, scene, background=options.background)
            stack.callback(rasterizer.free)
            targets = RenderedTargets(rasterizer, views)
        else:
            ground_truth = GroundTruth(options.ground_truth, views, options.background)
            targets = GroundTruthTargets(device, ground_truth, views)
        return refit_colours(
            device,
            decoded,
            views,
            targets,
            how,
            active,
            options.background,
            lambda done, steps: watch("refit", done / steps),
        )


def code(scene: Scene, reduced: Reduced, views: Sequence[Camera], options: EncodeOptions, watch: Stopwatch) -> Encoded:
    """The second half of :func:`encode`: bytes."""
    pruned = reduced.pruned
    metadata = _metadata(scene, views, options, pruned)
    geometry = reduced.geometry
    if geometry is not None and geometry.asked != options.parameters:
        geometry = None
    coded = code_scene(
        reduced.scene, options.parameters, views, metadata, options.entropy, options.threads, watch, geometry
    )
    order = coded.order if pruned is None else pruned.survivors[coded.order]
    return Encoded(coded.pieces, coded.nbytes, order, pruned, reduced.refitted, reduced.device, watch.seconds)


def _metadata(scene: Scene, views: Sequence[Camera], options: EncodeOptions, pruned: Pruned | None) -> bytes:
    parameters = options.parameters
    facts = {
        "q": options.q,
        "cameras": ("virtual" if is_virtual(views) else "given") if views else None,
        "beta": parameters.beta if views else None,
        "gamma": parameters.gamma,
        "delta_mse_max": parameters.delta_mse_max if pruned is not None and options.count is None else None,
        "lambda": parameters.lam if views and options.compact else None,
        "alpha": parameters.alpha if views and options.compact else None,
        "source_splats": len(scene),
        "source_bytes": options.source_bytes,
    }
    return json.dumps(facts, separators=(",", ":")).encode()
