"""Levels of detail of a .potr file: files made one (:func:`joined_levels`), and the level that fits a budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from potr_cl.codec import container
from potr_cl.codec.container import Block, CodedSection
from potr_cl.codec.decoder import PotrFile
from potr_cl.errors import UsageError
from potr_cl.model.box import Box


def joined_levels(files: Sequence[PotrFile], errors: Sequence[float]) -> list[bytes]:
    """The pieces of one file of several levels of detail; nothing is coded anew.

    A level of a single block gets a box around those of the level below: it may be shown in their place.

    Args:
        files: the finest first; each of one level, all of one SH degree, quantiser and way to be rendered.
        errors: by how far, world units, the splats of each level may be off those of the finest one.
    """
    blocks: list[tuple[Block, Sequence[CodedSection]]] = []
    below: list[Box] = []
    for level, (file, error) in enumerate(zip(files, errors, strict=True)):
        own = [replace(block, level=level, error=error) for block in file.blocks]
        if len(own) == 1 and below:
            own = [replace(own[0], box=_around([own[0].box, *below]))]
        below = [block.box for block in own]
        # The coarsest comes first in a file.
        blocks[:0] = [(block, _sections(file, number)) for number, block in enumerate(own)]
    finest = files[0]
    start, sections = finest.header.start, finest.header.sections
    own_sections = [(each, bytes(finest.read(start + each.offset, each.stored_bytes))) for each in sections]
    return container.assemble(blocks, own_sections)


def _sections(file: PotrFile, number: int) -> list[CodedSection]:
    block = file.blocks[number]
    data = file.read(block.offset, block.nbytes)
    return [(each, bytes(container.stored_bytes(data, each))) for each in block.sections]


def _around(boxes: Sequence[Box]) -> Box:
    low, high = np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0)
    return Box.of([*low, *high])


def splats_of_levels(file: PotrFile) -> list[int]:
    """How many splats each level has, the finest first."""
    return [sum(file.blocks[k].splats for k in file.header.of_level(level)) for level in range(file.levels)]


def level_within(file: PotrFile, splats: int) -> int:
    """The finest level of no more than so many splats.

    Raises:
        UsageError: even the coarsest has more.
    """
    counts = splats_of_levels(file)
    for level, count in enumerate(counts):
        if count <= splats:
            return level
    raise UsageError(f"no level has {splats:,} splats or fewer: the coarsest has {min(counts):,}")
