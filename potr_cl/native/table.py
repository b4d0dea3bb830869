"""Which C stands for which NumPy: :data:`TABLE`. Whoever calls a definition need not know that there is a choice.

A definition is a function in NumPy under :func:`definition`: plain, and what runs where the library is not there. Its
twin takes the library's functions first and then the same arguments; it gives the same bits, or NotImplemented for
arguments that C does not take, which are left to the definition.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

from potr_cl.native.library import native

P = ParamSpec("P")
R = TypeVar("R")

#: Twins by definition, each "module:function" of potr_cl. What is None in NumPy is there in C alone.
TABLE = {
    "codec.block_values:bundle_share": "codec.block_values:_bundle_share_of_c",
    "codec.bundles.decoder:bundled_file": "codec.bundles.decoder:_bundled_file_by_c",
    "codec.bundles.encoder:coded": "codec.bundles.encoder:encode_natively",
    "codec.splat_levels:quantised": "codec.splat_levels:_quantised_by_c",
    "codec.geometry:nearest": "codec.geometry:_nearest_by_c",
    "codec.octree.builder:begin": "codec.octree.builder:_begin_by_c",
    "codec.octree.builder:leaf_order": "codec.octree.builder:_leaf_order_by_c",
    "codec.octree.parser:parse": "codec.octree.parser:_parse_by_c",
    "codec.quantize:canonical_rotations": "codec.quantize:_canonical_rotations_by_c",
    "codec.quantize:nonzero_levels": "codec.quantize:_nonzero_levels_by_c",
    "codec.splat_levels:splat_levels": "codec.splat_levels:_splat_levels_by_c",
    "codec.steps.rule:colour_classes": "codec.native.bundles:colour_classes",
    "codec.steps.prediction:to_residuals": "codec.steps.prediction:_to_residuals_by_c",
    "model.matter:horizons_of": "model.matter:_horizons_by_c",
    "model.matter:shown_of": "model.matter:_shown_by_c",
    "model.spherical_harmonics:energy": "model.spherical_harmonics:_energy_by_c",
    "outputs.feedback:unit_factors": "outputs.feedback:_unit_factors_by_c",
}


def definition(function: Callable[P, R]) -> Callable[P, R]:
    """A definition that the table has: its twin runs in its place where the library is there and takes the arguments.

    Raises:
        KeyError: the table lacks it.
    """
    twin = TABLE[f"{function.__module__.removeprefix('potr_cl.')}:{function.__qualname__}"]

    @wraps(function)
    def either(*args: P.args, **kwargs: P.kwargs) -> R:
        functions = native()
        if functions is not None:
            found: R = resolved(twin)(functions, *args, **kwargs)
            if found is not NotImplemented:
                return found
        return function(*args, **kwargs)

    return either


@cache
def resolved(name: str) -> Callable[..., Any]:
    """The function of an entry."""
    module, function = name.split(":")
    found: Callable[..., Any] = getattr(import_module(f"potr_cl.{module}"), function)
    return found
