"""From a scene to the bytes of a .potr file (:func:`code_scene`): octree, quantised streams, entropy coding.

The bytes do not depend on the number of threads, nor on how many blocks are coded side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, octree, plain, quantize
from potr_cl.codec.blocks import AnyGeometry, GeometryOfBlocks, quantise
from potr_cl.codec.bundles import encoder as bundles
from potr_cl.codec.bundles.layout import BUNDLE
from potr_cl.codec.container import Block, CodedSection, EntropyCoder
from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.sections import ORDER, SH, Coder, Property
from potr_cl.codec.splat_levels import colour_levels
from potr_cl.codec.steps.prediction import to_residuals
from potr_cl.errors import DataError
from potr_cl.host.threads import Run, thread_pool
from potr_cl.model.box import Box
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene

#: Threads that a block keeps busy: with more of them, further blocks are coded beside it, up to so many.
_THREADS_A_BLOCK, _SIDE_BY_SIDE = 4, 8


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


@dataclass(frozen=True)
class Level:
    """A level of detail that is to be written.

    Attributes:
        scene: whose colours are coded.
        geometry: of the scene, with its steps of colours.
        error: by how far, world units, its splats may be off those of the finest level.
    """

    scene: Scene
    geometry: AnyGeometry
    error: float = 0.0


def code_scene(
    scene: Scene,
    parameters: quantize.HyperParameters,
    views: Sequence[Camera] = (),
    metadata: bytes = b"",
    entropy: EntropyCoder | None = None,
    threads: int = 0,
    progress: Callable[[str, float], None] | None = None,
    geometry: AnyGeometry | None = None,
) -> Coded:
    """Quantise and code a scene as it is.

    Args:
        scene: clean, at least one splat.
        parameters: γ, β and the scale factors count.
        views: they decide how coarse centres may be; without any, γ alone does.
        metadata: JSON, how the file was made.
        entropy: the entropy stage.
        threads: to work with; the bytes do not depend on it. 0: one a processor.
        progress: told how far each stage is.
        geometry: of the scene, with these parameters and views, where it was quantised before.

    Raises:
        DataError: a value too large to quantise.
    """
    report = progress or (lambda stage, done: None)
    report("octree", 0.0)
    if geometry is None:
        with thread_pool(threads) as pool:
            geometry = quantise(scene, parameters, views, pool.map)
    report("octree", 1.0)
    return code_levels([Level(scene, geometry)], metadata, entropy, threads, progress)


def code_levels(
    levels: Sequence[Level],
    metadata: bytes = b"",
    entropy: EntropyCoder | None = None,
    threads: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Coded:
    """Code a scene in one or more levels of detail.

    Args:
        levels: the finest first; quantised alike.
        metadata, entropy, threads, progress: as of :func:`code_scene`.

    Returns:
        The file; its order is that of the finest level.

    Raises:
        As :func:`code_scene`.
    """
    coder, threads = entropy or EntropyCoder(), threads or os.cpu_count() or 1
    work = [(number, level, *block) for number, level in enumerate(levels) for block in _blocks(level)]
    # The coarsest comes first in a file.
    work.sort(key=lambda each: -each[0])
    side_by_side = max(min(threads // _THREADS_A_BLOCK, _SIDE_BY_SIDE, len(work)), 1)
    report = _Progress(progress, len(work))

    def code(
        each: tuple[int, Level, NDArray[np.int64] | None, Geometry],
    ) -> tuple[Block, list[CodedSection]]:
        number, level, rows, geometry = each
        scene = level.scene if rows is None else level.scene.subset(rows)
        with thread_pool(_threads_for(len(geometry.order), -(-threads // side_by_side))) as pool:
            coded = _coded(number, level.error, scene, geometry, coder, pool)
        report.one_more()
        return coded

    report.tell(0)
    with ThreadPoolExecutor(side_by_side) as pool:
        futures: list[Future[tuple[Block, list[CodedSection]]]] = [pool.submit(code, each) for each in work]
        try:
            blocks = [future.result() for future in futures]
        finally:
            # After an error nothing that has not begun should begin.
            for future in futures:
                future.cancel()
    own = [coder.section(Property.METADATA, metadata)] if metadata else []
    return Coded(container.assemble(blocks, own), levels[0].geometry.order)


def _threads_for(splats: int, most: int) -> int:
    """As few threads as go through a block's bundles in as many turns as the most would."""
    bundles = -(-splats // BUNDLE)
    return max(-(-bundles // -(-bundles // most)), min(most, _THREADS_A_BLOCK))


def _blocks(level: Level) -> Iterable[tuple[NDArray[np.int64] | None, Geometry]]:
    """Each block's splats in the scene (None: all), and its geometry."""
    geometry = level.geometry
    if isinstance(geometry, GeometryOfBlocks):
        return zip(geometry.rows, geometry.blocks, strict=True)
    return [(None, geometry)]


def _coded(
    level: int, error: float, scene: Scene, geometry: Geometry, coder: EntropyCoder, pool: ThreadPoolExecutor
) -> tuple[Block, list[CodedSection]]:
    """A block and its sections."""
    parameters, tree = geometry.parameters, geometry.tree
    rules = QUANTISERS[parameters.quantiser]
    octree_bytes = {
        Property.OCCUPANCY: tree.occupancy,
        Property.SEVERAL: tree.several,
        Property.MULTIPLICITY: tree.multiplicities.astype("<u4"),
        Property.LEAF_LEVEL: tree.leaf_levels,
        Property.TAIL: tree.tails,
    }
    raw = {prop: stream.tobytes() for prop, stream in octree_bytes.items() if len(stream)}
    if geometry.steps is not None:
        raw[Property.STEPS] = geometry.steps.to_bytes()
    box = pool.submit(_box, geometry)
    others = [pool.submit(coder.section, prop, content) for prop, content in raw.items()]
    classes = geometry.colour_classes()
    levels = colour_levels(scene.sh, geometry.order, parameters, classes, pool.map)
    values: dict[Property, list[NDArray[np.integer]]] = {
        Property.OPACITY: [geometry.opacities],
        Property.SCALE: [*geometry.scales],
        Property.ROTATION: [*geometry.rotations],
    }
    for degree in range(scene.sh_degree + 1):
        values[SH[degree]] = list(levels[degree**2 : (degree + 1) ** 2].reshape(-1, len(scene)))
    kind, coded = Coder.PLAIN, None
    if coder.name == "bundles" and rules.colour_steps:
        kind, coded = Coder.BUNDLES, _in_bundles(values, classes[0], pool.map)
    if coded is None:
        kind, coded = Coder.PLAIN, plain.encode(values, coder, pool.map)
    if coded is None:
        raise DataError("a splat's integers have more than 56 bits: lower the scale factors")
    coded += [future.result() for future in others]
    place = {prop.value: k for k, prop in enumerate(ORDER)}
    coded.sort(key=lambda pair: place[pair[0].name])
    factors = (parameters.sf_scale, parameters.sf_rotation, parameters.sf_opacity, parameters.sf_dc, parameters.sf_sh)
    block = Block(
        len(scene), scene.sh_degree, tree.origin, tree.side, tree.depth, *factors, parameters.quantiser, kind,
        box.result(), level, error, scene.antialiased, scene.low_pass,
    )  # fmt: skip
    return block, coded


def _in_bundles(
    values: dict[Property, list[NDArray[np.integer]]], classes: NDArray[np.int8], run: Run
) -> list[CodedSection] | None:
    """Sections of coder BUNDLES; None where an integer is too large."""
    dc = to_residuals(np.stack(values[Property.SH0], dtype=np.int64), classes)
    streams: dict[Property, list[NDArray[np.integer]]] = {**values, Property.SH0: [_narrowed(row) for row in dc]}
    kept = {k: own for k, own in streams.items() if k is Property.OPACITY or any(stream.any() for stream in own)}
    stored = bundles.encode(kept, classes, run)
    return None if stored is None else [container.section_of(prop, data, data) for prop, data in stored.items()]


def _narrowed(integers: NDArray[np.int64]) -> NDArray[np.signedinteger]:
    """The same in the smallest type that the coders take."""
    largest = max(int(integers.max(initial=0)), -int(integers.min(initial=0)) - 1)
    return integers.astype(quantize.level_type(largest), copy=False)


def _box(geometry: Geometry) -> Box:
    """Around the centres as they are decoded."""
    means = geometry.centres if geometry.centres is not None else octree.parse(geometry.tree, len(geometry.order))
    low, high = means.min(axis=0).tolist(), means.max(axis=0).tolist()
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))


class _Progress:
    """Counts blocks that are done, from any thread."""

    def __init__(self, tell: Callable[[str, float], None] | None, blocks: int) -> None:
        self._tell, self._blocks, self._done, self._lock = tell, blocks, 0, Lock()

    def one_more(self) -> None:
        with self._lock:
            self._done += 1
            self.tell(self._done / self._blocks)

    def tell(self, part: float) -> None:
        if self._tell is not None:
            self._tell("entropy coding", part)
