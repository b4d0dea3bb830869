"""Streamed SOG as an output: a folder with lod-meta.json, levels of detail in chunks that viewers fetch as needed.

Version 1 of PlayCanvas' specification. Each level is encoded to a .sog file, as any scene is; then its splats are put
in the order of the leaves of a k-d tree, and cut into chunks.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import sog_levels
from potr_cl.formats.scenes.sog_images import DESCRIPTION as SOG_DESCRIPTION
from potr_cl.formats.scenes.sog_levels import DESCRIPTION
from potr_cl.host.threads import Ahead, in_background
from potr_cl.model.scene import Scene, joined
from potr_cl.outputs.level_folder import LevelFolder, archive
from potr_cl.outputs.lod_tree import Node, lod_tree
from potr_cl.outputs.output import Leaves, LevelErrors, Output
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.sog_chunks import SogChunks

#: The folder of what viewers always show.
_ENVIRONMENT = "env"
#: Threads that pack chunks.
_PACKING = 16
#: Digits of an error.
_DIGITS = 7


@dataclass(frozen=True)
class StreamedSog(LevelFolder, Sog):
    """A folder of levels of detail.

    Attributes:
        lod_chunk_count, lod_chunk_extent: as of :class:`potr_cl.outputs.level_folder.LevelFolder`; the first is also
            about what a chunk has.
    """

    format: ClassVar[SceneFormat] = sog_levels.FORMAT

    def of_level(self) -> Output:
        """A .sog file."""
        return Sog()

    def levelled(self, files: Sequence[bytes], errors: LevelErrors, read: Callable[[int], Scene]) -> list[bytes]:
        """An archive of the folder."""
        limits, count = self.limits, self.limits.splats
        scenes = [read(level) for level in range(len(files))]
        far = [errors.far(scene) for scene in scenes]
        near = [~each if far[0].any() else np.ones(len(each), bool) for each in far]
        sky = np.flatnonzero(~near[0])

        def cut() -> tuple[Node, list[Node], Leaves]:
            tree = lod_tree(scenes, limits, near)
            leaves = list(tree.leaves())
            return tree, leaves, Leaves(_numbers(leaves, len(scenes[0])), _boxes(leaves))

        def shown(level: int) -> Scene:
            if not level or not len(sky):
                return scenes[level]
            return joined([scenes[level].subset(np.flatnonzero(near[level])), scenes[0].subset(sky)])

        coming = in_background(cut)
        lost = errors.of_leaves(shown, len(files), lambda: coming.result()[2])
        tree, leaves, _ = coming.result()
        filenames: list[str] = []
        places: list[dict[str, dict[str, int]]] = [{} for _ in leaves]

        def parts() -> Iterator[tuple[str, SogChunks, NDArray[np.int64]]]:
            """The name, the level and the splats of each folder in the folder."""
            for level, data in enumerate(files):
                chunks = SogChunks(data)
                for number, chunk in enumerate(_in_chunks([leaf.rows[level] for leaf in leaves], count)):
                    name, offset = f"{level}_{number}", 0
                    for leaf in chunk:
                        rows = leaves[leaf].rows[level]
                        places[leaf][str(level)] = {"file": len(filenames), "offset": offset, "count": len(rows)}
                        offset += len(rows)
                    filenames.append(f"{name}/{SOG_DESCRIPTION}")
                    yield name, chunks, np.concatenate([leaves[leaf].rows[level] for leaf in chunk])
                if len(sky) and not level:
                    yield _ENVIRONMENT, chunks, sky

        def packed(part: tuple[str, SogChunks, NDArray[np.int64]]) -> dict[str, bytes]:
            name, chunks, rows = part
            return {f"{name}/{file}": content for file, content in chunks.folder(rows).items()}

        with Ahead(packed, parts(), min(os.cpu_count() or 1, _PACKING)) as made:
            folder = dict(chain.from_iterable(own.items() for _, own in made))
        told = iter(zip(places, lost.tolist(), strict=True))

        def of_leaf(_: Node) -> dict[str, Any]:
            lods, own = next(told)
            return {"lods": lods, "errors": [float(f"{error:.{_DIGITS}g}") for error in own]}

        counts = [int(np.count_nonzero(each)) for each in near]
        asset = {"generator": "potr_cl", "chunkGaussians": count, "chunkExtent": self.lod_chunk_extent}
        meta = {
            "version": 1,
            "asset": asset | {"chunkMinGaussians": limits.fewest},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(files),
            "lodErrors": True,
            **({"environment": f"{_ENVIRONMENT}/{SOG_DESCRIPTION}"} if len(sky) else {}),
            "filenames": filenames,
            "tree": tree.document(of_leaf),
        }
        return [archive(folder | {DESCRIPTION: json.dumps(meta, separators=(",", ":")).encode()})]

    def finest(self, path: Path) -> Path:
        """With the level's number: without, people are told that there are others."""
        return Path(f"{path}#0")


def _numbers(leaves: Sequence[Node], splats: int) -> NDArray[np.int64]:
    """(N,) in which leaf each splat of the finest level is; as many as there are leaves: in the environment."""
    found = np.full(splats, len(leaves), np.int64)
    for number, leaf in enumerate(leaves):
        found[leaf.rows[0]] = number
    return found


def _boxes(leaves: Sequence[Node]) -> NDArray[np.float64]:
    """(leaves, 6) corners of the leaves' boxes."""
    return np.array([[*leaf.low, *leaf.high] for leaf in leaves])


def _in_chunks(rows: Sequence[NDArray[np.int64]], most: int) -> list[list[int]]:
    """The numbers of the leaves of each chunk: leaves that have splats, until a chunk has so many."""
    chunks: list[list[int]] = []
    held = most
    for leaf, own in enumerate(rows):
        if not len(own):
            continue
        if held >= most:
            chunks.append([])
            held = 0
        chunks[-1].append(leaf)
        held += len(own)
    return chunks
