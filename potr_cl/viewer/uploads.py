"""A scene file that is dropped on the page (:class:`Upload`): kept in a temporary file, and read like any other.

Nothing is believed: neither the name, of which only the suffix is used, nor the size, which is checked while the bytes
come. The readers refuse what a file should not hold (docs/security.md).
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from potr_cl.errors import DataError, UsageError
from potr_cl.formats import load_scene, registry
from potr_cl.formats.streams import called
from potr_cl.host.leftovers import temporary_folder
from potr_cl.plain_text import LONGEST_VALUE, plain
from potr_cl.viewer.session import Exhibit

#: Bytes that a dropped file may have: some 8 million splats of SH degree 3 as a PLY.
MOST_BYTES = 2 << 30


class Upload:
    """One file on its way. Used with ``with``; its temporary file is gone afterwards.

    Args:
        name: as the browser gives it.
        size: likewise, in bytes.

    Raises:
        UsageError: it is too large, or no format that is read from one file has its suffix.
    """

    def __init__(self, name: object, size: object) -> None:
        self.name = plain(name if isinstance(name, str) and name else "a file without a name", LONGEST_VALUE)
        if not isinstance(size, int) or isinstance(size, bool) or size < 0:
            raise UsageError(f"'{self.name}': the browser does not say how large it is")
        if size > MOST_BYTES:
            raise UsageError(
                f"'{self.name}' has {size / 1e9:.1f} GB, the page takes {MOST_BYTES / 1e9:.1f} GB: name the file on "
                "the command line instead"
            )
        self._suffix = _suffix_of(name if isinstance(name, str) else "")
        self.size, self.received = size, 0
        self._stack = ExitStack()
        self._file: BinaryIO | None = None
        self._path = Path()

    def __enter__(self) -> Upload:
        self._path = Path(self._stack.enter_context(temporary_folder()), f"scene{self._suffix}")
        self._file = self._stack.enter_context(self._path.open("xb"))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def is_complete(self) -> bool:
        return self.received == self.size

    def take(self, part: bytes) -> None:
        """Keep the next bytes.

        Raises:
            DataError: there are more than were announced.
            UsageError: there is no room for them.
        """
        assert self._file is not None
        self.received += len(part)
        if self.received > self.size:
            raise DataError(f"'{self.name}' brings more bytes than it should: drop it again")
        try:
            self._file.write(part)
        except OSError as error:
            raise UsageError(f"cannot keep '{self.name}': {error.strerror or error}: make room for it") from error

    def read(self, antialiased: bool | None = None) -> Exhibit:
        """The scene that the whole file holds.

        Raises:
            As :func:`potr_cl.formats.load_scene`.
        """
        assert self._file is not None
        self._file.close()
        with called(f"'{self._path}'", f"'{self.name}'"):
            return Exhibit(load_scene(self._path, antialiased=antialiased), self.name, self.size)


def _suffix_of(name: str) -> str:
    """The suffixes of a file name that tell its format.

    Raises:
        UsageError: they tell none.
    """
    lower = PurePosixPath(name.replace("\\", "/")).name.lower()
    known = sorted({s for entry in registry.SCENE_FORMATS for s in entry.suffixes}, key=len, reverse=True)
    for suffix in [*(f"{s}.gz" for s in known), *known]:
        if lower.endswith(suffix):
            return suffix
    raise UsageError(
        f"'{plain(name, LONGEST_VALUE)}' is no scene that is known by its name: drop {registry.suffixes_read()}"
    )
