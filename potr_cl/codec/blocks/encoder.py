"""From a scene in blocks to the bytes of a file of them: :func:`code_blocks`.

The bytes do not depend on the number of threads, nor on how many blocks are coded side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree
from potr_cl.codec.blocks.geometry import GeometryOfBlocks
from potr_cl.codec.blocks.table import BlockTable, assemble
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import Coded, code_scene
from potr_cl.codec.geometry import Geometry
from potr_cl.model.box import Box
from potr_cl.model.scene import Scene

#: Threads that a block keeps busy: with more of them, further blocks are coded beside it, up to so many.
_THREADS_A_BLOCK, _SIDE_BY_SIDE = 4, 4


def code_blocks(
    scene: Scene,
    geometry: GeometryOfBlocks,
    metadata: bytes = b"",
    entropy: EntropyCoder | None = None,
    threads: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> Coded:
    """Code a scene block by block.

    Args:
        scene: whose colours are coded.
        geometry: of the scene.
        metadata: JSON, how the file was made.
        entropy: the entropy stage.
        threads: 0: one a processor.
        progress: told how far each stage is.

    Raises:
        As :func:`potr_cl.codec.encoder.code_scene`.
    """
    threads = threads or os.cpu_count() or 1
    side_by_side = max(min(threads // _THREADS_A_BLOCK, _SIDE_BY_SIDE, len(geometry.blocks)), 1)
    report = _Progress(progress, len(geometry.blocks))

    def code(rows: NDArray[np.int64], block: Geometry) -> tuple[Box, int, list[bytes]]:
        own = scene.subset(rows)
        coded = code_scene(own, geometry.asked, (), b"", entropy, -(-threads // side_by_side), None, block)
        report.one_more()
        return _box(block), len(rows), coded.pieces

    report.tell(0)
    with ThreadPoolExecutor(side_by_side) as pool:
        blocks = _in_order(pool, list(zip(geometry.rows, geometry.blocks, strict=True)), code)
    table = BlockTable(len(scene), scene.sh_degree, scene.antialiased, scene.low_pass, metadata)
    return Coded(assemble(table, blocks), geometry.order)


def _in_order(
    pool: ThreadPoolExecutor,
    work: list[tuple[NDArray[np.int64], Geometry]],
    code: Callable[[NDArray[np.int64], Geometry], tuple[Box, int, list[bytes]]],
) -> list[tuple[Box, int, list[bytes]]]:
    futures: list[Future[tuple[Box, int, list[bytes]]]] = [pool.submit(code, *each) for each in work]
    try:
        return [future.result() for future in futures]
    finally:
        # After an error nothing that has not begun should begin.
        for future in futures:
            future.cancel()


def _box(block: Geometry) -> Box:
    """Around the centres as they are decoded."""
    means = octree.parse(block.tree, len(block.order))
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
            self._tell("quantise and code", part)
