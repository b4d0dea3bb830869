"""What a user may choose of an encode, as keywords: their types (:class:`EncodeChoices`), and the options they ask for.

At run time :mod:`potr_cl.pipeline.options` says what the keywords of stages mean; tests/api/test_choices.py compares
both.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

from potr_cl.api.inputs import ColourSource, colour_of
from potr_cl.codec.quantize import Preset
from potr_cl.errors import UsageError
from potr_cl.outputs.output import Output
from potr_cl.outputs.registry import OUTPUTS, output_of, output_of_suffix
from potr_cl.pipeline.options import EncodeOptions, keyword_of, stage_changes
from potr_cl.pipeline.presets import DEFAULT as DEFAULT
from potr_cl.pipeline.presets import PRESETS as PRESETS
from potr_cl.pipeline.presets import PURPOSE as PURPOSE
from potr_cl.pipeline.presets import stages_of
from potr_cl.pipeline.target import Target, as_bytes, size_in_bytes
from potr_cl.stages.code import Code
from potr_cl.stages.stage import Flag as Flag
from potr_cl.stages.stage import Stage as Stage
from potr_cl.stages.stage import flags as flags
from potr_cl.workers.host import ClusterSource

#: The stages whose options may be chosen.
STAGES = stages_of(DEFAULT)


class PruneChoices(TypedDict, total=False):
    """Options of the stage "prune"."""

    prune: bool | Mapping[str, Any] | None
    keep: float | None
    count: int | None
    delta_mse_max: float | None
    iterations: int | None
    tolerance: float | None
    turns: int | None
    damping: float | None
    mapping_a: float | None
    unseen: Literal["keep", "drop", "protect"] | None


class CompactChoices(TypedDict, total=False):
    """Options of the stage "compact"."""

    compact: bool | Mapping[str, Any] | None
    compact_at: float | None
    lambda_: float | None
    alpha: float | None
    colour_model: Literal["ycocg", "rgb"] | None
    weighting: Literal["importance", "visibility"] | None
    one_pass: bool | None


class FitChoices(TypedDict, total=False):
    """Options of the stages "fit", "merge" before it, and "between", the extra views that stages look at."""

    merge: bool | Mapping[str, Any] | None
    fit: bool | int | Literal["auto", "off"] | Mapping[str, Any] | None
    views_between: float | Literal["auto", "off"] | None
    between: Mapping[str, Any] | None


class RefitChoices(TypedDict, total=False):
    """Options of the stage "refit"."""

    refit: bool | int | Literal["auto", "off"] | Mapping[str, Any] | None
    drop: float | None
    refit_at: float | Sequence[float] | None
    photos: str | os.PathLike[str] | None


class CodeChoices(TypedDict, total=False):
    """Options of the stage "code", which writes the file."""

    code: Mapping[str, Any] | None
    entropy: str | None
    zstd_level: int | None
    gamma: float | None
    beta: float | None
    sf_dc: float | None
    sf_sh: float | None
    sf_opacity: float | None
    sf_rotation: float | None
    sf_scale: float | None
    block_splats: int | None


class StageChoices(PruneChoices, CompactChoices, FitChoices, RefitChoices, CodeChoices, total=False):
    """Options of all stages of an encode."""


class EncodeChoices(StageChoices, total=False):
    """Options of all stages, and those that are seldom needed.

    Attributes:
        to: suffix of the kind of file (".spz") where there is no ``output`` to tell it; .potr by default.
        spz_version: of an .spz file, 2, 3 or 4; of tiles (tileset.json), 2 or 3.
        title, author: shown on a page (.html).
        levels: of detail, each with half as many splats: a number or "auto"; of a .potr file 1 by default.
        lod_chunk_count, lod_chunk_extent: of lod-meta.json and tileset.json: the most splats of a leaf of the tree, in
            thousands (1024), and its largest side in world units.
        virtual_views: how many views to place without cameras.
        cameras_anyway: use the cameras even if they do not seem to be in the scene's frame.
        background: R, G, B from 0 to 1, or a colour's name; black by default.
        trust: read files that expand to far more memory than their size suggests.
        antialiased: whether the scene was trained with antialiasing; None: what the file says.
        cluster: a Dask cluster whose workers share the views: its scheduler's address, or a client.
        memory: limit in GiB for cached views and the re-fit; by default half of the GPU's memory, 0.3 of the RAM on a
            CPU. If it is given, large arrays of the host are kept in temporary files (docs/large_scenes.md).
        threads: on the host; one per processor by default.
    """

    to: str | None
    spz_version: int | None
    title: str | None
    author: str | None
    levels: int | Literal["auto"] | None
    lod_chunk_count: int | None
    lod_chunk_extent: float | None
    virtual_views: int | None
    cameras_anyway: bool | None
    background: ColourSource | None
    trust: bool
    antialiased: bool | None
    cluster: ClusterSource
    memory: float | None
    threads: int | None


def encode_options(
    options: EncodeOptions | None,
    preset: Preset | None,
    choices: Mapping[str, Any],
    *,
    q: float | None = None,
    background: ColourSource | None = None,
    memory: float | None = None,
    threads: int | None = None,
    cameras_anyway: bool | None = None,
    levels: int | str | None = None,
    output: Output | None = None,
    stages: Collection[type[Stage]] | None = None,
) -> EncodeOptions:
    """The options that keywords ask for, checked.

    Args:
        options: to be changed by the others; None: those of the preset.
        choices: of stages, see :func:`potr_cl.pipeline.options.stage_changes`.
        stages: of which choices are allowed; None: of all.
        memory: in GiB.
        levels: of detail, a number or "auto".
        output: the kind of file.

    Raises:
        UsageError: an option is unknown or out of range, or both options and a preset are given.
    """
    if threads is not None and threads < 0:
        raise UsageError(f"--threads is {threads}, it must be 0 or more")
    changes: dict[str, Any] = {
        "q": q,
        "background": None if background is None else colour_of(background),
        "memory": as_bytes(memory),
        "threads": threads,
        "cameras_anyway": cameras_anyway,
        "levels": levels,
        "output": output,
    }
    changes = {name: value for name, value in changes.items() if value is not None} | stage_changes(choices, stages)
    if options is None:
        options = EncodeOptions.for_preset(preset or DEFAULT, **changes)
    elif not isinstance(options, EncodeOptions):
        raise UsageError(f"the options are an EncodeOptions, not {type(options).__name__}: give a quality as q=0.5")
    elif preset is not None:
        raise UsageError("give either options or a preset: the options have one")
    else:
        options = options.changed(**changes)
    _ = options.parameters  # a wrong option is reported before a gigabyte is read
    _check_coder(options)
    return options


def _check_coder(options: EncodeOptions) -> None:
    """Refuse options of the coder that mean nothing for the kind of file that is asked for."""
    usual, code = EncodeOptions(preset=options.preset).stage(Code), options.stage(Code)
    for name, flag in flags(Code).items():
        if getattr(code, name) != getattr(usual, name) and name not in options.output.choices:
            kind = options.output
            raise UsageError(
                f"{flag.flag} does not apply to {kind.suffix} files: {kind.format.name} has its own coding"
            )


def output_choice(path: str | os.PathLike[str] | None, to: str | None, **choices: Any) -> Output | None:
    """The kind of file that a name or a suffix asks for; None if nothing does.

    Args:
        path: of the file to write.
        to: a suffix, where there is no path.
        choices: that some outputs have; None where they are not given.

    Raises:
        UsageError: encode does not write such files, or they leave no such choice.
    """
    if path is not None:
        if to is not None:
            raise UsageError(f"'{path}' already gives the format: leave out 'to'")
        return output_of(Path(path), **choices)
    given = any(choice is not None for choice in choices.values())
    return output_of_suffix(to or OUTPUTS[0].suffixes()[0], **choices) if to is not None or given else None


def encode_target(q: float | None, max_size: int | str | None, min_psnr: float | None) -> Target | None:
    """What to reach, if anything.

    Raises:
        UsageError: more than one goal is given, or it is out of range.
    """
    if sum(goal is not None for goal in (q, max_size, min_psnr)) > 1:
        raise UsageError("give one of q, max_size and min_psnr: the others follow from it")
    if max_size is not None:
        return Target(max_bytes=size_in_bytes(max_size) if isinstance(max_size, str) else max_size)
    return None if min_psnr is None else Target(min_psnr=min_psnr)


def default_of(kind: type[Stage], field: str) -> str | None:
    """The default of a stage's option in words, with those of presets that differ; None where there is none to tell."""
    flag, default = flags(kind)[field], getattr(kind, field)
    if flag.default or default is None:
        return flag.default
    values = {
        preset: getattr(stage, field) for preset, stages in PRESETS.items() for stage in stages if type(stage) is kind
    }
    own = values.get(DEFAULT, default)
    others = [f"{preset}: {_in_words(value)}" for preset, value in values.items() if value != own]
    return _in_words(own) + (f" ({', '.join(others)})" if others else "")


def _in_words(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _listed() -> str:
    """The options of stages with their help, for ``help(potr_cl.EncodeChoices)``."""
    lines = []
    for kind in STAGES:
        lines.append(f'\n    Options of the stage "{kind.name}":')
        for flag in flags(kind).values():
            switched_off = "False: " if flag.flag.startswith("--no-") else ""
            lines.append(f"        {keyword_of(flag.flag)}: {switched_off}{flag.help}")
    return "\n".join(lines)


EncodeChoices.__doc__ = f"{EncodeChoices.__doc__}{_listed()}\n"
