"""What a PLY file says of antialiasing: by comments of its header (:func:`marked`), or the property ``filter_3D`` of
Mip-Splatting (:func:`folded`).

Brush writes ``SplatRenderMode: mip`` (or ``default``, ``2dgs``), as splat-transform does, in compressed PLY too.
Postshot writes ``antialiased 1``, newer versions ``postshot.anti_aliasing=1``. Brush trains with Mip-Splatting's
low-pass filter (``compensate_cov2d`` of its renderer), and signs its files. No other scene is known to have that which
bears only a comment.

Mip-Splatting (Yu et al. 2024) keeps scales and opacities as they are before its 3D smoothing filter, and beside them
each splat's standard deviation of that filter. Its renderer applies the filter whenever it draws; its
``create_fused_ply`` writes what comes of that into scales and opacities, as :func:`folded` does.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, FloatArray, Scene

#: What this package writes into the header of an antialiased scene, without the word "comment".
ANTIALIASED_COMMENT = "SplatRenderMode: mip"

_MODE = re.compile(r"\s*splatrendermode:?\s+(\w+)\s*", re.IGNORECASE)
_POSTSHOT = re.compile(r"\s*(?:antialiased\s+|postshot\.anti_aliasing\s*=\s*)([01])\s*", re.IGNORECASE)
_BRUSH = re.compile(r"\s*exported from brush\b.*", re.IGNORECASE)


def marked(scene: Scene, comments: Iterable[str]) -> Scene:
    """A scene with what the comments of its file say: whether it is antialiased, and with which low-pass filter.

    Args:
        scene: as read, classic.
        comments: of the header, without the word "comment". Where several speak of it, the last one counts, as in
            PlayCanvas' tools.
    """
    antialiased, low_pass, of_brush = False, LOW_PASS, False
    for comment in comments:
        if match := _MODE.fullmatch(comment):
            antialiased = match[1].lower() == "mip"
            low_pass = MIP_SPLATTING_LOW_PASS if of_brush else LOW_PASS
        elif match := _POSTSHOT.fullmatch(comment):
            antialiased, low_pass = match[1] == "1", LOW_PASS
        elif _BRUSH.fullmatch(comment):
            of_brush = True
    return replace(scene, antialiased=True, low_pass=low_pass) if antialiased else scene


#: The property's name.
FILTER_3D = "filter_3D"
#: Splats worked on at a time: the temporaries are float64.
_BLOCK = 1 << 16


def folded(scene: Scene, filters: FloatArray) -> Scene:
    """A scene with the 3D filter in its scales and opacities.

    A splat of standard deviations s and filter f gets √(s² + f²), and its opacity is multiplied by
    √(Π s² / Π (s² + f²)): it gets as much fainter as it gets larger.

    Args:
        scene: as the file has it.
        filters: (N,) float32 standard deviations of the filter, world units; 0 leaves a splat as it is.

    Returns:
        The scene, antialiased, with Mip-Splatting's low-pass filter. Splats whose filter is not finite are not either.
    """
    log_scales, logits = np.empty_like(scene.log_scales), np.empty_like(scene.opacity_logits)
    with np.errstate(all="ignore"):  # what is not finite is dropped afterwards
        for start in range(0, len(scene), _BLOCK):
            rows = slice(start, start + _BLOCK)
            before = scene.log_scales[rows].astype(np.float64)
            # ln √(s² + f²) without the squares, which may overflow.
            after = np.logaddexp(2 * before, 2 * np.log(np.abs(filters[rows].astype(np.float64)))[:, None]) / 2
            log_scales[rows] = after
            logits[rows] = _times(scene.opacity_logits[rows].astype(np.float64), (before - after).sum(axis=1))
            untouched = filters[rows] == 0
            log_scales[rows][untouched] = scene.log_scales[rows][untouched]
            logits[rows][untouched] = scene.opacity_logits[rows][untouched]
    return dataclasses.replace(
        scene, log_scales=log_scales, opacity_logits=logits, antialiased=True, low_pass=MIP_SPLATTING_LOW_PASS
    )


def _times(logits: NDArray[np.float64], log_factors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logits of opacities that are multiplied by e to ``log_factors``, which are not above 0.

    With o = 1 / (1 + e^-x) and k the factor, o k / (1 - o k) = k / (1 - k + e^-x).
    """
    product: NDArray[np.float64] = log_factors - np.logaddexp(np.log(-np.expm1(log_factors)), -logits)
    return product
