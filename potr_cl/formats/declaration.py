"""What a format says of itself. Each module in scenes/ and cameras/ that reads one declares it as ``FORMAT``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene


class SceneLoader(Protocol):
    """Reads a scene file.

    Args:
        path: of the file.
        trust: whether it may hold more splats a byte than a real scene has. Without, memory and time are in proportion
            to the size of the file.

    Raises:
        UsageError: the file cannot be opened.
        DataError: it is damaged, or holds too many splats for its size.
    """

    def __call__(self, path: Path, /, trust: bool = False) -> Scene: ...


class SceneSaver(Protocol):
    """Writes a scene file, which appears under its name only when it is whole.

    Where a format's declaration lists ``versions``, it takes one of them as the keyword ``version`` too; and each of
    its ``choices``.

    Args:
        path: of the file.
        scene: of any SH degree; its arrays may have any strides.

    Raises:
        UsageError: the path cannot be written to.
        DataError: the format cannot hold the scene.
        PotrError: the system failed to write.
    """

    def __call__(self, path: Path, scene: Scene, /) -> None: ...


@dataclass(frozen=True)
class SceneFormat:
    """A format of scene files.

    Attributes:
        name: as people call it.
        suffixes: that its files have, in lower case, the usual one first. The last part of a suffix ("ply" of
            ".compressed.ply") picks the format of a file that is read, the longest that fits the one of a file that is
            written.
        note: one line for people, in Markdown: who uses it, which versions are read and written.
        load: reads a file.
        save: writes a scene to a path, or None where the format is only read.
        not_written: what a user should do instead, as a clause, where ``save`` is None.
        recognises: whether the content of a file is of this format; False for a file that cannot be read. For formats
            that share the last part of a suffix: it decides which of them reads a file, and one of them has none, to
            read what no other recognises.
        starts: what a file may begin with, if that tells the format: for scenes that come without a name. Of formats
            that begin alike one alone says so.
        gzipped: whether files of the format are gzip files themselves; ``starts`` is what they unpack to then.
        versions: that ``save`` can be asked for by its argument ``version``, the usual one first; none where there is
            only one way to write.
        choices: other keywords of ``save``; "source", the file that the scene was read from, is no user's to choose.
        names: of files that tell the format whatever their suffix, in lower case. A folder that holds such a file is
            read too, and ``load`` takes either, with ``#`` and a number behind if the format has levels of detail.
        files: all files of a scene, from a path that ``load`` takes too, without its level; None where a scene is the
            one file. Raises what ``load`` raises.
        packed: whether files are compressed, so that gzip hardly makes them smaller: then one that is gzipped may
            unpack to little more than it is.
    """

    name: str
    suffixes: tuple[str, ...]
    note: str
    load: SceneLoader
    save: SceneSaver | None = None
    not_written: str = ""
    recognises: Callable[[Path], bool] | None = None
    starts: tuple[bytes, ...] = ()
    gzipped: bool = False
    versions: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    files: Callable[[Path], list[Path]] | None = None
    packed: bool = False

    @property
    def extensions(self) -> tuple[str, ...]:
        """The last parts of the suffixes, with the point: ".ply" for ".compressed.ply"."""
        return tuple("." + suffix.rpartition(".")[2] for suffix in self.suffixes)


@dataclass(frozen=True)
class CameraFormat:
    """A format of camera files: of single ones, and of folders that hold them.

    Attributes:
        name: as people call it, with what tells it apart where that is of use: "COLMAP model (…)".
        suffixes: that its files have, in lower case.
        note: one line for people, in Markdown: who writes it, what is read of it.
        recognises: whether a file is of this format, from its path and, for a .json, the value that it holds (else
            None). Only asked about files with one of the suffixes.
        load: reads a file that ``recognises`` accepted, from the same arguments. Raises UsageError if a file cannot be
            opened, DataError if one is damaged.
        is_in: whether a folder holds files of this format under their usual names.
        load_folder: reads a folder that ``is_in`` accepted. Raises what ``load`` raises.
        json_mark: what in a .json makes it this format, for the message about one that is of none.
        subfolders: where else, below the folder that a user names, the files may be; looked into in this order.
    """

    name: str
    suffixes: tuple[str, ...]
    note: str
    recognises: Callable[[Path, Any], bool]
    load: Callable[[Path, Any], list[Camera]]
    is_in: Callable[[Path], bool]
    load_folder: Callable[[Path], list[Camera]]
    json_mark: str = ""
    subfolders: tuple[str, ...] = ()
