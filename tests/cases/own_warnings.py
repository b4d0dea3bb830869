"""Warnings of what a test calls, told from those of others: libraries, compilers and the garbage collector warn too.

Filters of warnings belong to the whole process. While a test looks at warnings, a thread may build an OpenCL program,
whose compiler chats, or Python may collect a file that somebody has forgotten to close: no fault of what is tested.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import pyopencl as cl
import pytest

#: Kinds of warnings that come when they like, from whatever thread. Nothing in the package gives one of these.
FOREIGN: tuple[type[Warning], ...] = (cl.CompilerWarning, ResourceWarning)

#: For a test that fails at any warning but foreign ones. What pytest tells of errors elsewhere is foreign too: warnings
#: that became errors in the garbage collector, or in a thread that another test has left.
warnings_are_errors = pytest.mark.filterwarnings(
    "error",
    "ignore::pyopencl.CompilerWarning",
    "ignore::ResourceWarning",
    "ignore::pytest.PytestUnraisableExceptionWarning",
    "ignore::pytest.PytestUnhandledThreadExceptionWarning",
)


@contextmanager
def no_warnings() -> Iterator[None]:
    """Any warning inside is an error, but foreign ones."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for kind in FOREIGN:
            warnings.simplefilter("ignore", kind)
        yield
