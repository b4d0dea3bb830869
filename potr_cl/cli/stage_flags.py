"""The flags of stages, made from their fields: a new option of a stage shows here without a line of its own."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Any

from potr_cl.api.choices import STAGES, Flag, Stage, default_of, flags
from potr_cl.cli.guard import ReadPhotographs
from potr_cl.cli.parser import whole_number

#: What the command line takes more exactly than stages do: the folders that they name hold photographs.
_TYPES: dict[Any, Any] = {Path: ReadPhotographs, int: whole_number}


def add_stage_flags(
    parser: argparse.ArgumentParser, stages: Collection[type[Stage]] | None = None, without: Collection[str] = ()
) -> None:
    """Add what a user can choose of stages, a group of flags each.

    Args:
        stages: those of the default preset unless some are given.
        without: fields that a command has no use for.
    """
    for kind in STAGES if stages is None else stages:
        group = parser.add_argument_group(kind.title)
        exclusive: dict[str, argparse._MutuallyExclusiveGroup] = {}
        for field, flag in flags(kind).items():
            if field in without:
                continue
            place: argparse._ActionsContainer = group
            if flag.group is not None:
                if flag.group not in exclusive:
                    exclusive[flag.group] = group.add_mutually_exclusive_group()
                place = exclusive[flag.group]
            _add(place, kind, field, flag)


def stage_choices(args: argparse.Namespace, stages: Collection[type[Stage]] | None = None) -> dict[str, dict[str, Any]]:
    """What was chosen of stages, as :meth:`potr_cl.pipeline.options.EncodeOptions.changed` takes it."""
    chosen = {}
    for kind in STAGES if stages is None else stages:
        given = {field: getattr(args, _dest(kind, field), None) for field in flags(kind)}
        changes = kind.from_flags({field: value for field, value in given.items() if value is not None})
        if changes:
            chosen[kind.name] = changes
    return chosen


def _dest(kind: type[Stage], field: str) -> str:
    return f"{kind.name}.{field}"


def _add(place: argparse._ActionsContainer, kind: type[Stage], field: str, flag: Flag) -> None:
    default = next(each.default for each in dataclasses.fields(kind) if each.name == field)
    settings: dict[str, Any] = {"dest": _dest(kind, field), "default": None, "help": flag.help}
    if isinstance(default, bool):
        if flag.flag == f"--{field}" or (field == "on" and not flag.flag.startswith("--no-")):
            settings["action"] = argparse.BooleanOptionalAction
            settings["help"] += f"; default: {flag.default}" if flag.default else ""
        else:  # a switch away from what is usual
            settings |= {"action": "store_const", "const": not default}
        place.add_argument(flag.flag, **settings)
        return
    settings["type"] = _TYPES.get(flag.kind, flag.kind)
    if flag.choices:
        settings["choices"] = flag.choices
    if flag.metavar:
        settings["metavar"] = flag.metavar
    if flag.many:
        settings["nargs"] = "+"
    usual = default_of(kind, field)
    if usual:
        settings["help"] += f"; default: {usual}"
    place.add_argument(flag.flag, **settings)
