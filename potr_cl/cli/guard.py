"""No command writes over what it reads, and no output over another (:func:`check`).

A command says of each path among its arguments what becomes of it, by the argument's type: :class:`ReadFile`,
:class:`ReadCameras`, :class:`ReadPhotographs`, :class:`WrittenFile` or :class:`WrittenFolder`; standard input and
output are nobody's files. :func:`check` runs before every command and takes no path of which that is not said. Files
are compared by what they are, not by their names: symbolic and hard links and names in other letters are seen through.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from potr_cl.errors import UsageError

if TYPE_CHECKING:
    from potr_cl.model.camera import Camera

    _SystemPath = Path
else:
    _SystemPath = type(Path())  # before Python 3.12 Path itself cannot be derived from

#: What a file is, or where a new one will be.
_Identity = tuple[Any, ...]


class ReadFile(_SystemPath):
    """A file that the command reads."""


class StandardInput(_SystemPath):
    """Standard input, given as "-"; a file of that name is given by its folder too.

    Attributes:
        source: makes the file that keeps what standard input brings, while a command runs.
        until: closes it.
    """

    source: Callable[[], AbstractContextManager[Path]]
    until: ExitStack
    _file: Path | None = None

    @contextmanager
    def as_file(self) -> Iterator[Path]:
        """The file that has what standard input brought; it is read once, when this is first called."""
        if self._file is None:
            self._file = self.until.enter_context(self.source())
        yield self._file


class StandardOutput(_SystemPath):
    """Standard output, given as "-".

    Attributes:
        stream: takes the result, while a command runs.
    """

    stream: BinaryIO


class ReadCameras(_SystemPath):
    """A file of cameras that the command reads, with those of its folder; or a folder that holds them."""


class CamerasBeside(_SystemPath):
    """Whatever cameras lie beside the scene, given as "beside"; a file of that name is given by its folder too."""


class ReadPhotographs(_SystemPath):
    """A folder with images that the command reads."""


class WrittenFile(_SystemPath):
    """A file that the command writes."""


class WrittenFolder(_SystemPath):
    """A folder that the command makes; its files are checked by :func:`check_files` once their names are known."""


_READ = (ReadFile, ReadCameras, ReadPhotographs)
_WRITTEN = (WrittenFile, WrittenFolder)
#: What names no file.
_WORDS = (StandardInput, StandardOutput, CamerasBeside)


def read_file(text: str) -> Path:
    """A type of arguments: a file that the command reads, or standard input."""
    return StandardInput(text) if text == "-" else ReadFile(named(text))


def named(text: str) -> str:
    """A path as it was given; that of a file "-", "./-", so that nobody takes it for standard input or output."""
    return os.path.abspath(text) if os.path.normpath(text) == "-" else text


def check(args: argparse.Namespace) -> None:
    """Refuse arguments by which a file would be read and written, or written twice.

    Raises:
        UsageError: they are of this kind; or "-" is given where neither standard input nor output is taken.
        TypeError: a path of which nobody has said whether it is read or written: a mistake in the program.
    """
    for name, value in vars(args).items():
        for path in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(path, Path) and not isinstance(path, (*_READ, *_WRITTEN, *_WORDS)):
                raise TypeError(f"argument '{name}' is a path: give it one of the types of {__name__}")
            if isinstance(path, (*_READ, *_WRITTEN)) and os.fspath(path) == "-":
                stream = "output" if isinstance(path, _WRITTEN) else "input"
                raise UsageError(f"'-' is standard {stream}, which this argument does not take: give it a name")
    _refuse(_given(args, (WrittenFile,)), _given(args, _READ))


def check_files(args: argparse.Namespace, files: Sequence[Path]) -> None:
    """The same for files of a folder that is written.

    Raises:
        UsageError: one of them is read, or is another output.
    """
    _refuse([*_given(args, (WrittenFile,)), *files], _given(args, _READ))


def check_photographs(args: argparse.Namespace, cameras: Iterable[Camera], files: Sequence[Path] = ()) -> None:
    """Refuse outputs that are photographs of the views, whether or not the command reads them.

    Args:
        files: of a folder that is written, which are written besides the outputs that ``args`` names.

    Raises:
        UsageError: an output is one.
    """
    _refuse(
        [*_given(args, (WrittenFile,)), *files],
        [ReadFile(camera.image_path) for camera in cameras if camera.image_path is not None],
    )


def _given(args: argparse.Namespace, kinds: tuple[type[Path], ...]) -> list[Path]:
    values = (value if isinstance(value, (list, tuple)) else [value] for value in vars(args).values())
    return [path for several in values for path in several if isinstance(path, kinds)]


def _refuse(written: Sequence[Path], read: Sequence[Path]) -> None:
    outputs: dict[_Identity, Path] = {}
    for path in written:
        one = _identity(path)
        if one in outputs:
            raise UsageError(f"two outputs name the same file, '{outputs[one]}' and '{path}': give one another name")
        outputs[one] = path
    # A name may lead through a folder that is not there ("new/../scene.ply"): files are written where it points to.
    if not any(os.path.lexists(os.path.realpath(path)) for path in written):
        return  # new files are nobody's input: folders need not be listed
    for source in read:
        for name in _files(source):
            output = outputs.get(_identity(name))
            if output is not None:
                known = "" if os.fspath(name) == os.fspath(output) else f", as '{name}'"
                raise UsageError(
                    f"'{output}' is an input too{known}: it would be replaced by the result; give the output another "
                    "name"
                )


def _identity(path: str | os.PathLike[str]) -> _Identity:
    """Equal for two names of one file; a file that is not there yet is told by its folder and its name."""
    target = os.path.realpath(path)
    try:
        status = os.stat(target)
        return (status.st_dev, status.st_ino) if status.st_ino else (os.path.normcase(target),)
    except (OSError, ValueError):
        pass
    folder, name = os.path.split(target)
    try:
        status = os.stat(folder)
        return (status.st_dev, status.st_ino, os.path.normcase(name))
    except (OSError, ValueError):
        return (os.path.normcase(target),)


def _files(path: Path) -> Iterator[str]:
    """The files that are read where a path is given."""
    yield os.fspath(path)
    if isinstance(path, ReadCameras):
        # Imported where it is needed: most commands are given files.
        from potr_cl.formats.registry import CAMERA_FORMATS

        suffixes = {suffix for entry in CAMERA_FORMATS for suffix in entry.suffixes}
        inner = ["", *(each for entry in CAMERA_FORMATS for each in entry.subfolders)]
        folders = [os.path.join(path, each) for each in inner] if os.path.isdir(path) else [os.path.dirname(path)]
        for folder in folders:
            yield from _having(folder, suffixes)
    elif isinstance(path, ReadPhotographs):
        from potr_cl.formats.cameras.view_files import IMAGE_SUFFIXES

        for folder, _, _ in os.walk(path):
            yield from _having(folder, IMAGE_SUFFIXES)


def _having(folder: str, suffixes: Iterable[str]) -> Iterator[str]:
    """The files of a folder with one of these suffixes, which are in lower case."""
    try:
        names = os.listdir(folder or os.curdir)
    except OSError:
        return  # whoever reads it will say so
    yield from (os.path.join(folder, name) for name in names if name.lower().endswith(tuple(suffixes)))
