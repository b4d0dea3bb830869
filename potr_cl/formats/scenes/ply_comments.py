"""What the comments of a PLY header say of how its scene was trained.

Brush writes ``SplatRenderMode: mip`` (or ``default``, ``2dgs``), as splat-transform does, in compressed PLY too.
Postshot writes ``antialiased 1``, newer versions ``postshot.anti_aliasing=1``. Brush trains with Mip-Splatting's
low-pass filter (``compensate_cov2d`` of its renderer), and signs its files. No other scene is known to have that which
bears only a comment.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, Scene

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
