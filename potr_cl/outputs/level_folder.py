"""Outputs that are folders of levels of detail, cut by a k-d tree: what they have in common (:class:`LevelFolder`)."""

from __future__ import annotations

import io
import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, ClassVar

from potr_cl.errors import UsageError
from potr_cl.host.atomic_write import write_files
from potr_cl.model.scene import Scene
from potr_cl.outputs.lod_tree import Limits
from potr_cl.outputs.output import Output

#: What splats of "K" are counted in, and of a node to be split for its extent.
_K, _FEWEST = 1024, 8


@dataclass(frozen=True)
class LevelFolder(Output):
    """A folder, which the name of its description asks for; its options are called as splat-transform's.

    As long as it is in memory, its one piece is an archive (:func:`archive`).

    Attributes:
        lod_chunk_count: the most splats of a leaf of the tree, all levels together; in 1024.
        lod_chunk_extent: the largest side of a leaf, world units.

    Raises:
        UsageError: one is not above 0.
    """

    levels: ClassVar[int | str | None] = "auto"

    lod_chunk_count: int = 512
    lod_chunk_extent: float = 16.0

    def __post_init__(self) -> None:
        for name in ("lod_chunk_count", "lod_chunk_extent"):
            if not getattr(self, name) > 0:
                raise UsageError(f"--{name.replace('_', '-')} is {getattr(self, name):g}, it must be above 0")

    @property
    def limits(self) -> Limits:
        """Of the tree's leaves."""
        count = self.lod_chunk_count * _K
        return Limits(count, self.lod_chunk_extent, min(_FEWEST * _K, count))

    @classmethod
    def suffixes(cls) -> tuple[str, ...]:
        """The name of the description: it alone tells the format."""
        return cls.format.names

    def write(self, pieces: Sequence[bytes], file: BinaryIO, path: Path) -> None:
        """The files of the folder; the description last.

        Raises:
            WriteError: one cannot be written; those of an earlier scene are there still.
        """
        contents = _contents(b"".join(pieces))
        description = contents.pop(self.suffix)
        write_files(path.parent, contents)
        file.write(description)

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The finest level."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / self.suffix
            with path.open("wb") as file:
                self.write([data], file, path)
            return self.format.load(self.finest(path), trust)

    def finest(self, path: Path) -> Path:
        """What the finest level of a folder is called."""
        return path

    def place(self, path: str | os.PathLike[str]) -> Path:
        """The description; its own folder is made, but none around that."""
        _make(Path(path).parent)
        return Path(path)

    def size(self, pieces: Sequence[bytes]) -> int:
        """Bytes of all files."""
        return sum(map(len, _contents(b"".join(pieces)).values()))


def archive(files: dict[str, bytes]) -> bytes:
    """A folder's files as one piece."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as found:
        for name, content in files.items():
            found.writestr(zipfile.ZipInfo(name), content)
    return buffer.getvalue()


def _contents(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        return {name: found.read(name) for name in found.namelist()}


def _make(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{folder}': {error.strerror}") from None
