"""The programs that GPUs are given: what the head of each kernel file declares under "On GPUs".

A declaration names macros and the values that they take: ``LANES=1 SH_COUNT=1,4,9,16 PICKED=-,1 A=-,1 (B=2.5f)
WIDTH:4,48``. A ``-`` is a macro that is not given, what stands in brackets is given with the macro before it, of a
floating-point value one stands for all, and after a colon stand some of the sizes that a macro can have.
tests/conftest.py holds every program that a test builds against it.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path

_MACRO = re.compile(r"(\()?(\w+)([=:])([\w.,+-]*\w)\)?")

#: A macro, its values, None where it is not given; whether they are sizes; and the macros that are given with it.
_Choices = tuple[str, tuple[str | None, ...], bool, dict[str, str]]


def gpu_sources() -> list[str]:
    """The kernel files that GPUs are given, as ``prune/alive.cl``."""
    folder = Path(str(files("potr_cl") / "cl"))
    names = (path.relative_to(folder).as_posix() for path in sorted(folder.glob("*/*.cl")))
    return [name for name in names if not name.endswith("_cpu.cl")]


@functools.cache
def _choices(source: str) -> tuple[_Choices, ...]:
    text = (files("potr_cl") / "cl" / source).read_text("utf-8")
    head = text[: text.index("*/")]
    _, found, declared = head.partition("On GPUs:")
    if not found:
        raise ValueError(f"the head of cl/{source} does not say which programs GPUs are given")
    choices: list[_Choices] = []
    for together, name, sign, values in _MACRO.findall(declared):
        if together:
            choices[-1][3][name] = values
        else:
            some = tuple(None if value == "-" else value for value in values.split(","))
            choices.append((name, some, sign == ":", {}))
    return tuple(choices)


def gpu_programs(source: str) -> Iterator[dict[str, str]]:
    """The macros of each program of a file.

    Raises:
        ValueError: the file's head declares none.
    """
    for values in itertools.product(*(values for _, values, _, _ in _choices(source))):
        program: dict[str, str] = {}
        for (name, _, _, others), value in zip(_choices(source), values, strict=True):
            if value is not None:
                program |= {name: value, **others}
        yield program


def undeclared(source: str, macros: Mapping[str, str]) -> str | None:
    """What a program has that its file does not declare, or lacks; None if it is one of the declared ones."""
    if source.endswith("_cpu.cl"):
        return None
    sizes = {name for name, _, is_size, _ in _choices(source) if is_size}

    def kind(program: Mapping[str, str]) -> dict[str, str]:
        floats = {name for name, value in program.items() if "." in value or value.endswith("f")}
        return {name: "any" if name in sizes | floats else value for name, value in program.items()}

    if any(kind(program) == kind(macros) for program in gpu_programs(source)):
        return None
    return f"the head of cl/{source} does not declare a program with {dict(macros) or 'no macros'}"
