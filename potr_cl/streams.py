"""From a scene to the bytes of a .potr file: octree, quantised streams, entropy coding; the threads do not matter."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from potr_cl import bitstream, context_coder, octree, quantize
from potr_cl.bitstream import EntropyCoder, Header, Property, Section
from potr_cl.cameras import Camera, camera_centres
from potr_cl.scene import Scene

#: Splats worked on at a time where a stage needs large temporaries.
_BLOCK = 1 << 16
#: Splats whose distances to every camera are taken at a time: a few arrays of them fit a second-level cache.
_NEAR_BLOCK = 1 << 14
#: Of fewer splats the models of the context coder may weigh more than they save.
_FEW = 1 << 15
#: Streams of bytes, whose length means something.
_BYTES = {Property.METADATA, Property.OCCUPANCY, Property.SEVERAL, Property.TAIL_LENGTH, Property.TAIL}


@dataclass(frozen=True)
class Coded:
    """A scene as the bytes of a file.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        order: (N,) index in the scene of each splat of the file.
    """

    pieces: list[bytes]
    order: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        return sum(map(len, self.pieces))


def code_scene(
    scene: Scene,
    parameters: quantize.HyperParameters,
    views: Sequence[Camera] = (),
    metadata: bytes = b"",
    entropy: EntropyCoder | None = None,
    threads: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Coded:
    """Quantise and code a scene as it is.

    Args:
        scene: clean, at least one splat.
        parameters: γ, β and the scale factors count.
        views: they decide how coarse centres may be; without any, γ alone does.
        metadata: for the file's section of that name.
        entropy: the entropy stage.
        threads: for the entropy stage. 0: one a processor.
        progress: told how far each stage is.

    Raises:
        DataError: a value too large to quantise.
    """
    report = progress or (lambda stage, done: None)
    coder = entropy or EntropyCoder()
    report("octree", 0.0)
    nearest = _nearest(scene.means, views)
    parameters = _in_world_units(parameters, scene, nearest)
    tolerance = np.maximum(parameters.gamma, parameters.beta * nearest)
    tree, order = octree.build(scene.means, tolerance, absolute=parameters.version > 1)
    report("octree", 1.0)

    attributes = _attribute_jobs if parameters.version == 1 else _balanced_attribute_jobs
    jobs = [*attributes(scene, order, parameters), *_octree_jobs(tree)]
    jobs.append(lambda: [_Group(Property.METADATA, 0, [np.frombuffer(metadata, np.uint8)])])
    context = coder.name == "context" and parameters.version > 1
    coded: list[tuple[Section, bytes]] = []

    def run(job: _Job) -> list[tuple[Section, bytes]]:
        groups = job()
        sections = _context_sections(groups, coder) if context and groups[0].contextual else None
        return sections or [section for group in groups for section in _plain_sections(group, coder)]

    pool = ThreadPoolExecutor(threads or os.cpu_count() or 1)
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
            version=parameters.version,
            splats=len(scene),
            sh_degree=scene.sh_degree,
            origin=tree.origin,
            side=tree.side,
            depth=tree.depth,
            sf_scale=parameters.sf_scale,
            sf_rotation=parameters.sf_rotation,
            sf_opacity=parameters.sf_opacity,
            sf_dc=parameters.sf_dc,
            sf_ac=parameters.sf_sh,
        ),
        coded,
    )
    return Coded(pieces, order)


def _nearest(means: NDArray[np.float32], views: Sequence[Camera]) -> NDArray[np.float64]:
    """(N,) distance to the nearest view; without views 0, which leaves the tolerance to γ."""
    nearest = np.zeros(len(means))
    eyes = camera_centres(views) if views else ()
    for start in range(0, len(means) if views else 0, _NEAR_BLOCK):
        x, y, z = means[start : start + _NEAR_BLOCK].T.astype(np.float64)
        least = nearest[start : start + _NEAR_BLOCK]
        least[:] = np.inf
        for eye in eyes:
            squared = np.square(x - eye[0])
            squared += np.square(y - eye[1])
            squared += np.square(z - eye[2])
            np.minimum(least, squared, out=least)
    return np.sqrt(nearest)


def _in_world_units(
    parameters: quantize.HyperParameters, scene: Scene, nearest: NDArray[np.float64]
) -> quantize.HyperParameters:
    """β, γ and SF_scale, which version 2 takes in sizes of a typical splat, so that the unit of length does not matter.

    A splat's size is its largest standard deviation, the typical one their median; seen from the views, the median of
    size over distance.
    """
    if parameters.version == 1:
        return parameters
    sizes = np.exp(np.clip(scene.log_scales.max(axis=1).astype(np.float64), -60, 60))
    size = float(np.median(sizes))
    sf_scale = min(max(parameters.sf_scale / size, 1e-3), 1e9)
    seen = nearest > 0
    if seen.any():
        beta = parameters.beta * float(np.median(sizes[seen] / nearest[seen]))
        return replace(parameters, beta=beta, sf_scale=sf_scale)
    return replace(parameters, gamma=max(parameters.gamma, parameters.beta * size), sf_scale=sf_scale)


@dataclass(frozen=True)
class _Group:
    """Streams of one property, with consecutive indices from ``index`` on."""

    prop: Property
    index: int
    streams: list[NDArray[np.integer]]

    @property
    def contextual(self) -> bool:
        return bool(bitstream.context_groups(self.prop, 0))


#: Makes streams when a thread is free for it: those of one job have contexts in common.
_Job = Callable[[], list[_Group]]


def _plain_sections(group: _Group, coder: EntropyCoder) -> list[tuple[Section, bytes]]:
    """A section a stream; none where all integers are 0, but for opacity, whose length vouches for that of others."""
    signed = bitstream.is_signed(group.prop)
    sections = []
    for index, stream in enumerate(group.streams, start=group.index):
        if bitstream.is_predicted(group.prop, group.index):
            stream = stream.astype(np.int64)
            stream[1:] -= stream[:-1].copy()
        if group.prop in _BYTES:
            raw, planes = stream.astype(np.uint8).tobytes(), 1
        else:
            raw, planes = bitstream.pack_integers(stream, signed)
        if group.prop == Property.OPACITY and not raw:
            raw, planes = bytes(len(stream)), 1
        if raw:
            sections.append(coder.section(group.prop, index, raw, planes))
    return sections


def _context_sections(groups: list[_Group], coder: EntropyCoder) -> list[tuple[Section, bytes]] | None:
    """A section a group; None where plain ones are smaller or the integers too large."""
    history = context_coder.Sizes(context_coder.Lanes(max(len(groups[0].streams[0]), 1)))
    sections = []
    for group in groups:
        if group.prop != Property.OPACITY and not any(stream.any() for stream in group.streams):
            continue
        n = len(group.streams[0])
        signed = bitstream.is_signed(group.prop)
        predicted = bitstream.is_predicted(group.prop, group.index)
        stored = context_coder.encode(group.streams, signed, predicted, history)
        integers = n * len(group.streams)
        if stored is None or integers > len(stored) << 15:
            return None
        sections.append(bitstream.context_section(group.prop, group.index, len(group.streams), integers, stored))
        if n < _FEW:
            plain = _plain_sections(group, coder)
            if sum(len(data) for _, data in plain) + 24 * (len(plain) - 1) < len(stored):
                return None
    return sections


def _octree_jobs(tree: octree.OctreeStreams) -> list[_Job]:
    streams: list[tuple[Property, NDArray[np.unsignedinteger]]] = [
        (Property.TAIL, tree.tails),
        (Property.OCCUPANCY, tree.occupancy),
        (Property.SEVERAL, tree.several),
        (Property.TAIL_LENGTH, tree.tail_lengths),
        (Property.MULTIPLICITY, tree.multiplicities),
    ]
    return [partial(lambda prop, stream: [_Group(prop, 0, [stream])], *stream) for stream in streams if len(stream[1])]


def _canonical(scene: Scene, order: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """:func:`potr_cl.quantize.canonical_rotations` in the order of the file."""
    imaginary = np.empty((len(scene), 3))
    log_scales = np.empty((len(scene), 3), np.float32)
    for start in range(0, len(scene), _BLOCK):
        rows = order[start : start + _BLOCK]
        block = slice(start, start + len(rows))
        imaginary[block], log_scales[block] = quantize.canonical_rotations(
            scene.quaternions[rows], scene.log_scales[rows]
        )
    return imaginary, log_scales


def _coefficient(
    scene: Scene, order: NDArray[np.int64], m: int, parameters: quantize.HyperParameters
) -> list[quantize.Integers]:
    factor = parameters.sf_dc if m == 0 else parameters.sf_sh
    return [quantize.quantize_sh(v, factor) for v in quantize.to_ycocg(scene.sh[order, m].astype(np.float64))]


def _attribute_jobs(scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters) -> list[_Job]:
    """Format version 1."""

    def shapes() -> list[_Group]:
        imaginary, log_scales = _canonical(scene, order)
        rotations = [quantize.quantize_rotations(part, parameters.sf_rotation) for part in imaginary.T]
        scales = [quantize.quantize_scales(part, parameters.sf_scale) for part in log_scales.T.astype(np.float64)]
        return [_Group(Property.ROTATION, 0, list(rotations)), _Group(Property.SCALE, 0, list(scales))]

    def opacities() -> list[_Group]:
        logits = scene.opacity_logits[order].astype(np.float64)
        return [_Group(Property.OPACITY, 0, [quantize.quantize_opacities(logits, parameters.sf_opacity)])]

    def coefficient(m: int) -> list[_Group]:
        return [_Group(Property.SH, 3 * m, list(_coefficient(scene, order, m, parameters)))]

    # The longest jobs first: a pool that ends with a long one ends late.
    return [shapes, *(partial(coefficient, m) for m in range(scene.sh.shape[1])), opacities]


def _balanced_attribute_jobs(
    scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters
) -> list[_Job]:
    """Format version 2."""
    imaginary, log_scales = _canonical(scene, order)
    scales = [quantize.quantize_scales(part, parameters.sf_scale) for part in log_scales.T.astype(np.float64)]

    def rotations() -> list[_Group]:
        factors = quantize.rotation_factors(scales, parameters.sf_rotation)
        streams = [quantize.quantize_rotations(part, factors) for part in imaginary.T]
        # A splat that is decoded as a ball has no direction.
        ball = (scales[0] == scales[1]) & (scales[1] == scales[2])
        return [_Group(Property.ROTATION, 0, [np.where(ball, 0, stream) for stream in streams])]

    def opacities() -> list[_Group]:
        logits = scene.opacity_logits[order].astype(np.float64)
        return [_Group(Property.OPACITY, 0, [quantize.quantize_logits(logits, parameters.sf_opacity)])]

    def coefficients(first: int, last: int) -> list[_Group]:
        made = [_coefficient(scene, order, m, parameters) for m in range(first, last)]
        edges = [band**2 for band in range(5) if first <= band**2 <= last]
        return [
            _Group(Property.SH, 3 * a, [s for channels in made[a - first : b - first] for s in channels])
            for a, b in pairwise(edges)
        ]

    jobs: list[_Job] = [rotations, lambda: [_Group(Property.SCALE, 0, list(scales))], opacities]
    jobs.append(partial(coefficients, 0, 1))
    if scene.sh.shape[1] > 1:
        jobs.insert(0, partial(coefficients, 1, scene.sh.shape[1]))
    return jobs
