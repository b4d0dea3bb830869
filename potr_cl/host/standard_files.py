"""Standard input, output and error, which whoever starts a process may have closed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

# As typing has it, which takes long to import: until the program handles signals, Ctrl-C ends in a traceback.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import BinaryIO


#: Descriptors that were closed when the process began: what is to go there or come from there is refused.
closed: set[int] = set()


def open_standard_files() -> None:
    """Have all three lead somewhere, if only to nowhere, and note those that were :data:`closed`.

    Otherwise the next file that is opened takes the number of the one that is missing, and what libraries print ends up
    in it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            closed.add(descriptor)
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


@contextmanager
def standard_output_for_data() -> Iterator[BinaryIO]:
    """Standard output as a stream of bytes that nobody else writes to.

    Until the block ends, what this process prints there, and what libraries and drivers print there, which do not ask
    Python, goes to standard error.
    """
    ordinary = sys.stdout
    ordinary.flush()
    try:
        descriptor = ordinary.fileno()
    except (OSError, ValueError):  # no file of the system: within another program
        with redirect_stdout(sys.stderr):
            yield ordinary.buffer
        return
    kept = os.dup(descriptor)
    try:
        os.dup2(2, descriptor)
        with redirect_stdout(sys.stderr), os.fdopen(os.dup(kept), "wb") as stream:
            yield stream
    finally:
        os.dup2(kept, descriptor)
        os.close(kept)
