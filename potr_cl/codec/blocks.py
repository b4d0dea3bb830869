"""Scenes in blocks: cut into neighbours (:func:`blocks_of`), each quantised in an octree of its own (:func:`quantise`).

So neither coding nor decoding takes memory for more than the blocks that are worked on, and a part of a scene is read
without the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.geometry import Geometry, distances_to_views, quantise_geometry, quantise_in_world_units, undecoded
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.steps.fitting import fit_steps_of_blocks
from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.order import BITS, morton_codes
from potr_cl.model.scene import FloatArray, Scene

#: Scenes of no more splats are one block; others have blocks of so many at most. A block's own header, models and steps
#: are a few kilobytes, and its octree begins anew: next to nothing for a million.
MOST_WHOLE, MOST_A_BLOCK = 1 << 21, 1 << 20


#: Of a Morton code of 63 bits, those by which most splats are told apart.
_FIRST_BITS = 16


def blocks_of(means: NDArray[np.float32], most_a_block: int = MOST_A_BLOCK, run: Run = map) -> list[NDArray[np.int64]]:
    """The numbers of the splats of each block, ascending; blocks are ranges of the Morton order of the centres.

    Args:
        means: (N, 3) float32 centres, finite, N >= 1.
        most_a_block: the most splats of a block.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        As few blocks as that allows, of about the same number of splats each.
    """
    n = len(means)
    codes = morton_codes(means, run)
    blocks = -(-n // most_a_block)
    ends = np.array([n * (block + 1) // blocks for block in range(blocks)])
    # Only where a block ends within those whose first bits are the same is their order needed.
    cells = (codes >> np.uint64(3 * BITS - _FIRST_BITS)).astype(np.uint16)
    behind = np.cumsum(np.bincount(cells, minlength=1 << _FIRST_BITS))
    before = np.concatenate([[0], behind[:-1]])
    blocks_of_cells = np.searchsorted(ends, before, side="right")
    block_of = blocks_of_cells.astype(np.int32)[cells]
    for cell in np.flatnonzero((np.searchsorted(ends, behind - 1, side="right") > blocks_of_cells) & (behind > before)):
        members = np.flatnonzero(cells == cell)
        members = members[np.argsort(codes[members], kind="stable")]
        block_of[members] = np.searchsorted(ends, before[cell] + np.arange(len(members)), side="right")
    return list(run(lambda block: np.flatnonzero(block_of == block), range(blocks)))


@dataclass(frozen=True)
class GeometryOfBlocks:
    """A scene's quantised geometry, block by block; what it offers is that of :class:`Geometry`.

    Attributes:
        asked: the parameters that it was quantised with.
        parameters: those in world units, the same for all blocks.
        rows: the numbers in the scene of each block's splats, ascending.
        blocks: each block's geometry; its order is one of the block's splats.
    """

    asked: quantize.HyperParameters
    parameters: quantize.HyperParameters
    rows: tuple[NDArray[np.int64], ...]
    blocks: tuple[Geometry, ...]

    @cached_property
    def order(self) -> NDArray[np.int64]:
        """(N,) index in the scene of each splat of the file."""
        return np.concatenate([rows[block.order] for rows, block in zip(self.rows, self.blocks, strict=True)])

    def decoded(self, sh: FloatArray, run: Run = map) -> Scene:
        """See :meth:`Geometry.decoded`."""
        scene = undecoded(sh, self.blocks[0])
        for rows, block in zip(self.rows, self.blocks, strict=True):
            block.decode_to(scene, rows[block.order], run)
        return scene

    def colour_classes(self) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
        """See :meth:`Geometry.colour_classes`."""
        found = [block.colour_classes() for block in self.blocks]
        return np.concatenate([dc for dc, _ in found]), np.concatenate([ac for _, ac in found])

    def with_steps(self, effects: NDArray[np.floating]) -> GeometryOfBlocks:
        """See :meth:`Geometry.with_steps`."""
        own = [
            (block.scales, block.opacities, effects[rows[block.order]])
            for rows, block in zip(self.rows, self.blocks, strict=True)
        ]
        steps = fit_steps_of_blocks(own, self.parameters.sf_opacity)
        blocks = tuple(replace(block, steps=each) for block, each in zip(self.blocks, steps, strict=True))
        return replace(self, blocks=blocks)

    def with_colour_steps(self, parameters: quantize.HyperParameters) -> GeometryOfBlocks:
        """See :meth:`Geometry.with_colour_steps`."""
        blocks = tuple(block.with_colour_steps(parameters) for block in self.blocks)
        return replace(self, asked=parameters, parameters=blocks[0].parameters, blocks=blocks)


#: A scene's quantised geometry, as one piece or in blocks.
AnyGeometry: TypeAlias = Geometry | GeometryOfBlocks


def quantise(
    scene: Scene,
    parameters: quantize.HyperParameters,
    views: Sequence[Camera],
    run: Run = map,
    rows: Sequence[NDArray[np.int64]] | None = None,
) -> AnyGeometry:
    """Quantise a scene's geometry, in blocks if it has many splats.

    What a splat's values are rounded to does not depend on the blocks, but for its centre, which lies in the octree of
    its block.

    Args:
        scene, parameters, views, run: as of :func:`potr_cl.codec.geometry.quantise_geometry`.
        rows: of the blocks; None: as :func:`potr_cl.codec.blocks.blocks_of` has it, if there are more splats
            than a block may have.

    Raises:
        As :func:`potr_cl.codec.geometry.quantise_geometry`.
    """
    most = int(parameters.block_splats)
    if rows is None and len(scene) > (most or MOST_WHOLE):
        rows = blocks_of(scene.means, most or MOST_A_BLOCK, run)
    if rows is None:
        return quantise_geometry(scene, parameters, views, run)
    nearest = distances_to_views(scene.means, views, run)
    world = QUANTISERS[parameters.quantiser].in_world_units(parameters, scene, nearest, run)

    blocks = quantise_in_world_units(scene, rows, parameters, world, nearest, run)
    return GeometryOfBlocks(parameters, world, tuple(rows), tuple(blocks))
