"""Encoder: the stages from a scene to the bytes of a .potr file, in order."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from potr_cl import bitstream, octree, quantize
from potr_cl.bitstream import EntropyCoder, Header, Property, Section
from potr_cl.cameras import Camera, camera_centres, train_views
from potr_cl.compaction import CompactionOptions, Compactor, ViewWeights
from potr_cl.device import Device
from potr_cl.errors import UsageError
from potr_cl.pruning import Pruned, PruningOptions, prune
from potr_cl.rasterizer import Rasterizer
from potr_cl.removal import RemovalSweep, SweepOptions
from potr_cl.scene import Scene

#: Called with the stage's name and the part of it that is done, 0 to 1.
Progress = Callable[[str, float], None]

#: Splats worked on at a time where a stage needs large temporaries.
_BLOCK = 1 << 16
#: Splats whose distances to every camera are taken at a time: a few arrays of them fit a second-level cache.
_NEAR_BLOCK = 1 << 14


@dataclass(frozen=True)
class EncodeOptions:
    """How to encode.

    Attributes:
        q: quality, 0 to 1; sets every hyper-parameter that is not given on its own.
        lam, alpha, delta_mse_max, beta, gamma, sf_sh, sf_opacity, sf_rotation, sf_scale: replace single
            hyper-parameters (:class:`potr_cl.quantize.HyperParameters`).
        prune: remove splats; needs cameras, without them nothing is removed.
        iterations: of the pruning schedule.
        compact: make the SH coefficients sparse; needs cameras, as pruning does.
        compact_at: the part of the pruning iterations after which that is done: later ones see its effect.
        count: number of splats to keep, instead of ΔMSE_MAX.
        sweep: what measuring removal effects may skip.
        background: R, G, B behind the scene in the views that pruning looks at.
        entropy: the entropy stage.
        threads: for the entropy stage; the bytes do not depend on it. 0: one a processor.
        source_bytes: size of the file that the scene came from, for the metadata; None if it came from none.
    """

    q: float = 0.5
    lam: float | None = None
    alpha: float | None = None
    delta_mse_max: float | None = None
    beta: float | None = None
    gamma: float | None = None
    sf_sh: float | None = None
    sf_opacity: float | None = None
    sf_rotation: float | None = None
    sf_scale: float | None = None
    prune: bool = True
    iterations: int = 48
    compact: bool = True
    compact_at: float = 0.5
    count: int | None = None
    sweep: SweepOptions = field(default_factory=SweepOptions)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entropy: EntropyCoder = field(default_factory=EntropyCoder)
    threads: int = 0
    source_bytes: int | None = None

    @property
    def parameters(self) -> quantize.HyperParameters:
        """The hyper-parameters that result."""
        names = ("lam", "alpha", "delta_mse_max", "beta", "gamma", "sf_sh", "sf_opacity", "sf_rotation", "sf_scale")
        return quantize.HyperParameters.from_quality(self.q, **{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class Encoded:
    """A finished encode.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        nbytes: their number.
        order: (N,) index in the source scene of each splat of the file.
        pruned: what pruning did; None if it was left out.
        seconds: wall time by stage.
    """

    pieces: list[bytes]
    nbytes: int
    order: NDArray[np.int64]
    pruned: Pruned | None
    seconds: dict[str, float]


def encode(
    scene: Scene,
    cameras: Sequence[Camera] | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
) -> Encoded:
    """Encode a scene.

    Args:
        scene: clean (:meth:`potr_cl.scene.Scene.cleaned`), at least one splat.
        cameras: the training views among them decide which splats may go, and how coarse centres may be; without
            cameras every splat is kept and γ alone decides.
        options: defaults to quality 0.5.
        progress: told how far each stage is.
        device: to prune on; the best one there is by default.

    Raises:
        UsageError: options out of range, or cameras without a training view.
        DataError: a value too large to quantise.
    """
    options = options or EncodeOptions()
    parameters = options.parameters
    report = progress or (lambda stage, done: None)
    seconds: dict[str, float] = {}
    source = scene

    pruned: Pruned | None = None
    if cameras is not None and (options.prune or (options.compact and scene.sh_degree > 0)):
        started = time.perf_counter()
        scene, pruned = reduce_scene(scene, cameras, options, report, device)
        seconds["prune and compact"] = time.perf_counter() - started

    report("octree", 0.0)
    started = time.perf_counter()
    tolerance = _tolerance(scene.means, cameras, parameters)
    tree, order = octree.build(scene.means, tolerance)
    seconds["octree"] = time.perf_counter() - started
    report("octree", 1.0)

    started = time.perf_counter()
    jobs = [*_octree_jobs(tree), *_attribute_jobs(scene, order, parameters)]
    jobs.append(lambda: [(Property.METADATA, 0, _metadata(source, cameras, options, pruned), 1)])
    coded: list[tuple[Section, bytes]] = []

    def run(job: _Job) -> list[tuple[Section, bytes]]:
        return [options.entropy.section(*stream) for stream in job() if stream[2]]

    pool = ThreadPoolExecutor(options.threads or os.cpu_count() or 1)
    try:
        for done, sections in enumerate(pool.map(run, jobs), start=1):
            coded.extend(sections)
            report("quantise and code", done / len(jobs))
    finally:
        # After Ctrl-C nothing that has not begun should begin.
        pool.shutdown(cancel_futures=True)
    coded.sort(key=lambda pair: (pair[0].kind, pair[0].index))
    pieces = bitstream.assemble(
        Header(
            splats=len(scene),
            sh_degree=scene.sh_degree,
            origin=tree.origin,
            side=tree.side,
            depth=tree.depth,
            sf_scale=parameters.sf_scale,
            sf_rotation=parameters.sf_rotation,
            sf_opacity=parameters.sf_opacity,
            sf_sh=parameters.sf_sh,
        ),
        coded,
    )
    seconds["quantise and code"] = time.perf_counter() - started
    if pruned is not None:
        order = pruned.survivors[order]
    return Encoded(pieces, sum(map(len, pieces)), order, pruned, seconds)


def reduce_scene(
    scene: Scene,
    cameras: Sequence[Camera],
    options: EncodeOptions,
    progress: Progress | None = None,
    device: Device | None = None,
) -> tuple[Scene, Pruned | None]:
    """Remove splats and make the colours of the others sparse, as far as the options say.

    Args:
        scene: uncompressed; its renders are the target.
        cameras: only the training views among them are looked at.
        options: the hyper-parameters of pruning and compaction count here.
        progress: told how far the stages are.
        device: the best one there is by default.

    Returns:
        The splats that are left, in their order, and what pruning did (None if it was left out).

    Raises:
        UsageError: options out of range, or no training view.
        DeviceError: the scene does not fit the device.
    """
    report = progress or (lambda stage, done: None)
    parameters = options.parameters
    schedule = PruningOptions(parameters.delta_mse_max, options.iterations, count=options.count)
    if not 0 <= options.compact_at <= 1:
        raise UsageError(f"compact_at is {options.compact_at:g}, it must lie between 0 and 1")
    views = train_views(cameras)
    device = device or Device()
    rasterizer = Rasterizer(device, scene, background=options.background)
    removal: RemovalSweep | None = None
    sh = scene.sh
    compacted = not options.compact or scene.sh_degree == 0

    def compact() -> None:
        nonlocal sh, compacted
        assert removal is not None
        weights = ViewWeights.from_importances(len(scene), removal.view_importances())
        how = CompactionOptions(lam=parameters.lam, alpha=parameters.alpha, sf_sh=parameters.sf_sh)
        sh = Compactor(device).compact(scene, camera_centres(views), weights, how).sh
        compacted = True

    def after_iteration(iteration: int, gone: NDArray[np.int64]) -> None:
        if not compacted and iteration + 1 >= options.compact_at * options.iterations:
            compact()
            assert removal is not None
            removal.replace_sh(sh)

    try:
        report("prepare views", 0.0)
        removal = RemovalSweep(
            rasterizer, views, options.sweep, lambda done, count: report("prepare views", done / count)
        )
        pruned: Pruned | None = None
        survivors = np.arange(len(scene))
        if options.prune:
            report("prune", 0.0)
            pruned = prune(
                removal,
                len(scene),
                schedule,
                lambda done, kept: report("prune", min(done / options.iterations, 0.99)),
                after_iteration,
            )
            report("prune", 1.0)
            survivors = pruned.survivors
        if not compacted:
            report("compact", 0.0)
            if pruned is None:
                removal.measure()
            compact()
            report("compact", 1.0)
        kept = scene.subset(survivors)
        return Scene(kept.means, kept.log_scales, kept.quaternions, kept.opacity_logits, sh[survivors]), pruned
    finally:
        if removal is not None:
            removal.free()
        rasterizer.free()


def _tolerance(
    means: NDArray[np.float32], cameras: Sequence[Camera] | None, parameters: quantize.HyperParameters
) -> NDArray[np.float64] | float:
    """max(γ, β · distance to the nearest training view), the paper's precision criterion."""
    if cameras is None or parameters.beta == 0:
        return parameters.gamma
    eyes = camera_centres(train_views(cameras))
    nearest = np.empty(len(means))
    for start in range(0, len(means), _NEAR_BLOCK):
        x, y, z = means[start : start + _NEAR_BLOCK].T.astype(np.float64)
        least = nearest[start : start + _NEAR_BLOCK]
        least[:] = np.inf
        for eye in eyes:
            squared = np.square(x - eye[0])
            squared += np.square(y - eye[1])
            squared += np.square(z - eye[2])
            np.minimum(least, squared, out=least)
    return np.maximum(parameters.gamma, parameters.beta * np.sqrt(nearest))


def _metadata(scene: Scene, cameras: Sequence[Camera] | None, options: EncodeOptions, pruned: Pruned | None) -> bytes:
    facts = {
        "q": options.q,
        "beta": options.parameters.beta if cameras is not None else None,
        "gamma": options.parameters.gamma,
        "delta_mse_max": options.parameters.delta_mse_max if pruned is not None and options.count is None else None,
        "lambda": options.parameters.lam if cameras is not None and options.compact else None,
        "alpha": options.parameters.alpha if cameras is not None and options.compact else None,
        "source_splats": len(scene),
        "source_bytes": options.source_bytes,
    }
    return json.dumps(facts, separators=(",", ":")).encode()


# ------------------------------------------------------------------------------------------------ streams

#: Property, index, bytes before coding, bytes an integer.
_Stream = tuple[Property, int, bytes, int]
#: Makes the streams of one property when a thread is free for it.
_Job = Callable[[], list[_Stream]]


def _octree_jobs(tree: octree.OctreeStreams) -> list[_Job]:
    def multiplicities() -> list[_Stream]:
        return [(Property.MULTIPLICITY, 0, *bitstream.pack_integers(tree.multiplicities, signed=False))]

    return [
        lambda: [(Property.TAIL, 0, tree.tails.tobytes(), 1)],
        lambda: [(Property.OCCUPANCY, 0, tree.occupancy.tobytes(), 1)],
        lambda: [(Property.SEVERAL, 0, tree.several.tobytes(), 1)],
        lambda: [(Property.TAIL_LENGTH, 0, tree.tail_lengths.tobytes(), 1)],
        multiplicities,
    ]


def _attribute_jobs(scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters) -> list[_Job]:
    def pack(prop: Property, index: int, steps: quantize.Integers) -> _Stream:
        return prop, index, *bitstream.pack_integers(steps, bitstream.is_signed(prop))

    def rotations_and_scales() -> list[_Stream]:
        imaginary = np.empty((len(scene), 3))
        log_scales = np.empty((len(scene), 3), np.float32)
        for start in range(0, len(scene), _BLOCK):
            rows = order[start : start + _BLOCK]
            block = slice(start, start + len(rows))
            imaginary[block], log_scales[block] = quantize.canonical_rotations(
                scene.quaternions[rows], scene.log_scales[rows]
            )
        streams = []
        for axis in range(3):
            rotation = quantize.quantize_rotations(imaginary[:, axis], parameters.sf_rotation)
            scale = quantize.quantize_scales(log_scales[:, axis].astype(np.float64), parameters.sf_scale)
            streams += [pack(Property.ROTATION, axis, rotation), pack(Property.SCALE, axis, scale)]
        return streams

    def opacities() -> list[_Stream]:
        logits = scene.opacity_logits[order].astype(np.float64)
        steps = quantize.quantize_opacities(logits, parameters.sf_opacity)
        # Always stored, one plane at the least: its length vouches for the number of splats.
        raw, planes = bitstream.pack_integers(steps, signed=False)
        return [(Property.OPACITY, 0, raw or bytes(len(scene)), max(planes, 1))]

    def coefficient(m: int) -> _Job:
        def streams() -> list[_Stream]:
            channels = quantize.to_ycocg(scene.sh[order, m].astype(np.float64))
            made = []
            for channel, values in enumerate(channels):
                steps = quantize.quantize_sh(values, parameters.sf_sh)
                if m == 0:
                    steps = steps.astype(np.int64)
                    steps[1:] -= steps[:-1].copy()
                made.append(pack(Property.SH, 3 * m + channel, steps))
            return made

        return streams

    # The longest jobs first: a pool that ends with a long one ends late.
    return [rotations_and_scales, *(coefficient(m) for m in range(scene.sh.shape[1])), opacities]
