"""Where a command's result goes: never into a file whose name promises another format, nor where no file can be.

A command says what it writes by the type of the argument (:class:`WrittenScene` and its like). :func:`check` runs
before every command, so that nothing is computed that could not be written.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from potr_cl.cli.guard import StandardOutput, WrittenFile, WrittenFolder, named
from potr_cl.errors import UsageError, WriteError
from potr_cl.host.atomic_write import check_place, replacing
from potr_cl.host.process import closed, standard_output_for_data


class WrittenScene(WrittenFile):
    """A scene in the format that the name's suffix tells."""


class WrittenEncoded(WrittenFile):
    """What an encode makes, of the kind that the name's suffix tells."""


class WrittenPage(WrittenFile):
    """A page of HTML."""


class WrittenPicture(WrittenFile):
    """A picture as PNG."""


class WrittenNumbers(WrittenFile):
    """An array of NumPy."""


#: The names of files whose folder is made with them.
_FOLDERS = {"lod-meta.json", "tileset.json"}

#: What has suffixes of its own, and what it is called.
_SUFFIXES: dict[type[WrittenFile], tuple[tuple[str, ...], str]] = {
    WrittenPage: ((".html", ".htm"), "a page of HTML"),
    WrittenPicture: ((".png",), "a PNG picture"),
    WrittenNumbers: ((".npy",), "an array of NumPy"),
}


def scene_output(text: str) -> Path:
    """A type of arguments: a scene that is written to a file, or to standard output."""
    return StandardOutput(text) if text == "-" else WrittenScene(named(text))


def place(text: str) -> Path:
    """A type of arguments: where one scene or several go, a file, a folder or standard output."""
    if text == "-":
        return StandardOutput(text)
    text = named(text)
    return WrittenFolder(text) if text.endswith((os.sep, "/")) or os.path.isdir(text) else WrittenFile(text)


def check(args: argparse.Namespace) -> None:
    """Refuse outputs whose names do not fit what is written, or that no file can be written to.

    Raises:
        UsageError: there is one.
    """
    to = getattr(args, "to", None)
    for name, path in vars(args).items():
        if to is not None and isinstance(path, WrittenScene):
            raise UsageError(f"'{path}' already gives the format: --to is for standard output")
        if isinstance(path, StandardOutput):
            _check_standard_output(args)
        elif isinstance(path, WrittenFolder):
            _check_folder(path)
            if "scenes" not in args and path.suffix.lower() == ".png" and not os.path.isdir(path):
                raise UsageError(f"'{path}': a folder of pictures is written: give it another name than a picture's")
        elif isinstance(path, WrittenFile):
            check_file(path, f"--{name}" if name != "output" else "-o")


def check_file(path: WrittenFile, option: str = "-o") -> None:
    """The same for one file.

    Raises:
        UsageError: it cannot be written, or not under this name.
    """
    made = path.name in _FOLDERS and not path.parent.exists()
    check_place(path.parent if made else path)
    check_name(path, option)


def check_name(path: WrittenFile, option: str = "-o") -> None:
    """Refuse a name that promises another format than what is written.

    Raises:
        UsageError: it does.
    """
    if isinstance(path, WrittenScene):
        from potr_cl.formats.registry import written_format  # imported on use: few commands need all formats

        written_format(path)
    elif isinstance(path, WrittenEncoded):
        from potr_cl.outputs.registry import output_of

        output_of(path)
    for kind, (suffixes, what) in _SUFFIXES.items():
        if isinstance(path, kind) and path.suffix.lower() not in suffixes:
            raise UsageError(f"'{path}': {option} writes {what}: give it a name that ends in {suffixes[0]}")


def _check_folder(path: Path) -> None:
    if os.path.lexists(path) and not os.path.isdir(path):
        raise UsageError(f"cannot make the folder '{path}': there is a file of this name")


def _check_standard_output(args: argparse.Namespace) -> None:
    if getattr(args, "json", False):
        raise UsageError("--json and the result both want standard output: give -o a name")
    if getattr(args, "to", None) is not None:
        args.to = suffix_of(args)
    if 1 in closed:
        raise UsageError("standard output is closed: redirect it, or give a name")
    with contextlib.suppress(OSError, ValueError, AttributeError):
        if sys.stdout.isatty():
            raise UsageError("refusing to write binary data to a terminal: redirect standard output, or give a name")


def suffix_of(args: argparse.Namespace) -> str:
    """What ``--to`` says, checked: a format that the command can write.

    Raises:
        UsageError: it is none.
    """
    from potr_cl.formats.registry import written_suffix

    check = getattr(args, "checked_suffix", written_suffix)
    checked: str = check(args.to)
    return checked


class Result(Protocol):
    """What takes a command's result, whole."""

    def write(self, content: bytes, /) -> object: ...


@contextlib.contextmanager
def writing(path: Path) -> Iterator[Result]:
    """A file or standard output, for a result that is handed over whole.

    Raises:
        As :func:`potr_cl.host.atomic_write.replacing`; also that standard output does not take it.
    """
    if not isinstance(path, StandardOutput):
        with replacing(path) as file:
            yield file
        return
    result = _Streamed()
    yield result
    try:
        path.stream.write(result.content)
        path.stream.flush()
    except OSError as error:
        raise not_streamed(error) from error


def not_streamed(error: OSError) -> WriteError:
    """What to raise where standard output does not take a result; also that the reader has gone."""
    return WriteError(f"cannot write to standard output: {error.strerror or error}")


class _Streamed:
    """What goes to standard output once it is whole."""

    content = b""

    def write(self, content: bytes, /) -> None:
        self.content = content


@contextlib.contextmanager
def standard_output(args: argparse.Namespace) -> Iterator[None]:
    """Of a command: if its result goes to standard output, nothing else does."""
    outputs = [path for path in vars(args).values() if isinstance(path, StandardOutput)]
    if not outputs:
        yield
        return
    with standard_output_for_data() as stream:
        for path in outputs:
            path.stream = stream
        yield
