"""A ladder (:class:`Ladder`): one scene at several qualities, .potr files in a folder, with a ladder.json beside them.

The JSON says of each file with which q it was made, how large it is, and what it lost, so that a user sees the whole
curve before any file is read::

    {"kind": "potr_cl ladder", "version": 1,
     "scene": "plush.ply", "scene_bytes": 76819000, "judged_by": "39 held-out test views",
     "rungs": [{"q": 0.25, "file": "plush_q0.25.potr", "bytes": 1031872, "splats": 66012, "psnr": 39.1, "ssim": 0.98}]}

A PSNR of null means that nothing was judged, or that all pictures are identical (then SSIM is 1).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.cameras.view_files import excerpt, number
from potr_cl.formats.scenes.scene_files import file_in_folder, opened, related
from potr_cl.host.atomic_write import replacing
from potr_cl.plain_text import plain

#: The file that describes a ladder.
DESCRIPTION = "ladder.json"
_KIND, _VERSION = "potr_cl ladder", 1
#: A description of some thousand rungs; and how many there may be.
_MOST_BYTES, _MOST_RUNGS = 1 << 20, 1000


@dataclass(frozen=True)
class Rung:
    """One file of a ladder.

    Attributes:
        q: the quality that it was encoded with, 0 to 1.
        file: its name, relative to the description.
        bytes: of the file.
        splats: in it.
        psnr: mean of the judging views against the uncompressed scene, decibels; None if it was not judged or is
            identical.
        ssim: likewise; None if it was not judged.
    """

    q: float
    file: str
    bytes: int
    splats: int
    psnr: float | None = None
    ssim: float | None = None


@dataclass(frozen=True)
class Ladder:
    """A scene at several qualities.

    Attributes:
        path: of the description.
        scene: the name of the uncompressed scene's file.
        scene_bytes: of that file; None if it came from none.
        judged_by: which views the figures are means of; empty if there are none.
        rungs: by rising q; at least one.
    """

    path: Path
    scene: str
    scene_bytes: int | None
    judged_by: str
    rungs: tuple[Rung, ...]

    def file(self, rung: Rung) -> Path:
        """The path of a rung's file, in the ladder's folder or below.

        Raises:
            DataError: the name leads out of the folder.
        """
        return related(self.path, rung.file)

    def document(self) -> dict[str, Any]:
        """What the description holds, ready for JSON."""
        return {
            "kind": _KIND,
            "version": _VERSION,
            "scene": self.scene,
            "scene_bytes": self.scene_bytes,
            "judged_by": self.judged_by,
            "rungs": [asdict(rung) for rung in self.rungs],
        }

    def encoded(self) -> bytes:
        """The content of the description's file."""
        # In ASCII, as names of files need not be UTF-8.
        return (json.dumps(self.document(), indent=1) + "\n").encode()

    def save(self) -> None:
        """Write the description; it appears only when it is whole. Raises UsageError if it cannot be written there."""
        with replacing(self.path) as file:
            file.write(self.encoded())


def ladder_at(path: str | os.PathLike[str]) -> Path | None:
    """The description of the ladder that a path means: its own file, any other .json file, or one in a folder.

    None where it means no ladder.
    """
    found = file_in_folder(path, DESCRIPTION)
    if found is not None:
        return found
    given = Path(path)
    return given if given.suffix.lower() == ".json" and _begins_like_one(given) else None


def read_ladder(path: Path) -> Ladder:
    """Read a ladder's description; its files are not looked at.

    Raises:
        UsageError: it cannot be opened.
        DataError: it is damaged, or of a later version.
    """
    with opened(path) as (file, size):
        if size > _MOST_BYTES:
            raise DataError(f"'{path}' is too large for a ladder: {size} bytes, at most {_MOST_BYTES} are read")
        try:
            content = json.loads(file.read())
        except (ValueError, RecursionError) as error:
            raise DataError(f"'{path}' is not valid JSON: {error}") from error
    if not isinstance(content, dict) or content.get("kind") != _KIND:
        raise DataError(f'\'{path}\' describes no ladder: its "kind" is not "{_KIND}"')
    if content.get("version") != _VERSION:
        raise DataError(f"'{path}' is a ladder of version {excerpt(content.get('version'))}, {_VERSION} is read")
    rungs = content.get("rungs")
    if not isinstance(rungs, list) or not 1 <= len(rungs) <= _MOST_RUNGS:
        raise DataError(f"'{path}': \"rungs\" is no list of 1 to {_MOST_RUNGS} files")
    read = sorted((_rung(path, place, rung) for place, rung in enumerate(rungs)), key=lambda rung: rung.q)
    nbytes = content.get("scene_bytes")
    return Ladder(
        path,
        plain(content.get("scene", "")),
        None if nbytes is None else _count(nbytes, f"'{path}': \"scene_bytes\""),
        plain(content.get("judged_by", "")),
        tuple(read),
    )


def qualities(given: str | Sequence[float]) -> tuple[float, ...]:
    """The qualities of a ladder, rising: a list of numbers, also as text, "0.1,0.3,0.5".

    Raises:
        UsageError: there is none, one is out of range or comes twice, or there are too many.
    """
    try:
        parts = given.split(",") if isinstance(given, str) else given
        values = sorted(float(part) for part in parts)
    except (TypeError, ValueError):
        raise UsageError(f"--ladder is '{plain(given)}', it must be qualities such as 0.1,0.3,0.5") from None
    if not 1 <= len(values) <= _MOST_RUNGS:
        raise UsageError(f"--ladder names {len(values)} qualities, it must name 1 to {_MOST_RUNGS}")
    if not all(0 <= value <= 1 for value in values):
        raise UsageError("--ladder holds a quality that does not lie between 0 and 1")
    if len(set(values)) < len(values):
        raise UsageError("--ladder names a quality twice")
    return tuple(values)


def _rung(path: Path, place: int, rung: Any) -> Rung:
    where = f"'{path}': rung {place}"
    if not isinstance(rung, dict) or not isinstance(rung.get("file"), str):
        raise DataError(f"{where} names no file")
    related(path, rung["file"])  # a name that leads out of the folder is refused before anything is shown
    q = number(rung.get("q"), f'{where}, "q"')
    if not 0 <= q <= 1:
        raise DataError(f'{where}, "q" is {q:g}, not between 0 and 1')
    psnr, ssim = (
        None if rung.get(name) is None else number(rung[name], f'{where}, "{name}"') for name in ("psnr", "ssim")
    )
    nbytes, splats = (_count(rung.get(name), f'{where}, "{name}"') for name in ("bytes", "splats"))
    return Rung(q, rung["file"], nbytes, splats, psnr, ssim)


def _count(value: Any, where: str) -> int:
    count = number(value, where)
    if count != int(count) or not 0 <= count < 1 << 62:
        raise DataError(f"{where} is {excerpt(value)}, not a whole number of them")
    return int(count)


def _begins_like_one(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return _KIND.encode() in file.read(4096)
    except (OSError, ValueError):
        return False
