"""From a scene to the bytes of a .potr file (:func:`code_scene`): octree, quantised streams, entropy coding.

The bytes do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, octree, quantize, sections
from potr_cl.codec.bundles import encoder as bundles_encoder
from potr_cl.codec.byte_planes import pack_integers
from potr_cl.codec.colours import colour_levels
from potr_cl.codec.container import EntropyCoder, Header
from potr_cl.codec.context import encoder as context_encoder
from potr_cl.codec.geometry import Geometry, quantise_geometry
from potr_cl.codec.sections import Coder, Property, Section
from potr_cl.codec.steps.prediction import to_residuals
from potr_cl.codec.versions import VERSIONS, FormatVersion
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene

#: Of fewer splats the models of the context coder may weigh more than they save.
_FEW = 1 << 15


@dataclass(frozen=True)
class Coded:
    """A scene as the bytes of a file.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        order: (N,) index in the scene of each splat of the file.
        sh_degree: of the file, where that was for its format to choose; None: of the scene.
    """

    pieces: list[bytes]
    order: NDArray[np.int64]
    sh_degree: int | None = None

    @property
    def nbytes(self) -> int:
        """Of the whole file."""
        return sum(map(len, self.pieces))


def code_scene(
    scene: Scene,
    parameters: quantize.HyperParameters,
    views: Sequence[Camera] = (),
    metadata: bytes = b"",
    entropy: EntropyCoder | None = None,
    threads: int = 0,
    progress: Callable[[str, float], None] | None = None,
    geometry: Geometry | None = None,
) -> Coded:
    """Quantise and code a scene as it is.

    Args:
        scene: clean, at least one splat.
        parameters: γ, β and the scale factors count.
        views: they decide how coarse centres may be; without any, γ alone does.
        metadata: for the file's section of that name.
        entropy: the entropy stage.
        threads: to work with; the bytes do not depend on it. 0: one a processor.
        progress: told how far each stage is.
        geometry: of the scene, with these parameters and views, where it was quantised before.

    Raises:
        DataError: a value too large to quantise.
        UsageError: the file's version cannot hold the parameters.
    """
    version = VERSIONS[parameters.version]
    version.check(parameters)
    report = progress or (lambda stage, done: None)
    coder = entropy or EntropyCoder()
    with thread_pool(threads) as pool:
        report("octree", 0.0)
        geometry = geometry or quantise_geometry(scene, parameters, views, pool.map)
        parameters, tree, order = geometry.parameters, geometry.tree, geometry.order
        report("octree", 1.0)
        stage = "quantise and code"
        report(stage, 0.0)
        groups = [*_octree_groups(tree), _Group(Property.METADATA, 0, [np.frombuffer(metadata, np.uint8)])]
        if geometry.steps is not None:
            groups.append(_Group(Property.STEPS, 0, [np.frombuffer(geometry.steps.to_bytes(), np.uint8)]))
        plain = pool.map(partial(_plain_sections, coder=coder), groups)
        classes = geometry.colour_classes()
        coefficients = colour_levels(scene.sh, order, parameters, classes, pool.map)
        chains = _chains(geometry, coefficients, classes[0] if version.colour_steps else None)
        report(stage, 0.2)
        coded = _code_chains(chains, coder, version, classes[0], pool, lambda done: report(stage, 0.2 + 0.7 * done))
        coded += [pair for pairs in plain for pair in pairs]
        report(stage, 1.0)
    coded.sort(key=lambda pair: (pair[0].kind, pair[0].index))
    pieces = container.assemble(
        Header(
            version=version.number,
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
            antialiased=scene.antialiased,
            low_pass=scene.low_pass,
        ),
        coded,
    )
    return Coded(pieces, order)


@dataclass(frozen=True)
class _Group:
    """Streams of one property, with consecutive indices from ``index`` on.

    ``final`` are integers of DC that are differences already.
    """

    prop: Property
    index: int
    streams: Sequence[NDArray[np.integer]]
    final: bool = False

    @property
    def predicted(self) -> bool:
        """Whether coder CONTEXT stores differences of these integers."""
        return sections.is_predicted(self.prop, self.index) and not self.final


def _plain_sections(group: _Group, coder: EntropyCoder) -> list[tuple[Section, bytes]]:
    """A section a stream; none where all integers are 0, but for opacity, whose length vouches for that of others."""
    signed = sections.is_signed(group.prop)
    coded = []
    for index, stream in enumerate(group.streams, start=group.index):
        if group.prop == Property.SH and index < 3 and not group.final:
            stream = stream.astype(np.int64)
            stream[1:] -= stream[:-1].copy()
        if sections.is_bytes(group.prop):
            raw, planes = stream.astype(np.uint8).tobytes(), 1
        else:
            raw, planes = pack_integers(stream, signed)
        if group.prop == Property.OPACITY and not raw:
            raw, planes = bytes(len(stream)), 1
        if raw:
            coded.append(coder.section(group.prop, index, raw, planes))
    return coded


def _code_chains(
    chains: list[list[_Group]],
    coder: EntropyCoder,
    version: FormatVersion,
    classes: NDArray[np.int8],
    pool: ThreadPoolExecutor,
    progress: Callable[[float], None],
) -> list[tuple[Section, bytes]]:
    """Sections of some groups: those of a chain tell each other's contexts, where the context coder codes them."""
    plain = partial(_plain_sections, coder=coder)
    coded: list[tuple[Section, bytes]] = []
    streams_by = version.coder_of_streams if coder.name == "context" else None
    if streams_by == Coder.BUNDLES:
        return _code_bundles(chains, classes, plain, pool, progress)
    if streams_by is None:
        # Each stream by itself, so that there is something to do for every thread.
        groups = [
            _Group(g.prop, g.index + k, [s], g.final)
            for chain in chains
            for g in chain
            for k, s in enumerate(g.streams)
        ]
        for done, made in enumerate(pool.map(plain, groups), start=1):
            coded += made
            progress(done / len(groups))
        return coded
    kept = [[g for g in chain if g.prop == Property.OPACITY or any(s.any() for s in g.streams)] for chain in chains]
    # For few splats one has to try.
    few = len(chains[-1][0].streams[0]) < _FEW
    alternatives = [[pool.submit(plain, group) for group in chain] if few else [] for chain in kept]
    streams = [[context_encoder.Streams(g.streams, sections.is_signed(g.prop), g.predicted) for g in c] for c in kept]
    stored = context_encoder.encode(streams, pool.map, progress)
    for chain, groups, data, others in zip(chains, kept, stored, alternatives, strict=True):
        contextual = None if data is None else _context_sections(groups, data, [other.result() for other in others])
        coded += [pair for group in chain for pair in plain(group)] if contextual is None else contextual
    return coded


def _code_bundles(
    chains: list[list[_Group]],
    classes: NDArray[np.int8],
    plain: Callable[[_Group], list[tuple[Section, bytes]]],
    pool: ThreadPoolExecutor,
    progress: Callable[[float], None],
) -> list[tuple[Section, bytes]]:
    """All sections of splats by coder BUNDLES; none where they would be smaller without, or the format forbids it."""
    groups = [group for chain in chains for group in chain]
    kept = [g for g in groups if g.prop == Property.OPACITY or any(s.any() for s in g.streams)]
    splats = len(groups[0].streams[0])
    # For few splats one has to try.
    others = [pool.submit(plain, group) for group in kept] if splats < _FEW else []
    stored = bundles_encoder.encode({(g.prop, g.index): g.streams for g in kept}, classes, pool.map, progress)
    made = []
    for group in kept if stored else []:
        data = (stored or {})[group.prop, group.index]
        integers = len(group.streams) * splats
        if integers > container.most_integers(Coder.BUNDLES, data):
            break
        made.append(
            container.stream_section(Coder.BUNDLES, group.prop, group.index, len(group.streams), integers, data)
        )
    if len(made) == len(kept) and not others:
        return made
    alternative = [pair for group in (others or kept) for pair in _plain_of(group, plain)]
    return min((made, alternative), key=_bytes_of) if len(made) == len(kept) else alternative


def _plain_of(
    group: _Group | Future[list[tuple[Section, bytes]]], plain: Callable[[_Group], list[tuple[Section, bytes]]]
) -> list[tuple[Section, bytes]]:
    return group.result() if isinstance(group, Future) else plain(group)


def _bytes_of(coded: list[tuple[Section, bytes]]) -> int:
    return sum(len(data) + container.ENTRY_BYTES for _, data in coded)


def _context_sections(
    groups: list[_Group], stored: list[bytes], others: list[list[tuple[Section, bytes]]]
) -> list[tuple[Section, bytes]] | None:
    """A section a group; None where one of the others, which are plain, is smaller, or the format does not allow it."""
    made = []
    for group, data in zip(groups, stored, strict=True):
        integers = len(group.streams) * len(group.streams[0])
        if integers > container.most_integers(Coder.CONTEXT, data):
            return None
        made.append(
            container.stream_section(Coder.CONTEXT, group.prop, group.index, len(group.streams), integers, data)
        )
    for (_, data), plain in zip(made, others, strict=False):
        if sum(len(p) for _, p in plain) + 24 * (len(plain) - 1) < len(data):
            return None
    return made


def _octree_groups(tree: octree.OctreeStreams) -> list[_Group]:
    streams: list[tuple[Property, NDArray[np.unsignedinteger]]] = [
        (Property.TAIL, tree.tails),
        (Property.OCCUPANCY, tree.occupancy),
        (Property.SEVERAL, tree.several),
        (Property.TAIL_LENGTH, tree.tail_lengths),
        (Property.MULTIPLICITY, tree.multiplicities),
    ]
    return [_Group(prop, 0, [stream]) for prop, stream in streams if len(stream)]


def _chains(
    geometry: Geometry, coefficients: NDArray[np.signedinteger], classes: NDArray[np.int8] | None
) -> list[list[_Group]]:
    """All integers of splats; the groups of a chain tell each other's contexts, the longest chain comes first.

    With ``classes`` of the steps of DC, DC is predicted as values rather than by the coder.
    """
    degree = round(len(coefficients) ** 0.5) - 1
    if classes is None:
        dc = _Group(Property.SH, 0, list(coefficients[0]))
    else:
        residuals = to_residuals(coefficients[0].astype(np.int64), classes)
        dc = _Group(Property.SH, 0, [_narrowed(row) for row in residuals], final=True)
    bands = [
        _Group(Property.SH, 3 * first, list(coefficients[first:end].reshape(-1, coefficients.shape[2])))
        for first, end in ((band**2, (band + 1) ** 2) for band in range(1, degree + 1))
    ]
    return [
        bands,
        [_Group(Property.ROTATION, 0, geometry.rotations)],
        [_Group(Property.SCALE, 0, geometry.scales)],
        [dc],
        [_Group(Property.OPACITY, 0, [geometry.opacities])],
    ]


def _narrowed(integers: NDArray[np.int64]) -> NDArray[np.signedinteger]:
    """The same in the smallest type that the coders take."""
    largest = max(int(integers.max(initial=0)), -int(integers.min(initial=0)) - 1)
    for dtype in (np.int16, np.int32):
        if largest <= np.iinfo(dtype).max:
            return integers.astype(dtype)
    return integers
