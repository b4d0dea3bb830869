"""Standard input, output and error, which whoever starts a process may have closed."""

from __future__ import annotations

import os
import sys


def open_standard_files() -> None:
    """Have all three lead somewhere, if only to nowhere.

    Otherwise the next file that is opened takes the number of the one that is missing, and what libraries print ends up
    in it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
