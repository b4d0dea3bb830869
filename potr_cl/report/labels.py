"""Pictures that say what they show: :func:`labelled` writes on strips above them, :func:`comparison_picture` and
:func:`contact_sheet` put several together.

The words for a comparison (:func:`view_label`, :func:`difference_label`) are those of the HTML report too. The font is
the one that Pillow brings along, so that pictures look the same wherever they are made.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats.images import to_8_bits
from potr_cl.plain_text import plain
from potr_cl.quality.compare import difference_map
from potr_cl.report.summary import decibels

U8 = NDArray[np.uint8]
#: What a label says: one text, or several from the longest to the shortest, of which the first that fits is taken.
Words = str | Sequence[str]

#: Pixels of the letters: a part of the pictures' height, between what is readable and what is loud.
_PART, _SMALLEST, _LARGEST = 1 / 30, 11, 28
_PAPER, _INK = (24, 24, 24), (240, 240, 240)
#: Pixels along the longer side of each picture of a contact sheet, and pictures in a row.
_THUMBNAIL, _ROW = 320, 4
#: What the two scenes of an encode are called.
BEFORE_AND_AFTER = ("uncompressed", "compressed")
#: More of a name would not fit on any picture.
_LONGEST = 120


def labelled(panels: Sequence[tuple[U8, Words]], heading: Words = "") -> U8:
    """Pictures side by side, each under its label, and all under a heading.

    No pixel of a picture is covered: the words stand on strips of their own above it. Where the pictures are too narrow
    for the longest text, a shorter one is taken, and in the end the shortest is cut.

    Args:
        panels: (H, W, 3) 8-bit pictures of equal height, and the label of each.
        heading: above all of them; nothing: no strip for it.

    Returns:
        (H + strips, the sum of all W, 3) 8-bit; the last H rows are the pictures as they were given.
    """
    height = panels[0][0].shape[0]
    size = round(min(max(height * _PART, _SMALLEST), _LARGEST))
    width = sum(picture.shape[1] for picture, _ in panels)
    rows = [_strip(heading, width, size)] if heading else []
    if any(words for _, words in panels):
        rows.append(np.concatenate([_strip(words, picture.shape[1], size) for picture, words in panels], axis=1))
    rows.append(np.concatenate([picture for picture, _ in panels], axis=1))
    return np.concatenate(rows)


def view_label(view: str, psnr: float | None) -> str:
    """What the pictures of one view are called: its name and its PSNR in decibels, None for identical pictures."""
    return f"{plain(view, _LONGEST)}, {'PSNR ' if psnr is not None else ''}{decibels(psnr)}"


def difference_label(factor: int) -> str:
    """What a :func:`~potr_cl.quality.compare.difference_map` of a factor is called."""
    return f"difference × {factor}"


def comparison_picture(
    a: NDArray[Any], b: NDArray[Any], view: str, psnr: float | None, names: tuple[str, str] = ("", "")
) -> tuple[U8, int]:
    """One view of two scenes and their difference, with labels.

    Args:
        a, b: (H, W, 3) pictures, 0 to 1.
        view: its name.
        psnr: of B against A in decibels; None for identical pictures.
        names: of both scenes, for instance those of their files.

    Returns:
        (H + strips, 3 W, 3) 8-bit, and the factor by which the difference is amplified.
    """
    heat, factor = difference_map(a, b)
    panels: list[tuple[U8, Words]] = [
        (to_8_bits(picture), [f"{letter}: {plain(name, _LONGEST)}", letter] if name else letter)
        for picture, letter, name in ((a, "A", names[0]), (b, "B", names[1]))
    ]
    short = difference_label(factor)
    panels.append((to_8_bits(heat), [f"{short} (A to B)", short, short.replace("difference", "diff."), f"× {factor}"]))
    return labelled(panels, [view_label(view, psnr), view_label(view, psnr).replace("PSNR ", "")]), factor


def contact_sheet(pictures: Sequence[tuple[U8, Words]], heading: Words = "", row: int = _ROW) -> U8:
    """Many pictures on one page, made small, each under its label.

    Args:
        pictures: (H, W, 3) 8-bit, of any sizes, and their labels; at least one.
        heading: above all of them.
        row: pictures beside each other.
    """
    from PIL import Image  # on use: what is encoded without a page needs the words alone

    longest = max(max(picture.shape[:2]) for picture, _ in pictures)
    factor = min(1.0, _THUMBNAIL / longest)
    # All cells are of one size, so that the rows are straight.
    height = max(1, round(factor * max(picture.shape[0] for picture, _ in pictures)))
    width = max(1, round(factor * max(picture.shape[1] for picture, _ in pictures)))
    cells: list[tuple[U8, Words]] = []
    for picture, words in pictures:
        cell = Image.new("RGB", (width, height), _PAPER)
        across, down = (max(1, round(factor * side)) for side in picture.shape[1::-1])
        small = Image.fromarray(picture).resize((across, down), Image.Resampling.LANCZOS)
        cell.paste(small, ((width - across) // 2, (height - down) // 2))
        cells.append((np.asarray(cell), words))
    columns = min(row, len(cells))
    empty: tuple[U8, Words] = (np.full((height, width, 3), _PAPER, np.uint8), "")
    cells += [empty] * (-len(cells) % columns)
    lines = [labelled(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    size = round(min(max(height * _PART, _SMALLEST), _LARGEST))
    return np.concatenate([*([_strip(heading, columns * width, size)] if heading else []), *lines])


def shrunk(pixels: U8, width: int) -> U8:
    """A picture, (H, W, 3) 8-bit, made smaller where it is wider than so many pixels."""
    if pixels.shape[1] <= width:
        return pixels
    from PIL import Image

    height = max(1, round(pixels.shape[0] * width / pixels.shape[1]))
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS))


@lru_cache(maxsize=16)
def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _strip(words: Words, width: int, size: int) -> U8:
    """One line of text on a strip of a width."""
    from PIL import Image, ImageDraw

    texts = [_drawable(text) for text in ([words] if isinstance(words, str) else words)]
    edge = max(3, size // 3)
    room = width - 2 * edge
    text, font = _fitting(texts, room, size)
    strip = Image.new("RGB", (width, size + 2 * edge), _PAPER)
    if text:
        ImageDraw.Draw(strip).text((edge, edge + size * 0.8), text, _INK, font, anchor="ls")
    return np.asarray(strip)


def _drawable(text: str) -> str:
    """As the font can show it, which knows ASCII only: letters without their accents, ? for other alphabets."""
    apart = unicodedata.normalize("NFKD", plain(text).replace("×", "x"))
    return "".join(each if each.isascii() else "?" for each in apart if not unicodedata.combining(each))


def _fitting(texts: Sequence[str], room: int, size: int) -> tuple[str, Any]:
    """The first text that fits at this size, else at the smallest readable one, else what fits of the last."""
    for points in dict.fromkeys((size, min(size, _SMALLEST))):
        for text in texts:
            if _font(points).getlength(text) <= room:
                return text, _font(points)
    font = _font(min(size, _SMALLEST))
    for length in range(len(texts[-1]) - 1, 0, -1):
        cut = texts[-1][:length] + ".."
        if font.getlength(cut) <= room:
            return cut, font
    return "", font
