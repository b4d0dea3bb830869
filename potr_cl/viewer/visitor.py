"""One tab of a browser (:class:`Visitor`): where it looks, and what it wants to see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from potr_cl.report.labels import U8
from potr_cl.viewer.comparison import Mode
from potr_cl.viewer.pace import Pace
from potr_cl.viewer.pose import Gaze
from potr_cl.viewer.session import Look, Which

#: Pixels along the longer side that are rendered at most.
MOST_PIXELS = 3840
#: Seconds without a movement after which the camera stands still.
PAUSE = 0.2


@dataclass(frozen=True, eq=False)
class Shown:
    """What a visitor is shown.

    Attributes:
        picture: (H, W, 3) uint8; None where the browser draws.
        still: whether it is as good as it gets.
        look: what it was made of.
        factor: by which differences in it are amplified.
    """

    picture: U8 | None
    still: bool
    look: Look
    factor: int


@dataclass(eq=False)
class Visitor:
    """A tab, as the painter knows it. Whoever changes a field calls :meth:`Painter.wake` afterwards.

    Attributes:
        number: of the tab.
        show: takes what the visitor is to see.
        tell: takes a line about what went wrong.
        gaze: where it looks; None before the browser has said so.
        width, height: of its picture in pixels.
        moved: when the camera moved last, by the monotonic clock.
        mode: how two scenes are compared.
        divider: the part of the width that shows A.
        factor: of differences; None: as much as they allow.
        swapped: whether A is shown in B's place and B in A's: the flicker key is held.
        fade: how much of the photograph shows.
        view: number of the view that the camera is at, if it is at one.
        draws: whether the browser draws what is to be seen by itself.
    """

    number: int
    show: Callable[[Shown], None]
    tell: Callable[[str], None]
    gaze: Gaze | None = None
    width: int = 0
    height: int = 0
    moved: float = 0.0
    mode: Mode = "divider"
    divider: float = 0.5
    factor: int | None = None
    swapped: bool = False
    fade: float = 0.0
    view: int | None = None
    draws: bool = False
    #: The painter's own: what was rendered last, of which camera, and whether more is to be done.
    look: Look | None = None
    is_still: bool = False
    stale_look: bool = True
    stale_picture: bool = True
    paces: dict[str, Pace] = field(default_factory=dict)
    painted: float = 0.0
    photograph: tuple[int, U8] | None = None

    def size(self) -> tuple[int, int]:
        """Width and height of a picture of full size."""
        part = min(1.0, MOST_PIXELS / max(self.width, self.height, 1))
        return max(round(self.width * part), 1), max(round(self.height * part), 1)

    @property
    def is_pictured(self) -> bool:
        """Whether it needs pictures: no browser draws photographs over a scene."""
        return not self.draws or self.fade > 0

    def needs(self, is_pair: bool) -> tuple[Which, ...]:
        """The scenes that its picture is made of."""
        if not self.is_pictured:
            return ()
        if not is_pair:
            return ("A", "B")
        if self.mode in ("A", "B"):
            other: Which = "B" if self.mode == "A" else "A"
            return (other,) if self.swapped else ("A",) if self.mode == "A" else ("B",)
        return ("A", "B")
