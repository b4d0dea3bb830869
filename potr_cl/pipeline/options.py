"""How to encode: :class:`EncodeOptions` has every choice that a caller has."""

from __future__ import annotations

import dataclasses
import difflib
import keyword
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from potr_cl.codec.quantize import HyperParameters, Preset
from potr_cl.errors import UsageError
from potr_cl.model.scene import Scene
from potr_cl.outputs.output import Output
from potr_cl.outputs.potr import Potr
from potr_cl.pipeline.presets import DEFAULT, PRESETS, stages_of
from potr_cl.stages.code import Code
from potr_cl.stages.stage import Flag, Stage, flags, parameters

S = TypeVar("S", bound=Stage)
#: Levels of detail that a file may be asked to have.
MOST_LEVELS = 12


@dataclass(frozen=True)
class EncodeOptions:
    """How to encode. ``EncodeOptions()`` is what :func:`potr_cl.encode` does when it is told nothing.

    The options of a stage are an attribute of its name: ``options.prune.iterations``. To choose some, see
    :meth:`for_preset` and :meth:`changed`.

    Attributes:
        q: quality, 0 to 1; sets every hyper-parameter that no stage replaces.
        preset: how q sets them, and the file's version
            (:meth:`potr_cl.codec.quantize.HyperParameters.from_quality`).
        stages: the stages with their options, in their order; by default those of the preset.
        cameras_anyway: take the cameras even if they do not seem to be in the scene's frame.
        background: R, G, B behind the scene in the views that are looked at.
        memory: how many bytes of device memory may be filled with views; None: half of a GPU's memory, 0.3 of a CPU's.
        threads: number of threads for work on the host; the bytes do not depend on it. 0: one for each processor.
        output: the kind of file that is made (:mod:`potr_cl.outputs.registry`).
        source_bytes: size of the file that the scene came from, for the metadata; None if it came from none.
        levels: of detail, a number or "auto" (:mod:`potr_cl.levels`); None: as many as the kind of file has by itself.
    """

    q: float = 0.5
    preset: Preset = DEFAULT
    stages: tuple[Stage, ...] = ()
    cameras_anyway: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    memory: int | None = None
    threads: int = 0
    source_bytes: int | None = None
    output: Output = field(default_factory=Potr)
    levels: int | str | None = None

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UsageError(f"preset '{self.preset}' is unknown: choose one of {', '.join(PRESETS)}")
        if not isinstance(self.q, Real) or isinstance(self.q, bool):
            raise UsageError(f"the quality q is {self.q!r}: give a number from 0 to 1")
        # NumPy has numbers of its own, which JSON does not know.
        object.__setattr__(self, "q", float(self.q))
        if not self.stages:
            object.__setattr__(self, "stages", PRESETS[self.preset])
        self._check_levels()
        code = next((stage for stage in self.stages if isinstance(stage, Code)), None)
        if self.preset == "paper" and code is not None and code.entropy == "bundles":
            raise UsageError("--entropy bundles is not for preset paper, whose steps are stored as plain streams")

    def _check_levels(self) -> None:
        levels = self.levels
        if levels is None or levels == "auto" or (type(levels) is int and 1 <= levels <= MOST_LEVELS):
            if self.output.levels is None and levels not in (None, 1):
                raise UsageError(
                    f"--levels does not apply to {self.output.suffix} files: only .potr files, lod-meta.json and "
                    "tileset.json hold levels of detail"
                )
            return
        raise UsageError(f"--levels is {levels!r}: give a number from 1 to {MOST_LEVELS}, or auto")

    @property
    def wanted_levels(self) -> int | str:
        """How many levels of detail the file is to have, or "auto"."""
        return self.levels or self.output.levels or 1

    @staticmethod
    def for_preset(preset: Preset = DEFAULT, **changes: Any) -> EncodeOptions:
        """All that a preset means, with changes as :meth:`changed` takes them.

        Where the changes leave out the preset's re-fit and say nothing of the compaction, colours are compacted; where
        they ask for a re-fit that the preset does not have, colours are not.

        Raises:
            UsageError: there is no such preset or option, or a value is out of range.
        """
        usual = EncodeOptions(preset=preset)
        options = usual.changed(**changes)
        told = changes.get("compact")
        silent = told is None or (isinstance(told, Mapping) and "on" not in told)
        if silent and options.refit.asked_for != usual.refit.asked_for:
            options = options.changed(compact=not options.refit.asked_for)
        return options

    def changed(self, **changes: Any) -> EncodeOptions:
        """The same with other options.

        Args:
            changes: attributes by name, and by a stage's name either a mapping of its options or a bool that switches
                it on or off: ``changed(q=0.3, prune={"iterations": 16}, compact=True)``.

        Raises:
            UsageError: there is no such option, or a value is out of range.
        """
        stages = {stage.name: stage for stage in self.stages}
        own: dict[str, Any] = {}
        fields = {each.name for each in dataclasses.fields(self)}
        for name, change in changes.items():
            if name in stages:
                stages[name] = stages[name].changed(**_changes_of(name, change))
            elif name in fields:
                own[name] = change
            elif having_it := [preset for preset, table in PRESETS.items() if name in {each.name for each in table}]:
                raise UsageError(f"preset '{self.preset}' has no stage '{name}': it is in {', '.join(having_it)}")
            else:
                raise UsageError(f"unknown option '{name}': there are {', '.join(sorted(fields | stages.keys()))}")
        return dataclasses.replace(self, **{"stages": tuple(stages.values()), **own})

    def stage(self, kind: type[S]) -> S:
        """The options of a stage by its class.

        Raises:
            UsageError: the preset has no such stage.
        """
        for stage in self.stages:
            if isinstance(stage, kind):
                return stage
        raise UsageError(f"preset '{self.preset}' has no stage '{kind.name}'")

    def __getattr__(self, name: str) -> Any:
        for stage in self.__dict__.get("stages", ()):
            if stage.name == name:
                return stage
        raise AttributeError(f"encode options have no '{name}'")

    @property
    def parameters(self) -> HyperParameters:
        """The hyper-parameters that q gives, but for those that a stage replaces.

        A stage that is done may have them taken from another q (:meth:`potr_cl.stages.stage.Stage.quality`), all but
        the threshold of the pruning.

        Raises:
            UsageError: q or a replaced value is out of range.
        """
        given = {name: getattr(stage, name) for stage in self.stages for name in parameters(type(stage))}
        given |= {name: value for name, value in self.output.replaces.items() if given.get(name) is None}
        asked = HyperParameters.from_quality(self.q, self.preset, **given)
        q = self.q
        for stage in self.stages:
            q = stage.quality(q) if stage.asked_for else q
        if q == self.q:
            return asked
        finer = HyperParameters.from_quality(q, self.preset, **given)
        return dataclasses.replace(finer, delta_mse_max=asked.delta_mse_max)

    def with_parameters(self, **values: float) -> EncodeOptions:
        """The same with some hyper-parameters replaced, each in the stage that has it.

        Raises:
            UsageError: no stage has it.
        """
        changes: dict[str, dict[str, float]] = {}
        for name, value in values.items():
            owners = [stage.name for stage in self.stages if name in parameters(type(stage))]
            if not owners:
                raise UsageError(f"no stage replaces the hyper-parameter '{name}'")
            changes.setdefault(owners[0], {})[name] = value
        return self.changed(**changes)

    def look_at_views(self, scene: Scene) -> bool:
        """Whether the options ask for a stage that looks at views of this scene."""
        return any(stage.looks_at(scene) for stage in self.stages if not stage.serves_others)

    def as_dict(self) -> dict[str, Any]:
        """All choices by name, those of a stage as a mapping of their own; for reports, ready for JSON."""

        def plain(values: dict[str, Any]) -> dict[str, Any]:
            return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}

        own = {each.name: getattr(self, each.name) for each in dataclasses.fields(self) if each.name != "stages"}
        own["output"] = {"suffix": self.output.suffix, **dataclasses.asdict(self.output)}
        return own | {stage.name: plain(dataclasses.asdict(stage)) for stage in self.stages}


def _changes_of(stage: str, change: Any) -> Mapping[str, Any]:
    """The changes of one stage as options by name."""
    if isinstance(change, bool):
        return {"on": change}
    if not isinstance(change, Mapping):
        raise UsageError(f"'{stage}' is {change!r}: give a mapping of its options, True or False")
    return change


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

    A keyword that is a stage's own name may also be a mapping of options by field: ``prune={"iterations": 16}``; or
    False or True, where it is no flag's: ``between=False``.

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
        if name in by_name and (isinstance(value, Mapping) or name not in known):
            more.setdefault(name, {}).update(_changes_of(name, value))
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
