"""Which path is taken (:func:`native`): the compiled library if there is one, unless the user says otherwise."""

from __future__ import annotations

import importlib.machinery
import logging
import os
import sys
from functools import lru_cache
from pathlib import Path

from potr_cl.errors import UsageError
from potr_cl.native.declarations import CFunctions, declared

_log = logging.getLogger("potr_cl")

#: The environment variable: "0" takes NumPy always, "1" refuses to go on without the library.
VARIABLE = "POTR_CL_NATIVE"
#: Another library than the one that was built with the package, such as one with a sanitizer.
LIBRARY_VARIABLE = "POTR_CL_NATIVE_LIBRARY"
#: "0": without what only some processors have, as on all others.
VECTORS_VARIABLE = "POTR_CL_NATIVE_VECTORS"


def native() -> CFunctions | None:
    """The library's functions; None where NumPy is to be taken.

    Raises:
        UsageError: ``POTR_CL_NATIVE`` asks for a library that is not there, or is not 0 or 1.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "0", "1"):
        raise UsageError(
            f"{VARIABLE} is '{asked}': set it to 0 for NumPy, to 1 for the compiled library, or not at all"
        )
    if asked == "0":
        return None
    functions = _loaded(os.environ.get(LIBRARY_VARIABLE) or _found())
    if functions is None and not asked:
        _tell_once()
    if functions is None and asked == "1":
        raise UsageError(
            f"{VARIABLE} is 1, but the compiled library is missing: unset it, or install potr_cl with a C compiler"
        )
    return functions


def vectors() -> bool:
    """Whether the library may use vectors of 512 bits, where the processor has them."""
    return os.environ.get(VECTORS_VARIABLE) != "0"


@lru_cache(maxsize=1)
def _tell_once() -> None:
    _log.warning(
        "the compiled codec is missing, so NumPy does its work, several times slower: in a clone run `python -m "
        "tools.make.native`, else install potr_cl with a C compiler; %s=0 says that this is wanted",
        VARIABLE,
    )


_paths: list[str] = []


def _found() -> str | None:
    """The library beside this file, which is looked for until it is there: decoders ask some fifty times a file."""
    if not _paths and (path := _built()) is not None:
        _paths.append(path)
    return _paths[0] if _paths else None


def _built() -> str | None:
    for suffix in importlib.machinery.EXTENSION_SUFFIXES:
        path = Path(__file__).with_name(f"_library{suffix}")
        if path.is_file():
            return str(path)
    return None


@lru_cache(maxsize=4)
def _loaded(path: str | None) -> CFunctions | None:
    if path is None or sys.byteorder != "little":
        return None
    try:
        return declared(path)
    except (OSError, AttributeError):  # for another machine, or of another version of the package
        return None
