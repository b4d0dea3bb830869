"""3D Tiles 1.1 as an output: a folder with tileset.json, levels of detail in tiles of glTF that CesiumJS streams.

Each level is encoded to a .glb file, as any scene is. Each leaf of a k-d tree is a chain of tiles, the coarsest level
first, each of which the next one replaces.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf_file, spz, tileset
from potr_cl.model.scene import Scene
from potr_cl.outputs.level_folder import LevelFolder, archive
from potr_cl.outputs.lod_tree import Node, lod_tree
from potr_cl.outputs.output import LevelErrors, Output
from potr_cl.outputs.spz import Gltf

#: Pixels that the error of a tile may have on screen before it is replaced: CesiumJS' default. So a tile is replaced
#: once a pixel of the pictures that its level was made for is as large as one on screen.
_PIXELS = 16
_EXTENSIONS = [gltf_file.EXTENSION, gltf_file.SPZ_EXTENSION]


@dataclass(frozen=True)
class Tiles(LevelFolder, Gltf):
    """A folder of tiles.

    Attributes:
        lod_chunk_count, lod_chunk_extent: as of :class:`potr_cl.outputs.level_folder.LevelFolder`.
        version: as of :class:`potr_cl.outputs.spz.Gltf`.
    """

    format: ClassVar[SceneFormat] = tileset.FORMAT

    lod_chunk_count: int = 128

    def __post_init__(self) -> None:
        LevelFolder.__post_init__(self)
        Gltf.__post_init__(self)

    def of_level(self) -> Output:
        """A .glb file."""
        return Gltf(version=self.version)

    def levelled(self, files: Sequence[bytes], errors: LevelErrors, read: Callable[[int], Scene]) -> list[bytes]:
        """An archive of the folder."""
        scenes = [read(level) for level in range(len(files))]
        packed = [gltf_file.spz_in(data) for data in files]
        lost = np.maximum.accumulate([_PIXELS * errors.of_level(level) for level in range(len(files))]).tolist()
        tree = lod_tree(scenes, self.limits)
        folder: dict[str, bytes] = {}
        numbers = iter(range(len(files) * len(list(tree.leaves()))))

        def of_leaf(leaf: Node) -> dict[str, Any]:
            """The finest tile in the next coarser one, and so on."""
            tile: dict[str, Any] = {}
            number = next(numbers)
            for level, rows in enumerate(leaf.rows):
                if not len(rows):
                    continue
                name = f"{level}/{number}.glb"
                tile_file = gltf_file.binary(scenes[level].subset(rows), spz.part(packed[level], rows))
                folder[name] = b"".join(tile_file)
                children = {"children": [tile]} if tile else {}
                tile = {**_tile(leaf, lost[level] if tile else 0.0), "content": {"uri": name}, **children}
            return tile

        def of_node(node: Node) -> dict[str, Any]:
            if not node.children:
                return of_leaf(node)
            # It has nothing to show, so it is gone through unless it is less than a pixel.
            error = max(_PIXELS * float(np.linalg.norm(node.high - node.low)), lost[-1])
            return {**_tile(node, error), "children": [of_node(child) for child in node.children]}

        root = {**of_node(tree), "refine": "REPLACE"}
        extensions = {"extensionsUsed": _EXTENSIONS, "extensionsRequired": _EXTENSIONS}
        description = {
            "asset": {"version": "1.1", "generator": "potr_cl"},
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": extensions},
            "geometricError": max(root["geometricError"], _PIXELS * float(np.linalg.norm(tree.high - tree.low))),
            "root": root,
        }
        folder[tileset.DESCRIPTION] = json.dumps(description, separators=(",", ":")).encode()
        return [archive(folder)]


def _tile(node: Node, error: float) -> dict[str, Any]:
    """A tile around a node; z is up in tiles where y is in glTF."""
    middle, half = (node.low + node.high) / 2, (node.high - node.low) / 2
    x, y, z = half.tolist()
    box = [middle[0], -middle[2], middle[1], x, 0.0, 0.0, 0.0, z, 0.0, 0.0, 0.0, y]
    return {"boundingVolume": {"box": [float(value) for value in box]}, "geometricError": float(error)}
