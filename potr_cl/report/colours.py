"""The colours of all pages that the package makes, so that they look like one thing: the report and the viewer."""

from __future__ import annotations

#: What can be touched, and bars of figures.
ACCENT = "#4269d0"
#: Of a chart's or a bar's parts, in this order; they are told apart by colour-blind people too.
SERIES = (ACCENT, "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5", "#9c6b4e")
#: Something failed, or is worst.
WARNING = "#ff725c"
#: Cameras that the encoder looks at, and those that only judge.
TRAINING_VIEW, TEST_VIEW = "#6cc5b0", "#efb118"
#: Behind pictures: neither dark nor bright ones look wrong on it.
STAGE = "#18181b"


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of "#rrggbb", 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
