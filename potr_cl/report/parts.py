"""Parts of the pages that this package writes: text, sections, tables, pictures, and charts of lines."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats.images import to_8_bits
from potr_cl.model.scene import FloatArray
from potr_cl.plain_text import plain
from potr_cl.report.style import SERIES

#: Pixels along a side of a WebP picture.
_WIDEST_WEBP = 16383


def text(words: object) -> str:
    """As HTML, and on one line without characters that do not print: names come from files that others wrote."""
    return escape(plain(words))


def section(title: str, content: str) -> str:
    """A title, and what is HTML already."""
    return f"<section><h2>{text(title)}</h2>\n{content}\n</section>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already."""
    top = "".join(f"<th>{text(cell)}</th>" for cell in head)
    lines = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>\n{lines}\n</tbody></table></div>'


def data_uri(picture: FloatArray | NDArray[np.uint8]) -> str:
    """A picture (H, W, 3) without loss: what is to be compared may differ by little."""
    from PIL import Image, features  # most encodes make no page

    pixels = picture if picture.dtype == np.uint8 else to_8_bits(picture)
    fits = max(pixels.shape[:2]) <= _WIDEST_WEBP and features.check("webp")
    kind, options = ("webp", {"lossless": True, "method": 2}) if fits else ("png", {})
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format=kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def chart(
    title: str,
    series: Sequence[tuple[str, Sequence[tuple[float, float]]]],
    logarithmic: bool = False,
    from_zero: bool = True,
) -> str:
    """Lines through points (x, y) with names; a logarithmic chart leaves out what is not above 0.

    Args:
        title, series: what is shown.
        logarithmic: of y.
        from_zero: whether a chart that is not logarithmic begins at 0; if not, at its lowest point.
    """
    width, height, margin_left, margin = 420, 240, 64, 28
    points = [(name, [(x, float(y)) for x, y in line if y > 0 or not logarithmic]) for name, line in series]
    every = [value for _, line in points for _, value in line]
    if not every:
        return ""
    scale = math.log10 if logarithmic else float
    low = scale(min(every)) if logarithmic or not from_zero else 0.0
    high = scale(max(every))
    if high - low < 1e-12:
        low, high = low - 1, high + 1
    places = [place for _, line in series for place, _ in line]
    first, last = min(places), max(places)

    def x(place: float) -> float:
        return margin_left + (width - margin_left - 10) * (place - first) / max(last - first, 1)

    def y(value: float) -> float:
        return height - margin - (height - 2 * margin) * (scale(value) - low) / (high - low)

    parts = [f'<text x="{margin_left}" y="16" class="title">{text(title)}</text>']
    for k in range(5):
        level = low + (high - low) * k / 4
        value = 10**level if logarithmic else level
        label = f"{value:.1e}" if logarithmic else f"{value:,.{0 if high - low > 4 else 1}f}"
        at = y(value)
        parts.append(
            f'<line x1="{margin_left}" x2="{width - 10}" y1="{at:.1f}" y2="{at:.1f}" class="grid"/>'
            f'<text x="{margin_left - 6}" y="{at + 4:.1f}" text-anchor="end">{label}</text>'
        )
    for place in sorted({first, round((first + last) / 2), last}):
        anchor = "end" if place == last else "middle"
        parts.append(f'<text x="{x(place):.1f}" y="{height - 8}" text-anchor="{anchor}">{place:,.0f}</text>')
    for number, (name, line) in enumerate(points):
        colour = SERIES[2 * number % len(SERIES)]
        path = " ".join(f"{x(place):.1f},{y(value):.1f}" for place, value in line)
        parts.append(f'<polyline points="{path}" stroke="{colour}" class="line"/>')
        if name:
            at, style = height - margin - 8 - 14 * number, f'text-anchor="end" style="fill:{colour}"'
            parts.append(f'<text x="{width - 14}" y="{at}" {style}>{text(name)}</text>')
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(parts)}</svg>'
