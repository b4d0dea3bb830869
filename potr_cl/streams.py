"""From a scene to the bytes of a .potr file: octree, quantised streams, entropy coding; the threads do not matter."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl import bitstream, octree, quantize
from potr_cl.bitstream import EntropyCoder, Header, Property, Section
from potr_cl.cameras import Camera, camera_centres
from potr_cl.scene import Scene

#: Splats worked on at a time where a stage needs large temporaries.
_BLOCK = 1 << 16
#: Splats whose distances to every camera are taken at a time: a few arrays of them fit a second-level cache.
_NEAR_BLOCK = 1 << 14


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
        entropy: the entropy stage; zstd by default.
        threads: for the entropy stage. 0: one a processor.
        progress: told how far each stage is.

    Raises:
        DataError: a value too large to quantise.
    """
    report = progress or (lambda stage, done: None)
    coder = entropy or EntropyCoder()
    report("octree", 0.0)
    tree, order = octree.build(scene.means, _tolerance(scene.means, views, parameters))
    report("octree", 1.0)

    jobs = [*_octree_jobs(tree), *_attribute_jobs(scene, order, parameters)]
    jobs.append(lambda: [(Property.METADATA, 0, metadata, 1)])
    coded: list[tuple[Section, bytes]] = []

    def run(job: _Job) -> list[tuple[Section, bytes]]:
        return [coder.section(*stream) for stream in job() if stream[2]]

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
    return Coded(pieces, order)


def _tolerance(
    means: NDArray[np.float32], views: Sequence[Camera], parameters: quantize.HyperParameters
) -> NDArray[np.float64] | float:
    """max(γ, β · distance to the nearest view), the paper's precision criterion."""
    if not views or parameters.beta == 0:
        return parameters.gamma
    eyes = camera_centres(views)
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
