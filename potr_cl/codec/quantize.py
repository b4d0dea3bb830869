"""Quantiser: the hyper-parameters that one quality q sets, and the levels of every attribute.

A *level* is the integer that a value is rounded to; a *step* is the distance of two neighbouring levels' values, 1 / SF
with the scale factor SF. Levels are those of the *activated* values (paper section "Codec", eq. for quantisation and
dequantisation): standard deviations, opacities after the sigmoid, unit quaternions without their real part, SH
coefficients in YCoCg. Which function an attribute takes is up to the quantiser (:mod:`potr_cl.codec.quantisers`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.codec.native import quantising
from potr_cl.errors import DataError, UsageError
from potr_cl.model.spherical_harmonics import rotation_matrices
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

Integers = NDArray[np.signedinteger]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

#: "paper": the paper's steps and coder. "best": steps of equal worth, a small file. "smallest": the same
#: with more looks at more views. "fast": the
#: same with fewer looks at the views and quick coding.
Preset = Literal["paper", "fast", "best", "smallest"]
PRESETS: tuple[Preset, ...] = ("paper", "fast", "best", "smallest")

#: Added to a quantised opacity before the division: the paper's shift of the reconstruction off the bin's centre.
OPACITY_SHIFT = 0.25
#: Where logits are quantised themselves: the smallest, an opacity that shows nowhere, and the largest told apart.
RANGE_OF_LOGITS = LEAST_LOGIT, _LARGEST_LOGIT = -8.0, 12.0
#: A standard deviation that rounds to 0 comes back as this part of a step: its logarithm must stay finite.
ZERO_SCALE = 0.25
#: Quaternions turned at a time: few enough that a BLAS does not wake its threads, which takes longer than the work.
_ROWS = 1 << 11
#: Logarithms of levels are looked up in tables of two to the power of these: small ones are made in no time, large ones
#: fit a second-level cache.
_SMALLEST_TABLE, _LARGEST_TABLE = 8, 16
#: Splats of a block that may be asked for: fewer would make more blocks than readers take.
FEWEST_OF_A_BLOCK, MOST_OF_A_BLOCK = 1 << 14, 1 << 22
#: Integers beyond this are not exact in float64; no sane scene comes near.
_LARGEST = 2.0**53


@dataclass(frozen=True)
class HyperParameters:
    """What one quality q sets; each can be replaced on its own.

    Attributes:
        quantiser: how levels are made (:data:`potr_cl.codec.quantisers.QUANTISERS`): 0 the paper's way, 1 balanced.
        lam: λ, how strongly SH compaction pulls AC coefficients to zero, pixels squared.
        alpha: two SH columns whose cosine exceeds it count as parallel.
        delta_mse_max: ΔMSE_MAX: a splat may go if its removal changes the mean squared error by less.
        drop: the same for an AC coefficient, given up by the re-fit of the colours.
        beta: allowed distance of a centre to its leaf's centre: the paper's: as a part of the distance to the nearest
            camera; balanced: as a part of a typical splat's size at that distance.
        gamma: the least such distance, world units.
        sf_dc, sf_sh: scale factors of constant and of all other SH coefficients; a quantiser step is 1 / SF. Balanced:
            of steps that, the same for all splats, would show as much as the splats' own.
        sf_opacity: of opacities; balanced: of their logits.
        sf_rotation: of quaternions; balanced: times the root of the largest level of the splat's three scales.
        sf_scale: of standard deviations, world units; balanced: steps in a typical splat's size.
        block_splats: most splats of a block of the file; 0: as suits a file on a disk.
    """

    quantiser: int
    lam: float
    alpha: float
    delta_mse_max: float
    drop: float
    beta: float
    gamma: float
    sf_sh: float
    sf_dc: float
    sf_opacity: float
    sf_rotation: float
    sf_scale: float
    block_splats: float = 0

    @staticmethod
    def from_quality(q: float, preset: Preset = "paper", **replaced: float | None) -> HyperParameters:
        """The values for quality q in [0, 1]; keywords that are not None replace single ones.

        "paper" is the paper's table "Hyperparameters as functions of q"; docs/method.md tells where the others come
        from. Where only ``sf_sh`` is replaced, ``sf_dc`` follows it in "paper", which has one for both.

        Raises:
            UsageError: q, the preset or a replaced value is out of range.
        """
        if not 0 <= q <= 1:
            raise UsageError(f"the quality q is {q:g}, it must lie between 0 and 1")
        if preset not in PRESETS:
            raise UsageError(f"preset '{preset}' is unknown: choose one of {', '.join(PRESETS)}")
        given = {k: float(v) for k, v in replaced.items() if v is not None}
        values = _VALUES[preset](q, given)
        for field in fields(values):
            value = getattr(values, field.name)
            low, high = (1e-30, 1e30) if field.name == "gamma" else (0.0, 1e30)
            if field.name == "alpha":
                low, high = 1e-30, 1.0
            if field.name.startswith("sf_"):
                low, high = 1e-3, 1e9
            if field.name == "block_splats" and value:
                low, high = FEWEST_OF_A_BLOCK, MOST_OF_A_BLOCK
            if not low <= value <= high:
                raise UsageError(f"{field.name} is {value:g}, it must lie between {low:g} and {high:g}")
        return values


def _paper(q: float, given: Mapping[str, float]) -> HyperParameters:
    # The paper has one factor for all of SH.
    sf_sh = given.get("sf_sh", 1 + 100 * q)
    values = HyperParameters(
        quantiser=0,
        lam=10**-q,
        alpha=1 / (1 + math.exp(-3 * q)),
        delta_mse_max=10 ** (-8.8 - 2 * q),
        drop=0.0,
        beta=1.4e-4 * q,
        gamma=5.0 * 10 ** (-3 - 5 * q),
        sf_dc=sf_sh,
        sf_sh=sf_sh,
        sf_opacity=1 + 200 * q,
        sf_rotation=1 + 400 * q,
        sf_scale=1 + 4000 * q,
    )
    return replace(values, **given)  # type: ignore[arg-type]


def _balanced(q: float, given: Mapping[str, float]) -> HyperParameters:
    """Where a bit more buys the same everywhere; all errors grow with ΔMSE_MAX, so steps with its root.

    A coefficient is worth the part of a splat's bits that it takes, about a fourteenth.
    """
    finer = 10 ** (q - 0.5)
    delta_mse_max = 10 ** (-8.3 - 2 * q)
    values = replace(
        _paper(q, {}),
        quantiser=1,
        delta_mse_max=delta_mse_max,
        drop=delta_mse_max / 14,
        beta=0.056 / finer,
        gamma=1e-30,
        sf_dc=31 * finer,
        sf_sh=29 * finer,
        sf_opacity=3.3 * finer,
        sf_rotation=7.6 * finer,
        sf_scale=8.8 * finer,
    )
    return replace(values, **given)  # type: ignore[arg-type]


#: What a quality means in each preset, with some values given.
_VALUES: dict[Preset, Callable[[float, Mapping[str, float]], HyperParameters]] = {
    "paper": _paper,
    "fast": _balanced,
    "best": _balanced,
    "smallest": _balanced,
}


def _to_levels(values: F64, scale_factor: float | F32, what: str) -> Integers:
    """⌊½ + x · SF⌋ in the smallest of the signed integer types that holds it."""
    levels = values * scale_factor
    levels += 0.5
    np.floor(levels, out=levels)
    largest = max(float(levels.max(initial=0)), -float(levels.min(initial=0)))
    if not largest < _LARGEST:
        raise DataError(
            f"a {what} of {np.abs(values).max():.3g} is too large to quantise: remove that splat or lower SF"
        )
    return levels.astype(level_type(largest))


def level_type(largest: float) -> type[np.signedinteger]:
    """The smallest of the integer types of levels that holds ± some number."""
    for dtype in (np.int16, np.int32):
        if largest <= np.iinfo(dtype).max:
            return dtype
    return np.int64


# ------------------------------------------------------------------------------------------------ scales


def quantize_scales(log_scales: F64, sf_scale: float) -> Integers:
    """Natural logarithms of standard deviations, float64 of any shape, to levels >= 0 of the same shape.

    In steps of 1 / SF world units of the standard deviations themselves. Raises DataError if one is too large for a
    file.
    """
    with np.errstate(over="ignore"):
        return _to_levels(np.exp(log_scales), sf_scale, "standard deviation")


def dequantize_scales(levels: NDArray[np.integer], sf_scale: float) -> F32:
    """Levels >= 0, of any shape, to natural logarithms of standard deviations, float32 of the same shape."""
    return _looked_up(_log_scales, levels, sf_scale)


def _log_scales(levels: NDArray[np.integer], sf_scale: float) -> F32:
    scales = np.maximum(levels.astype(np.float32), np.float32(ZERO_SCALE)) / np.float32(sf_scale)
    return natural_logarithm(scales.astype(np.float32, copy=False))


def _looked_up(compute: Callable[[NDArray[np.integer], float], F32], levels: NDArray[np.integer], factor: float) -> F32:
    """What ``compute`` makes of levels >= 0 and a scale factor, from a table where the levels are small."""
    largest = int(levels.max(initial=0))
    # Tables of few sizes, so that the blocks of a file share them.
    table = _table(compute, 1 << max(_SMALLEST_TABLE, min(largest.bit_length(), _LARGEST_TABLE)), factor)
    values: F32 = table.take(levels, mode="clip")
    if largest >= len(table):
        beyond = np.flatnonzero(levels >= len(table))
        values[beyond] = compute(levels[beyond], factor)
    return values


@lru_cache(maxsize=16)
def _table(compute: Callable[[NDArray[np.integer], float], F32], size: int, factor: float) -> F32:
    return compute(np.arange(size), factor)


# ------------------------------------------------------------------------------------------------ opacity


def quantize_opacities(logits: F64, sf_opacity: float) -> Integers:
    """Logits, float64 of any shape, to levels >= 0 of the same shape, in steps of 1 / SF of the opacity."""
    return _to_levels(1 / (1 + np.exp(-np.clip(logits, -500, 500))), sf_opacity, "opacity")


def dequantize_opacities(levels: NDArray[np.integer], sf_opacity: float) -> F32:
    """Levels >= 0, of any shape, to float32 logits of (level + 0.25) / SF, kept a rounding below an opacity of 1."""
    return _looked_up(_logits, levels, sf_opacity)


def _logits(levels: NDArray[np.integer], sf_opacity: float) -> F32:
    opacity = (levels.astype(np.float32) + np.float32(OPACITY_SHIFT)) / np.float32(sf_opacity)
    opacity = np.minimum(opacity, np.float32(1 - 2.0**-24))
    return natural_logarithm(opacity / (1 - opacity))


def quantize_logits(logits: F64, sf_opacity: float) -> Integers:
    """Logits, float64 of any shape, to levels >= 0 of the same shape, in steps of 1 / SF from the least logit up."""
    return _to_levels(np.clip(logits, LEAST_LOGIT, _LARGEST_LOGIT) - LEAST_LOGIT, sf_opacity, "opacity")


def dequantize_logits(levels: NDArray[np.integer], sf_opacity: float) -> F32:
    """Levels of :func:`quantize_logits`, of any shape, to float32 logits of the same shape."""
    logits: F32 = levels.astype(np.float32) / np.float32(sf_opacity) + np.float32(LEAST_LOGIT)
    return logits


# ------------------------------------------------------------------------------------------------ rotation


def _octahedral_rotations() -> tuple[F64, NDArray[np.intp]]:
    """The 24 rotations g that map the axes onto each other: conjugate quaternions (24, 4), and axis permutations.

    With R' = R G the covariance R S² Rᵀ stays the same if S' holds the scales in the order ``permutation``.
    """
    quaternions = [np.eye(4)[i] for i in range(4)]
    quaternions += [np.array([1, a, b, c]) / 2 for a in (1, -1) for b in (1, -1) for c in (1, -1)]
    for i in range(4):
        for j in range(i + 1, 4):
            for sign in (1, -1):
                g = np.zeros(4)
                g[i], g[j] = np.sqrt(0.5), sign * np.sqrt(0.5)
                quaternions.append(g)
    table = np.array(quaternions)
    return table, np.abs(rotation_matrices(table)).argmax(axis=1)


_GROUP, _PERMUTATIONS = _octahedral_rotations()
_CONJUGATES = np.ascontiguousarray((_GROUP * (1, -1, -1, -1)).T)
#: (4, 24) and (24, 3): the same, and the axes, as the compiled library takes them.
AXIS_ROTATIONS = _CONJUGATES, _PERMUTATIONS.astype(np.uint8)


@definition
def canonical_rotations(quaternions: F32, log_scales: F32, order: NDArray[np.int64] | None = None) -> tuple[F64, F32]:
    """The equivalent form of each splat whose unit quaternion has the largest real part.

    A Gaussian has 24 equivalent pairs of rotation and order of scales, and two signs of each quaternion. The one with
    the largest real part (at least 0.85) has the smallest imaginary parts to code, and loses least when the dropped
    real part is computed from them.

    Args:
        quaternions: (N, 4) w, x, y, z of any non-zero length.
        log_scales: (N, 3).
        order: (n,) which of the splats; None: all.

    Returns:
        (n, 3) float64 imaginary parts of unit quaternions with a real part >= 0, and the log scales in matching order.
    """
    order = np.arange(len(quaternions)) if order is None else order
    log_scales = log_scales[order]
    q = quaternions[order].astype(np.float64)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    real = np.empty((len(q), len(_GROUP)))
    for start in range(0, len(q), _ROWS):
        np.matmul(q[start : start + _ROWS], _CONJUGATES, out=real[start : start + _ROWS])
    # Rounded, so that ties between equivalent forms fall the same way on every processor.
    real *= 1e9
    np.rint(real, out=real)
    best = np.abs(real).argmax(axis=1)
    gw, gx, gy, gz = _GROUP[best].T
    w, x, y, z = q.T
    product = np.stack(
        [w * gx + x * gw + y * gz - z * gy, w * gy - x * gz + y * gw + z * gx, w * gz + x * gy - y * gx + z * gw],
        axis=1,
    )
    product[np.take_along_axis(real, best[:, None], axis=1)[:, 0] < 0] *= -1
    return product, np.take_along_axis(log_scales, _PERMUTATIONS[best], axis=1)


def _canonical_rotations_by_c(
    c: CFunctions, quaternions: F32, log_scales: F32, order: NDArray[np.int64] | None = None
) -> tuple[F64, F32]:
    order = np.arange(len(quaternions)) if order is None else order
    imaginary, turned = np.empty((len(order), 3)), np.empty((len(order), 3), np.float32)
    quantising.canonical(
        c,
        np.ascontiguousarray(quaternions, np.float32),
        np.ascontiguousarray(log_scales, np.float32),
        np.ascontiguousarray(order, np.int64),
        *AXIS_ROTATIONS,
        imaginary,
        turned,
    )
    return imaginary, turned


def rotation_factors(scales: Sequence[NDArray[np.integer]], sf_rotation: float) -> F32:
    """(N,) a scale factor for each splat's rotation: SF times the root of the largest of its three scales' levels.

    Long splats need their direction more exactly; the root is the best power by measurement
    (docs/benchmarks/findings.md).
    """
    largest = np.maximum(np.maximum(scales[0], scales[1]), scales[2])
    factors: F32 = np.sqrt(np.maximum(largest, 1).astype(np.float32)) * np.float32(sf_rotation)
    return factors


def quantize_rotations(imaginary: F64, factor: float | F32) -> Integers:
    """One imaginary part of unit quaternions, (N,) float64, to signed levels, (N,).

    In steps of 1 / factor, which is one for all splats or (N,). Raises DataError if one is too large for a file.
    """
    return _to_levels(imaginary, factor, "quaternion component")


def dequantize_rotations(levels: Sequence[NDArray[np.integer]], factor: float | F32, out: F32) -> None:
    """Levels of x, y and z, (N,) each, to unit quaternions w, x, y, z in ``out``, (N, 4) float32.

    ``factor``: steps a unit, one for all splats or (N,). w ≥ 0 is computed from the rest.
    """
    rest = np.ones(len(out), np.float32)
    factor = np.asarray(factor, np.float32)
    with np.errstate(over="ignore"):  # of squares, in a hostile file: the real part is 0 then
        for axis, level in enumerate(levels, start=1):
            part = level.astype(np.float32) / factor
            out[:, axis] = part
            rest -= part * part
    out[:, 0] = np.sqrt(np.maximum(rest, 0))


# ------------------------------------------------------------------------------------------------ colour


def to_ycocg(rgb: F64) -> tuple[F64, F64, F64]:
    """(N, 3) R, G, B to Y = R/4 + G/2 + B/4, Co = R/2 − B/2, Cg = −R/4 + G/2 − B/4."""
    r, g, b = rgb[:, 0], rgb[:, 1], rgb[:, 2]
    # To multiply by a power of two is exact, as to divide is, and quicker.
    half = g * 0.5
    return r * 0.25 + half + b * 0.25, (r - b) * 0.5, half - (r + b) * 0.25


def quantize_sh(values: F64, sf_sh: float | F32) -> Integers:
    """One channel of one SH coefficient (YCoCg) to levels, in steps of 1 / SF, which may be one a splat."""
    return _to_levels(values, sf_sh, "SH coefficient")


@definition
def nonzero_levels(sh: F32, sf_sh: float) -> NDArray[np.bool_]:
    """Which SH coefficients the quantiser does not round to 0.

    Args:
        sh: (N, M, 3) R, G, B.
        sf_sh: scale factor.

    Returns:
        (N, M, 3) in Y, Co, Cg, the flags of each coefficient contiguous in memory.
    """
    planar = np.empty((*sh.shape[1:], len(sh)), bool)
    for m, flags in enumerate(planar):
        for c, channel in enumerate(to_ycocg(sh[:, m].astype(np.float64))):
            np.not_equal(quantize_sh(channel, sf_sh), 0, out=flags[c])
    return planar.transpose(2, 0, 1)


def _nonzero_levels_by_c(c: CFunctions, sh: F32, sf_sh: float) -> Any:
    if not (sh.flags.c_contiguous and sh.dtype == np.float32):
        return NotImplemented
    found = quantising.nonzero_levels(c, sh, sf_sh, _LARGEST)
    return NotImplemented if found is None else found.transpose(2, 0, 1)


def ac_sparsity(sh: F32, sf_sh: float) -> float:
    """The part of the AC coefficients, in YCoCg, that are quantised to 0; 1 if there are none.

    Args:
        sh: (N, M, 3) R, G, B.
        sf_sh: scale factor.
    """
    rest = sh[:, 1:]
    return 1 - np.count_nonzero(nonzero_levels(rest, sf_sh)) / rest.size if rest.size else 1.0
