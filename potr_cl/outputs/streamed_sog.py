"""Streamed SOG as an output: a folder with lod-meta.json, levels of detail in chunks that viewers fetch as needed.

Version 1 of PlayCanvas' specification. Each level is encoded to a .sog file, as any scene is; then its splats are put
in the order of the leaves of a k-d tree, and cut into chunks.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import sog_levels
from potr_cl.formats.scenes.sog_images import DESCRIPTION as SOG_DESCRIPTION
from potr_cl.formats.scenes.sog_levels import DESCRIPTION
from potr_cl.host.atomic_write import replacing
from potr_cl.model.scene import Scene, joined
from potr_cl.outputs.lod_tree import Limits, Node, lod_tree
from potr_cl.outputs.output import LevelErrors, Output
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.sog_chunks import SogChunks

#: What chunks of "K" splats are counted in.
_K = 1024
#: Of a node to be split for its extent, in K.
_FEWEST = 8
#: The folder of what viewers always show.
_ENVIRONMENT = "env"
#: Digits of an error.
_DIGITS = 7


@dataclass(frozen=True)
class StreamedSog(Sog):
    """A folder of levels of detail; its options are called as splat-transform's.

    Attributes:
        lod_chunk_count: the most splats of a leaf of the tree, all levels together, and about those of a chunk; in
            1024.
        lod_chunk_extent: the largest side of a leaf, world units.

    Raises:
        UsageError: one is not above 0.
    """

    format: ClassVar[SceneFormat] = sog_levels.FORMAT
    levels: ClassVar[int | str | None] = "auto"

    lod_chunk_count: int = 512
    lod_chunk_extent: float = 16.0

    def __post_init__(self) -> None:
        for name in ("lod_chunk_count", "lod_chunk_extent"):
            if not getattr(self, name) > 0:
                raise UsageError(f"--{name.replace('_', '-')} is {getattr(self, name):g}, it must be above 0")

    @classmethod
    def suffixes(cls) -> tuple[str, ...]:
        """The name of the description: it alone tells the format."""
        return cls.format.names

    def of_level(self) -> Output:
        """A .sog file."""
        return Sog()

    def levelled(self, files: Sequence[bytes], errors: LevelErrors) -> list[bytes]:
        """An archive of the folder."""
        read = cache(lambda level: self.of_level().read(files[level], trust=True))
        count = self.lod_chunk_count * _K
        limits = Limits(count, self.lod_chunk_extent, min(_FEWEST * _K, count))
        scenes: list[Scene] = [read(level) for level in range(len(files))]
        far = [errors.far(scene) for scene in scenes]
        near = [~each if far[0].any() else np.ones(len(each), bool) for each in far]
        sky = np.flatnonzero(~near[0])
        tree = lod_tree(scenes, limits, near)
        leaves = list(tree.leaves())

        def shown(level: int) -> Scene:
            if not level or not len(sky):
                return scenes[level]
            return joined([scenes[level].subset(np.flatnonzero(near[level])), scenes[0].subset(sky)])

        lost = errors.of_leaves(shown, len(files), _numbers(leaves, len(scenes[0])), _boxes(leaves))
        folder: dict[str, bytes] = {}
        filenames: list[str] = []
        places: list[dict[str, dict[str, int]]] = [{} for _ in leaves]
        for level, data in enumerate(files):
            chunks = SogChunks(data)
            for number, chunk in enumerate(_in_chunks([leaf.rows[level] for leaf in leaves], count)):
                name, offset = f"{level}_{number}", 0
                for leaf in chunk:
                    rows = leaves[leaf].rows[level]
                    places[leaf][str(level)] = {"file": len(filenames), "offset": offset, "count": len(rows)}
                    offset += len(rows)
                own = chunks.folder(np.concatenate([leaves[leaf].rows[level] for leaf in chunk]))
                folder |= {f"{name}/{file}": content for file, content in own.items()}
                filenames.append(f"{name}/{SOG_DESCRIPTION}")
            if len(sky) and not level:
                folder |= {f"{_ENVIRONMENT}/{file}": content for file, content in chunks.folder(sky).items()}
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
        return [_archive(folder | {DESCRIPTION: json.dumps(meta, separators=(",", ":")).encode()})]

    def write(self, pieces: Sequence[bytes], file: BinaryIO, path: Path) -> None:
        """The files of the folder; the description last.

        Raises:
            UsageError: one cannot be written.
        """
        contents = _contents(b"".join(pieces))
        description = contents.pop(DESCRIPTION)
        for name, content in contents.items():
            beside = path.parent / name
            _make(beside.parent)
            with replacing(beside) as target:
                target.write(content)
        file.write(description)

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The finest level."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / DESCRIPTION
            with path.open("wb") as file:
                self.write([data], file, path)
            return self.format.load(f"{path}#0", trust)  # type: ignore[arg-type]

    def place(self, path: str | os.PathLike[str]) -> Path:
        """The description; its own folder is made, but none around that."""
        _make(Path(path).parent)
        return Path(path)

    def size(self, pieces: Sequence[bytes]) -> int:
        """Bytes of all files."""
        return sum(map(len, _contents(b"".join(pieces)).values()))


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


def _make(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{folder}': {error.strerror}") from None


def _archive(files: dict[str, bytes]) -> bytes:
    """The folder as one piece, as long as it is in memory."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


def _contents(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}
