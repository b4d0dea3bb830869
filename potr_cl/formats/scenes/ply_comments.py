"""What the comments of a PLY header say of how its scene was trained.

Brush writes ``SplatRenderMode: mip`` (or ``default``, ``2dgs``), as splat-transform does, in compressed PLY too.
Postshot writes ``antialiased 1``, newer versions ``postshot.anti_aliasing=1``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

#: What this package writes into the header of an antialiased scene, without the word "comment".
ANTIALIASED_COMMENT = "SplatRenderMode: mip"

_BRUSH = re.compile(r"\s*splatrendermode:?\s+(\w+)\s*", re.IGNORECASE)
_POSTSHOT = re.compile(r"\s*(?:antialiased\s+|postshot\.anti_aliasing\s*=\s*)([01])\s*", re.IGNORECASE)


def says_antialiased(comments: Iterable[str]) -> bool:
    """Whether comments mark a scene as antialiased; where several speak of it, the last one counts, as in PlayCanvas.

    Args:
        comments: of a header, without the word "comment".
    """
    antialiased = False
    for comment in comments:
        if match := _BRUSH.fullmatch(comment):
            antialiased = match[1].lower() == "mip"
        elif match := _POSTSHOT.fullmatch(comment):
            antialiased = match[1] == "1"
    return antialiased
