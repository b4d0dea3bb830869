"""What OpenCL compilers say when they fail, in one line, and whether one works at all."""

from __future__ import annotations

import functools
import re

import pyopencl as cl

from potr_cl.host.libraries import whatever_warns

_EMPTY_PROGRAM = "kernel void nothing(void) {}"
#: What pyopencl puts before and after the compiler's own words.
_HEADING = re.compile(r"^Build on <.*>:$")
_ENDING = re.compile(r"^\((options|source saved as): ?.*\)$")


def complaint(error: BaseException) -> str:
    """The line of a failed call's message that tells most: the compiler's first error, else its first words.

    Where no compiler spoke it is the message's first line, with what pyopencl says several times said once.
    """
    lines = [line.strip() for line in str(error).splitlines()]
    first = " - ".join(dict.fromkeys(lines[0].split(" - "))) if lines else type(error).__name__
    log = next((lines[i + 1 :] for i, line in enumerate(lines) if _HEADING.match(line)), [])
    log = [line for line in log if line and not _ENDING.match(line)]
    errors = (line for line in log if re.search(r"\berror\b", line, re.IGNORECASE))
    return next(errors, log[0] if log else first)


@functools.cache
def fault(device: cl.Device) -> str | None:
    """What is wrong with a device's compiler, as :func:`complaint` says it; None if it takes an empty program.

    Costs a few hundredths of a second, once a device and process.
    """
    try:
        # Without pyopencl's cache: what a compiler could do once, before a driver or a CPU changed, proves nothing.
        whatever_warns(
            lambda: cl.Program(cl.Context([device]), _EMPTY_PROGRAM).build(["-cl-std=CL1.2"], cache_dir=False)
        )
    except cl.Error as error:
        return complaint(error)
    return None
