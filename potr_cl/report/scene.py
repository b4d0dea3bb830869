"""What a scene holds, in any format: counts, bounds, histograms, and what looks wrong (:func:`scene_report`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, CleanReport, Scene
from potr_cl.report.file import antialiasing

F64 = NDArray[np.float64]

#: Steps of the histograms of opacities and of the decimal logarithm of scales; bars are so many characters long.
_OPACITY_STEPS, _MOST_SCALE_STEPS, _BAR = 10, 24, 40
#: The part of the opaque splats that the robust bounds leave out at each end, and the opacity from which they count.
_LEFT_OUT, _OPAQUE = 0.01, 0.1
#: Renderers leave out what is below.
_INVISIBLE = 1 / 255
#: A splat is far when it is so many times as far from the middle as the corners of the robust bounds; huge when its
#: largest scale is more than this part of their diagonal.
_FAR, _HUGE = 10.0, 0.5
#: A splat is flat when its smallest scale is below this part of its largest.
_FLAT = 1e-5
#: Training leaves up to one or two in a hundred splats flat.
_MANY_FLAT = 0.05
#: With fewer splats values may lie in some range by chance.
_MANY = 50
#: Two in a hundred splats at the place of another one are more than training leaves.
_DUPLICATES = 0.02
#: Two odd numbers, to make one of three coordinates.
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F], np.uint64)


def scene_report(scene: Scene, mended: Sequence[CleanReport] = ()) -> dict[str, Any]:
    """The facts of a scene, ready for JSON.

    Args:
        scene: clean, at least one splat.
        mended: what its reader had to drop or to change.

    Returns:
        ``splats``, ``sh_degree``, ``antialiased``, ``low_pass``; ``bounding_box`` of all centres, and
        ``robust_bounding_box``, which leaves out one in a hundred opaque splats on each side of each axis: lists of
        the lowest and the highest x, y, z; ``opacity`` and ``scale`` (each splat's largest standard deviation), with
        quantiles and a histogram: ``edges``, one more than there are ``counts``; ``suspicious``: a list of ``what``,
        ``splats`` (how many it concerns) and ``said``, a line for people.
    """
    opacity = scene.opacities.astype(np.float64)
    largest = scene.log_scales.max(axis=1).astype(np.float64) / np.log(10)
    means = scene.means
    solid = opacity >= _OPAQUE
    robust = np.quantile(means[solid] if solid.any() else means, [_LEFT_OUT, 1 - _LEFT_OUT], axis=0)
    steps = np.linspace(0, 1, _OPACITY_STEPS + 1)
    return {
        "splats": len(scene),
        "sh_degree": scene.sh_degree,
        "antialiased": scene.antialiased,
        "low_pass": scene.low_pass,
        "bounding_box": [means.min(axis=0).tolist(), means.max(axis=0).tolist()],
        "robust_bounding_box": robust.tolist(),
        "opacity": {"quantiles": _quantiles(opacity), **_histogram(opacity, steps)},
        "scale": {
            "quantiles": _quantiles(_power(largest)),
            **_histogram(largest, _scale_steps(largest), as_power=True),
        },
        "suspicious": suspicious(scene, mended),
    }


def suspicious(scene: Scene, mended: Sequence[CleanReport] = ()) -> list[dict[str, Any]]:
    """What looks wrong with a scene: see :func:`scene_report`."""
    found: list[dict[str, Any]] = []
    count = len(scene)

    def note(what: str, splats: int, said: str) -> None:
        if splats:
            found.append({"what": what, "splats": splats, "said": said.format(n=f"{splats:,}")})

    def sum_of(field: str) -> int:
        return sum(getattr(report, field) for report in mended)

    note("non_finite", sum_of("non_finite"), "{n} splats have NaN or infinite values: they are left out")
    note("zero_quaternions", sum_of("zero_quaternions"), "{n} splats have a rotation of length 0: they are not rotated")
    note(
        "infinite_opacities",
        sum_of("infinite_opacities"),
        "{n} splats have an infinite opacity logit: it stands for an opacity of 0 or 1",
    )
    opacity = scene.opacities
    faint = int(np.count_nonzero(opacity < _INVISIBLE))
    if faint == count:
        note("all_transparent", count, "all splats are transparent: nothing is to be seen")
    elif faint > count / 2:
        note("mostly_transparent", faint, "{n} splats, more than half, are transparent (opacity below 1/255)")
    if count >= _MANY:
        _note_activated(scene, note)
    _note_colours(scene, note)
    _note_sizes(scene, note)
    duplicates = count - _distinct(scene.means)
    if duplicates > _DUPLICATES * count:
        note("duplicated_positions", duplicates, "{n} splats lie exactly where another one does")
    return found


def _note_activated(scene: Scene, note: Any) -> None:
    """Values that someone has put through the activation that a renderer applies once more."""
    count, logits, scales = len(scene), scene.opacity_logits, scene.log_scales
    if logits.min() >= 0 and logits.max() <= 1 and logits.max() > logits.min():
        note(
            "activated_opacities",
            count,
            "all opacity values lie between 0 and 1: they look like opacities, not like their logits, as which they "
            "are read",
        )
    extent = float(np.linalg.norm(np.quantile(scene.means, 0.9, axis=0) - np.quantile(scene.means, 0.1, axis=0)))
    if scales.min() >= 0 and scales.max() > scales.min() and np.median(scales) < max(extent, 1e-30):
        note(
            "activated_scales",
            count,
            "no scale value is negative: they look like scales, not like their logarithms, as which they are read",
        )


def _note_colours(scene: Scene, note: Any) -> None:
    degree = scene.sh_degree
    used = [bool(scene.sh[:, (k * k) : (k + 1) ** 2].any()) for k in range(degree + 1)]
    real = max((k for k in range(1, degree + 1) if used[k]), default=0)
    if real < degree:
        part = "all coefficients but the constant ones are 0" if real == 0 else f"those above degree {real} are all 0"
        note("unused_sh_degree", len(scene), f"the file says SH degree {degree}, but {part}")
    dc = scene.sh[:, 0]
    if len(scene) >= _MANY and dc.min() >= 0 and dc.max() <= 1 and dc.max() > dc.min():
        note(
            "activated_colours",
            len(scene),
            "all constant colour coefficients lie between 0 and 1: they look like RGB, not like spherical harmonics",
        )


def _note_sizes(scene: Scene, note: Any) -> None:
    means = scene.means.astype(np.float64)
    low, high = np.quantile(means, [_LEFT_OUT, 1 - _LEFT_OUT], axis=0)
    diagonal = float(np.linalg.norm(high - low))
    if diagonal > 0:
        away = np.linalg.norm(means - (low + high) / 2, axis=1)
        far = int(np.count_nonzero(away > _FAR * diagonal / 2))
        note("far_outliers", far, f"{{n}} splats are more than {_FAR:g} times as far out as 98 % of all")
        with np.errstate(over="ignore"):
            huge = scene.scales.max(axis=1) > _HUGE * diagonal
        note("huge_scales", int(np.count_nonzero(huge)), "{n} splats are larger than half of the scene")
    spread = scene.log_scales.max(axis=1) - scene.log_scales.min(axis=1)
    flat = int(np.count_nonzero(spread > -np.log(_FLAT)))
    if flat > _MANY_FLAT * len(scene):
        note(
            "flat_scales",
            flat,
            "{n} splats have no thickness, as those of 2DGS: one scale is below 1/100000 of another",
        )


def _distinct(means: NDArray[np.float32]) -> int:
    """How many different positions there are, compared bit by bit."""
    bits = np.ascontiguousarray(means + np.float32(0)).view(np.uint32).astype(np.uint64)  # 0 and -0 are one place
    with np.errstate(over="ignore"):
        mixed = (bits[:, 0] << np.uint64(32) | bits[:, 1]) * _MIX[0] ^ (bits[:, 2] + np.uint64(1)) * _MIX[1]
    order = np.argsort(mixed, kind="stable")
    ordered = bits[order]
    return 1 + int(np.count_nonzero((ordered[1:] != ordered[:-1]).any(axis=1)))


def _power(logarithms: Any) -> F64:
    """Ten to the power of logarithms, as far as that can be computed with."""
    power: F64 = 10.0 ** np.clip(np.asarray(logarithms, np.float64), -300, 300)
    return power


def _quantiles(values: F64) -> dict[str, float]:
    names = {"least": 0.0, "5%": 0.05, "median": 0.5, "95%": 0.95, "most": 1.0}
    return dict(zip(names, np.quantile(values, list(names.values())).tolist(), strict=True))


def _scale_steps(logarithms: F64) -> F64:
    """Edges at round decimal logarithms, four steps a decade or fewer where the scales span many; open at both ends."""
    low, high = np.quantile(logarithms, [0.001, 0.999])
    step = 0.25
    while (high - low) / step > _MOST_SCALE_STEPS:
        step *= 2
    first, last = np.floor(low / step), np.ceil(high / step)
    return np.arange(first, max(last, first + 1) + 1) * step


def _histogram(values: F64, edges: F64, as_power: bool = False) -> dict[str, Any]:
    """Counts between edges; what lies beyond the outermost ones counts to the outermost steps."""
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
    shown = _power(edges) if as_power else edges
    return {"edges": [float(f"{edge:.6g}") for edge in shown], "counts": counts.tolist()}


def format_scene(report: dict[str, Any]) -> str:
    """The facts as lines for people, the histograms as bars."""
    coefficients = 3 * SH_COEFFICIENTS[report["sh_degree"]]
    lines = [
        f"splats          {report['splats']:,}",
        f"SH degree       {report['sh_degree']}, {coefficients} coefficients per splat",
        f"antialiased     {antialiasing(report)}",
        f"bounding box    {_box(report['bounding_box'])}",
        f"robust bounds   {_box(report['robust_bounding_box'])}",
        "",
        *format_histograms(report),
        "",
        *format_suspicious(report),
    ]
    return "\n".join(lines)


def format_histograms(report: dict[str, Any]) -> list[str]:
    """The histograms of opacities and scales as lines of text."""
    return [
        f"opacity         {_summary(report['opacity'])}",
        *_bars(report["opacity"]),
        "",
        f"largest scale   {_summary(report['scale'])}",
        *_bars(report["scale"]),
    ]


def format_suspicious(report: dict[str, Any]) -> list[str]:
    """What looks wrong, as lines of text."""
    if not report["suspicious"]:
        return ["suspicious      nothing"]
    return [f"suspicious      {entry['said']}" for entry in report["suspicious"]]


def _box(box: Sequence[Sequence[float]]) -> str:
    return " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in zip(*box, strict=True))


def _summary(facts: dict[str, Any]) -> str:
    quantiles = facts["quantiles"]
    return f"median {quantiles['median']:.3g}, 90 % between {quantiles['5%']:.3g} and {quantiles['95%']:.3g}"


def _bars(facts: dict[str, Any]) -> list[str]:
    edges, counts = facts["edges"], facts["counts"]
    most, total = max(counts), sum(counts)
    lines = []
    for low, high, count in zip(edges, edges[1:], counts, strict=False):
        length = max(round(_BAR * count / most), 1 if count else 0)
        share = f"{100 * count / total:.1f} %"
        lines.append(f"  {low:>9.3g} to {high:<9.3g}{share:>8} {'#' * length}".rstrip())
    return lines
