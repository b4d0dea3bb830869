"""From a scene to the bytes of a .potr file: octree, quantised streams, entropy coding; the threads do not matter."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl import bitstream, context_coder, octree, quantize
from potr_cl.bitstream import EntropyCoder, Header, Property, Section
from potr_cl.cameras import Camera, camera_centres
from potr_cl.context_coder import Run
from potr_cl.scene import Scene

#: Splats worked on at a time where a stage needs large temporaries.
_BLOCK = 1 << 14
#: Splats whose distances to every camera are taken at a time: a few arrays of them fit a second-level cache.
_NEAR_BLOCK = 1 << 14
#: Splats whose SH coefficients are quantised at a time, for the same reason.
_SH_BLOCK = 1 << 12
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
    pool = ThreadPoolExecutor(threads or os.cpu_count() or 1)
    try:
        report("octree", 0.0)
        nearest = _nearest(scene.means, views, pool.map)
        parameters = _in_world_units(parameters, scene, nearest)
        tolerance = np.maximum(parameters.gamma, parameters.beta * nearest)
        tree, order = octree.build(scene.means, tolerance, absolute=parameters.version > 1)
        report("octree", 1.0)
        stage = "quantise and code"
        report(stage, 0.0)
        groups = [*_octree_groups(tree), _Group(Property.METADATA, 0, [np.frombuffer(metadata, np.uint8)])]
        plain = pool.map(partial(_plain_sections, coder=coder), groups)
        attributes = _attribute_groups if parameters.version == 1 else _balanced_attribute_groups
        chains = attributes(scene, order, parameters, pool.map)
        report(stage, 0.2)
        coded = _code_chains(chains, coder, parameters.version, pool, lambda done: report(stage, 0.2 + 0.7 * done))
        coded += [section for sections in plain for section in sections]
        report(stage, 1.0)
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


def _nearest(means: NDArray[np.float32], views: Sequence[Camera], run: Run) -> NDArray[np.float64]:
    """(N,) distance to the nearest view; without views 0, which leaves the tolerance to γ."""
    nearest = np.zeros(len(means))
    if not views:
        return nearest
    eyes = camera_centres(views)

    def find(start: int) -> None:
        axes = means[start : start + _NEAR_BLOCK].T.astype(np.float64)
        least = nearest[start : start + _NEAR_BLOCK]
        squared, part = np.empty_like(least), np.empty_like(least)
        least[:] = np.inf
        for eye in eyes:
            for axis, (coordinates, at) in enumerate(zip(axes, eye, strict=True)):
                to = part if axis else squared
                np.subtract(coordinates, at, out=to)
                np.square(to, out=to)
                if axis:
                    np.add(squared, part, out=squared)
            np.minimum(least, squared, out=least)
        np.sqrt(least, out=least)

    list(run(find, range(0, len(means), _NEAR_BLOCK)))
    return nearest


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


def _code_chains(
    chains: list[list[_Group]],
    coder: EntropyCoder,
    version: int,
    pool: ThreadPoolExecutor,
    progress: Callable[[float], None],
) -> list[tuple[Section, bytes]]:
    """Sections of some groups: those of a chain tell each other's contexts, where there are contexts."""
    plain = partial(_plain_sections, coder=coder)
    if coder.name != "context" or version == 1:
        groups = [group for chain in chains for group in chain]
        coded = []
        for done, sections in enumerate(pool.map(plain, groups), start=1):
            coded.extend(sections)
            progress(done / len(groups))
        return coded
    kept = [[g for g in chain if g.prop == Property.OPACITY or any(s.any() for s in g.streams)] for chain in chains]
    # For few splats one has to try.
    few = len(chains[-1][0].streams[0]) < _FEW
    alternatives = [[pool.submit(plain, group) for group in chain] if few else [] for chain in kept]
    stored = context_coder.encode(
        [
            [
                context_coder.Streams(g.streams, bitstream.is_signed(g.prop), bitstream.is_predicted(g.prop, g.index))
                for g in chain
            ]
            for chain in kept
        ],
        pool.map,
        progress,
    )
    coded = []
    for chain, groups, data, others in zip(chains, kept, stored, alternatives, strict=True):
        made = None if data is None else _context_sections(groups, data, [other.result() for other in others])
        coded += [section for group in chain for section in plain(group)] if made is None else made
    return coded


def _context_sections(
    groups: list[_Group], stored: list[bytes], others: list[list[tuple[Section, bytes]]]
) -> list[tuple[Section, bytes]] | None:
    """A section a group; None where one of the others, which are plain, is smaller, or the format does not allow it."""
    sections = []
    for group, data in zip(groups, stored, strict=True):
        integers = len(group.streams) * len(group.streams[0])
        if integers > len(data) << 15:
            return None
        sections.append(bitstream.context_section(group.prop, group.index, len(group.streams), integers, data))
    for (_, data), plain in zip(sections, others, strict=False):
        if sum(len(p) for _, p in plain) + 24 * (len(plain) - 1) < len(data):
            return None
    return sections


def _octree_groups(tree: octree.OctreeStreams) -> list[_Group]:
    streams: list[tuple[Property, NDArray[np.unsignedinteger]]] = [
        (Property.TAIL, tree.tails),
        (Property.OCCUPANCY, tree.occupancy),
        (Property.SEVERAL, tree.several),
        (Property.TAIL_LENGTH, tree.tail_lengths),
        (Property.MULTIPLICITY, tree.multiplicities),
    ]
    return [_Group(prop, 0, [stream]) for prop, stream in streams if len(stream)]


def _canonical(scene: Scene, order: NDArray[np.int64], run: Run) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """:func:`potr_cl.quantize.canonical_rotations` in the order of the file."""
    imaginary = np.empty((len(scene), 3))
    log_scales = np.empty((len(scene), 3), np.float32)

    def turn(start: int) -> None:
        rows = order[start : start + _BLOCK]
        block = slice(start, start + len(rows))
        imaginary[block], log_scales[block] = quantize.canonical_rotations(
            scene.quaternions[rows], scene.log_scales[rows]
        )

    list(run(turn, range(0, len(scene), _BLOCK)))
    return imaginary, log_scales


def _coefficients(
    scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters, run: Run
) -> NDArray[np.signedinteger]:
    """(M, 3, N) integers of the SH coefficients' Y, Co, Cg."""
    count = scene.sh.shape[1]
    steps: NDArray[np.signedinteger] = np.empty((count, 3, len(scene)), np.int16)
    wide: list[tuple[tuple[int, int, slice], quantize.Integers]] = []

    def take(start: int) -> None:
        rows = order[start : start + _SH_BLOCK]
        block = slice(start, start + len(rows))
        planar = np.ascontiguousarray(scene.sh[rows].transpose(1, 2, 0))
        for m, rgb in enumerate(planar.astype(np.float64)):
            factor = parameters.sf_dc if m == 0 else parameters.sf_sh
            for c, values in enumerate(quantize.to_ycocg(rgb.T)):
                made = quantize.quantize_sh(values, factor)
                if made.dtype == steps.dtype:
                    steps[m, c, block] = made
                else:
                    wide.append(((m, c, block), made))

    list(run(take, range(0, len(scene), _SH_BLOCK)))
    if wide:
        steps = steps.astype(np.result_type(*{made.dtype for _, made in wide}))
        for where, made in wide:
            steps[where] = made
    return steps


def _attribute_groups(
    scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters, run: Run
) -> list[list[_Group]]:
    """Format version 1."""
    imaginary, log_scales = _canonical(scene, order, run)
    rotations = run(lambda part: quantize.quantize_rotations(part, parameters.sf_rotation), imaginary.T)
    scales = run(lambda part: quantize.quantize_scales(part.astype(np.float64), parameters.sf_scale), log_scales.T)
    coefficients = _coefficients(scene, order, parameters, run)
    logits = scene.opacity_logits[order].astype(np.float64)
    return [
        [_Group(Property.ROTATION, 0, list(rotations))],
        [_Group(Property.SCALE, 0, list(scales))],
        *([_Group(Property.SH, 3 * m, list(channels))] for m, channels in enumerate(coefficients)),
        [_Group(Property.OPACITY, 0, [quantize.quantize_opacities(logits, parameters.sf_opacity)])],
    ]


def _balanced_attribute_groups(
    scene: Scene, order: NDArray[np.int64], parameters: quantize.HyperParameters, run: Run
) -> list[list[_Group]]:
    """Format version 2."""
    imaginary, log_scales = _canonical(scene, order, run)
    scales = list(
        run(lambda part: quantize.quantize_scales(part.astype(np.float64), parameters.sf_scale), log_scales.T)
    )
    factors = quantize.rotation_factors(scales, parameters.sf_rotation)
    # A splat that is decoded as a ball has no direction.
    ball = (scales[0] == scales[1]) & (scales[1] == scales[2])
    rotations = run(lambda part: np.where(ball, 0, quantize.quantize_rotations(part, factors)), imaginary.T)
    logits = scene.opacity_logits[order].astype(np.float64)
    coefficients = _coefficients(scene, order, parameters, run)
    bands = [
        _Group(Property.SH, 3 * first, list(coefficients[first : (band + 1) ** 2].reshape(-1, len(scene))))
        for band in range(scene.sh_degree + 1)
        for first in [band**2]
    ]
    return [
        bands[1:],
        [_Group(Property.ROTATION, 0, list(rotations))],
        [_Group(Property.SCALE, 0, scales)],
        bands[:1],
        [_Group(Property.OPACITY, 0, [quantize.quantize_logits(logits, parameters.sf_opacity)])],
    ]
