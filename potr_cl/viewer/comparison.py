"""Two pictures of one view in one (:func:`compared`), and a photograph over it (:func:`under_photograph`)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from PIL import Image

from potr_cl.formats.images import to_8_bits
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.quality.compare import difference_map, heat_map
from potr_cl.report.labels import U8
from potr_cl.viewer.pose import place_in

Mode = Literal["divider", "side by side", "A", "B", "difference", "heat map"]
#: In the order of the menu.
MODES: tuple[Mode, ...] = ("divider", "side by side", "A", "B", "difference", "heat map")
#: Factors that a user may choose; "auto" is that of :func:`potr_cl.quality.compare.difference_map`.
FACTORS = ("auto", "1", "2", "5", "10", "20", "50", "100")


def compared(mode: Mode, a: FloatArray, b: FloatArray, at: float = 0.5, factor: int | None = None) -> tuple[U8, int]:
    """One picture of two.

    Args:
        mode: how; "side by side" puts one beside the other, so each should be half as wide.
        a, b: (H, W, 3) float32 of one size, 0 to 1.
        at: of the divider, the part of the width that shows A.
        factor: by which differences are amplified; None: as much as they allow.

    Returns:
        (H, W, 3) uint8, W doubled for "side by side", and the factor; 1 where nothing is amplified.
    """
    if mode == "A":
        return to_8_bits(a), 1
    if mode == "B":
        return to_8_bits(b), 1
    if mode == "side by side":
        return to_8_bits(np.concatenate([a, b], axis=1)), 1
    if mode == "divider":
        column = round(min(max(at, 0.0), 1.0) * a.shape[1])
        return to_8_bits(np.concatenate([a[:, :column], b[:, column:]], axis=1)), 1
    heat, found = difference_map(a, b) if factor is None else (None, factor)
    if mode == "heat map":
        return to_8_bits(heat_map(a, b, found) if heat is None else heat), found
    return to_8_bits(found * np.abs(np.clip(a, 0, 1) - np.clip(b, 0, 1))), found


def under_photograph(picture: U8, view: Camera, photograph: U8, of: Camera, part: float) -> U8:
    """A picture with a photograph over it.

    Args:
        picture: (H, W, 3) of ``view``.
        view: the camera that it is of, which stands and looks as ``of`` does.
        photograph: (h, w, 3) of ``of``.
        of: the camera of the photograph.
        part: how much of the photograph shows, 0 to 1.
    """
    place = place_in(of, view)
    if place is None or part <= 0:
        return picture
    size = (place.right - place.left, place.bottom - place.top)
    fitting = Image.fromarray(photograph).resize(size, Image.Resampling.LANCZOS, place.box)
    result = picture.copy()
    inside = result[place.top : place.bottom, place.left : place.right]
    inside[:] = np.asarray(Image.blend(Image.fromarray(inside), fitting, min(part, 1.0)))
    return result
