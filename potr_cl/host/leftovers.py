"""Temporary files and folders, none of which outlives the process (:func:`removed_at_end`, :func:`temporary_folder`).

What is registered here goes when its block ends, and also when a signal ends the process in the middle of anything
(:mod:`potr_cl.host.process`). Few imports: this is loaded before a signal can be handled at all.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_registered: set[str] = set()


@contextmanager
def removed_at_end(path: str | os.PathLike[str]) -> Iterator[None]:
    """Remove a file, or a folder with all that is in it, when the block ends in whatever way.

    It is registered first, so that it need not exist yet: between making a file and registering it a signal may come.
    """
    name = os.fspath(path)
    _registered.add(name)
    try:
        yield
    finally:
        _remove(name)
        _registered.discard(name)


@contextmanager
def temporary_folder() -> Iterator[str]:
    """A new folder of this user alone in the system's folder for temporary files, gone when the block ends.

    Raises:
        UnwritableError: there is no such folder that can be written to.
    """
    import secrets

    from potr_cl.errors import UnwritableError

    advice = "make room there, or name another by the environment variable TMPDIR"
    try:
        name = os.path.join(place_for_temporary_files(), f"potr-cl-{secrets.token_hex(8)}")
    except OSError as error:
        raise UnwritableError(f"there is no folder for temporary files that can be written to: {advice}") from error
    with removed_at_end(name):
        try:
            os.mkdir(name, 0o700)
        except OSError as error:
            raise UnwritableError(f"cannot make the temporary folder '{name}': {error.strerror}: {advice}") from error
        yield name


def place_for_temporary_files() -> str:
    """The system's folder for temporary files, as :func:`tempfile.gettempdir` finds it, but without the file that it
    makes there for a trial, which a signal may leave behind.

    Raises:
        OSError: there is none that can be written to.
    """
    if os.name == "posix":
        for name in (*map(os.environ.get, ("TMPDIR", "TEMP", "TMP")), "/tmp", "/var/tmp", "/usr/tmp"):
            if name and os.path.isdir(name) and os.access(name, os.W_OK | os.X_OK):
                return os.path.abspath(name)
    import tempfile

    return tempfile.gettempdir()


def remove_all() -> None:
    """Remove whatever is registered: for the end of the process."""
    for name in list(_registered):
        _remove(name)


def _remove(name: str) -> None:
    # What is not there was never made, or has been renamed already.
    with suppress(OSError):
        if not os.path.isdir(name) or os.path.islink(name):
            os.unlink(name)
            return
        for folder, folders, files in os.walk(name, topdown=False):
            for file in files:
                os.unlink(os.path.join(folder, file))
            for inner in folders:
                os.rmdir(os.path.join(folder, inner))
        os.rmdir(name)
