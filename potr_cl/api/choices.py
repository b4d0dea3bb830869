"""The options of stages as keywords, for editors, type checkers and ``help()``: :class:`EncodeChoices`.

At run time :mod:`potr_cl.pipeline.keywords` says what they mean; tests/api/test_choices.py compares both.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypedDict, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


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


class EncodeChoices(PruneChoices, CompactChoices, total=False):
    """Options of all stages of an encode."""

    views_between: float | Literal["auto", "off"] | None
    between: Mapping[str, Any] | None
    fit: bool | int | Literal["auto", "off"] | Mapping[str, Any] | None
    refit: bool | int | Literal["auto", "off"] | Mapping[str, Any] | None
    drop: float | None
    refit_at: float | Sequence[float] | None
    photos: str | os.PathLike[str] | None
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


def with_choices(choices: type[Any]) -> Callable[[_Function], _Function]:
    """Have ``help()`` and the completion of notebooks show the keywords of ``**choices`` one by one.

    Args:
        choices: a TypedDict of them.
    """

    def shown(function: _Function) -> _Function:
        signature = inspect.signature(function)
        own = [each for each in signature.parameters.values() if each.kind is not inspect.Parameter.VAR_KEYWORD]
        more = [
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=getattr(hint, "__forward_arg__", hint),
            )
            for name, hint in choices.__annotations__.items()
        ]
        function.__signature__ = signature.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
        return function

    return shown
