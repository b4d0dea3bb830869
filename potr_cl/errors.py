"""The exceptions that potr_cl raises on purpose: each message is one line that says what, where and how to mend it."""

from __future__ import annotations

from potr_cl.plain_text import plain


class PotrError(Exception):
    """Base of every error raised on purpose; the command line prints it as one line and exits with ``exit_code``.

    Args:
        message: may quote what a file holds: it is made harmless here (:func:`potr_cl.plain_text.plain`), so that
            no caller has to.
    """

    exit_code = 1

    def __init__(self, message: object = "") -> None:
        super().__init__(plain(message))


class DataError(PotrError):
    """A file's content is not what it should be (damaged, truncated, of another kind)."""


class UsageError(PotrError):
    """The call itself cannot be carried out: a wrong option, a path that does not exist, a missing extra."""

    exit_code = 2


class WriteError(PotrError):
    """The system does not write a file: the disk is full, a quota, a folder that is gone.

    Attributes:
        path: of the file, as it was given.
    """

    def __init__(self, message: object = "", path: str = "") -> None:
        super().__init__(message)
        self.path = path


class UnwritableError(WriteError, UsageError):
    """No file can be made at a path."""


class DeviceError(PotrError):
    """An OpenCL device is missing, failed to build a program, or ran out of memory.

    Whatever takes a device's memory or runs on it can raise this: inside the package docstrings say so only where there
    is more to it.
    """


class DeviceMemoryError(DeviceError):
    """What was asked for does not fit an OpenCL device's memory."""


class UnreachableError(PotrError):
    """No quality gives what was asked for; the message says what the extremes give."""
