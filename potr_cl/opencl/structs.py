"""Structs that host and device share, described once: in the kernels' source.

:func:`struct_dtype` reads a ``typedef struct`` and gives the NumPy type of the same layout. Only members of four bytes
are taken, so that every compiler packs them alike.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.opencl.source import kernel_source

_NUMBERS: dict[str, Any] = {"float": np.float32, "int": np.int32, "uint": np.uint32}


def struct_dtype(source: str, name: str, variants: Mapping[str, Path] | None = None) -> np.dtype[Any]:
    """The NumPy type of a struct.

    Args:
        source: the file below potr_cl/cl that defines it, or includes what does.
        name: of the struct.
        variants: see :func:`potr_cl.opencl.source.kernel_source`.

    Returns:
        A packed type whose fields have the members' names; arrays are sub-arrays.

    Raises:
        TypeError: there is no such struct, or a member is neither four bytes long nor another such struct.
    """
    return _dtype(_expanded(source, tuple((variants or {}).items())), source, name)


def bytes_before(struct: np.dtype[Any], member: str) -> int:
    """Where a member begins, in bytes from the struct's beginning."""
    assert struct.fields is not None
    return int(struct.fields[member][1])


@cache
def _dtype(text: str, source: str, name: str) -> np.dtype[Any]:
    found = re.search(r"typedef struct \{([^}]*)\} " + re.escape(name) + ";", text)
    if found is None:
        raise TypeError(f"potr_cl/cl/{source} defines no struct '{name}'")
    fields: list[tuple[Any, ...]] = []
    for statement in filter(None, (part.strip() for part in found[1].split(";"))):
        kind, members = statement.split(None, 1)
        number = _NUMBERS[kind] if kind in _NUMBERS else _dtype(text, source, kind)
        for member in members.split(","):
            shaped = re.fullmatch(r"\s*(\w+)(?:\[(\d+)\])?\s*", member)
            if shaped is None:
                raise TypeError(f"potr_cl/cl/{source}: '{statement}' in struct '{name}' is no plain member")
            fields.append((shaped[1], number, int(shaped[2])) if shaped[2] else (shaped[1], number))
    return np.dtype(fields)


@cache
def _expanded(source: str, variants: tuple[tuple[str, Path], ...]) -> str:
    """The source without its comments."""
    return re.sub(r"/\*.*?\*/|//[^\n]*", " ", kernel_source(source, dict(variants)), flags=re.DOTALL)
