"""What is told of a comparison of two scenes (:class:`Comparison`), for programs and for people.

A is the reference scene (uncompressed), B the candidate. With photographs, both are also judged against those.
:mod:`potr_cl.quality.judging` finds the figures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.formats.images import to_8_bits
from potr_cl.model.scene import FloatArray
from potr_cl.quality.figures import Figures, ViewFigures

_TITLES = {
    "b_against_a": "B against A",
    "a_against_truth": "A against photo",
    "b_against_truth": "B against photo",
    "loss": "loss by photo",
}

#: Factors by which an error map may be amplified.
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class SceneFile:
    """What there is to say of a scene without rendering it."""

    path: Path
    nbytes: int
    splats: int
    sh_degree: int
    antialiased: bool = False


@dataclass(frozen=True)
class Comparison:
    """All views' figures.

    Attributes:
        views: in the order of the cameras.
        worst: index of the view with the lowest PSNR of B against A.
    """

    views: list[ViewFigures]
    worst: int

    def __repr__(self) -> str:
        mean, worst = mean_view(self.views).figures["b_against_a"], self.views[self.worst]
        views = f"{len(self.views)} view{'s' if len(self.views) > 1 else ''}"
        return (
            f"Comparison({views}, PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}, "
            f"worst {worst.figures['b_against_a'].psnr:.2f} dB in '{worst.name}')"
        )


def comparing(views: int) -> str:
    """What the comparison of so many views is called in the progress."""
    return f"comparing {views} view{'s' if views > 1 else ''}"


def comparison_of(views: list[ViewFigures]) -> Comparison:
    """The comparison that some views' figures make.

    Raises:
        UsageError: there is none.
    """
    if not views:
        raise UsageError("there is no view to compare")
    worst = min(range(len(views)), key=lambda number: views[number].figures["b_against_a"].psnr)
    return Comparison(views, worst)


def mean_view(views: Sequence[ViewFigures]) -> ViewFigures:
    """Means over the views; identical pictures are left out of a mean PSNR, which is infinite if all are identical."""

    def mean(values: Sequence[float]) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else math.inf

    means = {}
    for pair in views[0].figures:
        all_views = [view.figures[pair] for view in views]
        distances = [f.lpips for f in all_views if f.lpips is not None]
        means[pair] = Figures(
            mean([f.psnr for f in all_views]),
            mean([f.ssim for f in all_views]),
            mean(distances) if distances else None,
        )
    return ViewFigures("mean", means)


# ------------------------------------------------------------------------------------------ for programs


def size_report(a: SceneFile, b: SceneFile) -> dict[str, Any]:
    """Sizes and splats of both files, for JSON."""

    def entry(scene: SceneFile) -> dict[str, Any]:
        return {
            "file": str(scene.path),
            "bytes": scene.nbytes,
            "splats": scene.splats,
            "sh_degree": scene.sh_degree,
            "antialiased": scene.antialiased,
        }

    return {"a": entry(a), "b": entry(b), "size_ratio": a.nbytes / b.nbytes}


def comparison_report(comparison: Comparison) -> dict[str, Any]:
    """The figures of all views and their means, for JSON.

    JSON knows no infinity: a PSNR of null means that the pictures are identical.
    """

    def entry(view: ViewFigures) -> dict[str, dict[str, float | None]]:
        result = {}
        for pair, figures in view.figures.items():
            result[pair] = {"psnr": figures.psnr if math.isfinite(figures.psnr) else None, "ssim": figures.ssim}
            if figures.lpips is not None:
                result[pair]["lpips"] = figures.lpips
        return result

    return {
        "mean": entry(mean_view(comparison.views)),
        "identical_views": sum(view.identical for view in comparison.views),
        "worst_view": comparison.views[comparison.worst].name,
        "views": [{"name": view.name, **entry(view)} for view in comparison.views],
    }


# ------------------------------------------------------------------------------------------ for people


def format_sizes(a: SceneFile, b: SceneFile) -> str:
    """Sizes and splats of both files as lines."""
    width = max(len(str(a.path)), len(str(b.path)), 4)
    lines = [f"   {'file':<{width}}{'bytes':>16}{'splats':>13}{'SH degree':>11}"]
    for name, scene in (("A", a), ("B", b)):
        lines.append(f"{name}  {scene.path!s:<{width}}{scene.nbytes:>16,}{scene.splats:>13,}{scene.sh_degree:>11}")
    if a.nbytes >= b.nbytes:
        lines.append(f"B is {a.nbytes / b.nbytes:.1f} times smaller")
    else:
        lines.append(f"B is {b.nbytes / a.nbytes:.1f} times larger")
    return "\n".join(lines)


def _cells(figures: Figures, lpips: bool) -> str:
    decibels = f"{figures.psnr:.2f}" if math.isfinite(figures.psnr) else "identical"
    cells = f"{decibels:>11}{figures.ssim:>9.4f}"
    if lpips:
        cells += f"{'-':>9}" if figures.lpips is None else f"{figures.lpips:>9.4f}"
    return cells


def format_comparison(comparison: Comparison) -> str:
    """The figures of all views and their means as a table."""
    views = comparison.views
    lpips = any(view.figures["b_against_a"].lpips is not None for view in views)
    width = max(4, *(len(view.name) for view in views))
    columns = f"{'PSNR dB':>11}{'SSIM':>9}" + (f"{'LPIPS':>9}" if lpips else "")
    titles = [_TITLES[pair] for pair in views[0].figures]
    lines = [
        " " * width + "".join(f"{title:>{len(columns)}}" for title in titles),
        f"{'view':<{width}}" + columns * len(titles),
    ]
    for view in (*views, mean_view(views)):
        cells = "".join(_cells(figures, lpips) for figures in view.figures.values())
        lines.append(f"{view.name:<{width}}{cells}")
    identical = sum(view.identical for view in views)
    if 0 < identical < len(views):
        lines.append(f"{identical} of {len(views)} views are identical in A and B and left out of their mean PSNR")
    worst = views[comparison.worst]
    if not worst.identical:
        lines.append(f"worst view: {worst.name}, {worst.figures['b_against_a'].psnr:.2f} dB")
    return "\n".join(lines)


def side_by_side(a: NDArray[Any], b: NDArray[Any]) -> tuple[NDArray[np.uint8], int]:
    """A, B and their :func:`difference_map` in one picture, (H, 3 W, 3) uint8, and the map's factor."""
    heat, factor = difference_map(a, b)
    return to_8_bits(np.concatenate([a, b, heat], axis=1)), factor


def difference_map(a: NDArray[Any], b: NDArray[Any]) -> tuple[FloatArray, int]:
    """The :func:`heat_map` of two pictures, amplified as much as their differences allow.

    Returns:
        (H, W, 3) float32, and the factor: the largest of 1, 2, 5, 10 … that leaves all but a thousandth of the pixels
        below full white.
    """
    difference = _largest_difference(a, b)
    largest = float(np.quantile(difference, 0.999))
    factor = max(f for f in _FACTORS if f == 1 or f * largest <= 1)
    return _heat(difference, factor), factor


def heat_map(a: NDArray[Any], b: NDArray[Any], factor: int) -> FloatArray:
    """Each pixel's largest difference of a channel times a factor, from black over red and yellow to white.

    Returns:
        (H, W, 3) float32.
    """
    return _heat(_largest_difference(a, b), factor)


def _largest_difference(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    difference: NDArray[Any] = np.abs(np.clip(a, 0, 1) - np.clip(b, 0, 1)).max(axis=-1)
    return difference


def _heat(difference: NDArray[Any], factor: int) -> FloatArray:
    heat: NDArray[Any] = np.clip(3 * factor * difference[..., None] - np.array([0, 1, 2]), 0, 1)
    return heat.astype(np.float32)
