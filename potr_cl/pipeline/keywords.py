"""Options of stages by the names that the command line gives them: :func:`stage_changes`.

``--delta-mse-max X`` is ``delta_mse_max=X``, ``--no-prune`` is ``prune=False``, ``--refit off`` is ``refit=False``, and
``--lambda``, which is a word of Python's own, is ``lambda_``. The names follow from the flags that the stages' fields
have (:func:`potr_cl.stages.stage.option`), so that a new one is understood here without a line of its own.
"""

from __future__ import annotations

import dataclasses
import difflib
import keyword
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.pipeline.presets import DEFAULT, stages_of
from potr_cl.stages.stage import Flag, Stage, flags


def keyword_of(flag: str) -> str:
    """The keyword of a flag as a user types it: "delta_mse_max" of "--delta-mse-max", "prune" of "--no-prune"."""
    name = flag.lstrip("-").removeprefix("no-").replace("-", "_")
    return name + "_" if keyword.iskeyword(name) else name


def stage_keywords(stages: Collection[type[Stage]] | None = None) -> dict[str, tuple[type[Stage], str, Flag]]:
    """Which field of which stage each keyword sets; of the default preset's stages unless some are given."""
    return {
        keyword_of(flag.flag): (kind, field, flag)
        for kind in (stages_of(DEFAULT) if stages is None else stages)
        for field, flag in flags(kind).items()
    }


def stage_changes(
    choices: Mapping[str, Any], stages: Collection[type[Stage]] | None = None
) -> dict[str, dict[str, Any]]:
    """What keywords choose of stages, as :meth:`potr_cl.pipeline.options.EncodeOptions.changed` takes it.

    A keyword that is a stage's own name may also be a mapping of options by field: ``prune={"iterations": 16}``.

    Args:
        choices: by keyword; a value of None leaves the option as it is.
        stages: those of the default preset unless some are given.

    Raises:
        UsageError: there is no such keyword, or a value is none of those that are allowed.
    """
    kinds = stages_of(DEFAULT) if stages is None else tuple(stages)
    known = stage_keywords(kinds)
    by_name = {kind.name: kind for kind in kinds}
    given: dict[type[Stage], dict[str, Any]] = {}
    more: dict[str, dict[str, Any]] = {}
    for name, value in choices.items():
        if value is None:
            continue
        if name in by_name and isinstance(value, Mapping):
            more.setdefault(name, {}).update(value)
        elif name in known:
            kind, field, flag = known[name]
            field, chosen = _value(kind, field, flag, name, value)
            if chosen is not None:  # refit="auto" is what the preset has
                given.setdefault(kind, {})[field] = chosen
        else:
            near = difflib.get_close_matches(name, [*known, *by_name], 1)
            hint = f": did you mean '{near[0]}'?" if near else f": there are {', '.join(sorted(known))}"
            raise UsageError(f"unknown option '{name}'{hint}")
    changes = {kind.name: kind.from_flags(values) for kind, values in given.items()}
    for name, values in more.items():
        changes[name] = {**changes.get(name, {}), **values}
    return changes


def _value(kind: type[Stage], field: str, flag: Flag, name: str, value: Any) -> tuple[str, Any]:
    """The field that a keyword sets, and the value that it sets it to."""
    default = next(each.default for each in dataclasses.fields(kind) if each.name == field)
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise UsageError(f"{name} is {value!r}: give True or False")
        # --one-pass switches two passes off; --no-prune is called prune.
        negative = keyword_of(flag.flag) not in (field, kind.name) and not flag.flag.startswith("--no-")
        return field, (not value if negative and default else value)
    if isinstance(value, bool) and name == kind.name:
        return "on", value
    if flag.choices and value not in flag.choices:
        raise UsageError(f"{name} is {value!r}: choose one of {', '.join(flag.choices)}")
    if flag.kind is Path and isinstance(value, (str, os.PathLike)):
        return field, Path(value)
    if isinstance(value, str) and not flag.choices:
        try:
            return field, flag.kind(value)
        except ValueError:
            raise UsageError(f"{name} is {value!r}: invalid value") from None
    if isinstance(value, np.generic):
        value = value.item()  # NumPy has numbers of its own, which JSON does not know
    if flag.kind is int and isinstance(value, float):
        if not value.is_integer():
            raise UsageError(f"{name} is {value:g}: give a whole number")
        value = int(value)
    if flag.many and not isinstance(value, (list, tuple)):
        return field, (value,)
    return field, value
