"""Views and photographs that no fit looks at, so that they can judge it: :func:`share_out`, :func:`hold_out`.

Photographs know more than the scene does, but also noise, exposure and whatever moved between them. A fit to few of
them follows that too, and other photographs are then matched worse than before. So photographs held out decide
(:class:`PhotographChoice`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera

#: One photograph in so many is held out.
_ONE_IN = 8


@dataclass(frozen=True)
class PhotographChoice:
    """What photographs that no fit has seen say of both fits.

    Attributes:
        held_out: how many they are.
        fitted: mean PSNR against them of the colours fitted to the other photographs, decibels.
        rendered: of those fitted to the uncompressed scene's pictures.
    """

    held_out: int
    fitted: float
    rendered: float

    @property
    def kept(self) -> bool:
        """Whether the colours fitted to photographs are the better ones, and so the ones that are kept."""
        return self.fitted > self.rendered

    def __str__(self) -> str:
        which = "photographs" if self.kept else "the uncompressed scene's pictures"
        return (
            f"on {self.held_out} photograph{'s' if self.held_out > 1 else ''} held out, colours fitted to the others "
            f"reach {self.fitted:.2f} dB, colours fitted to the uncompressed scene's pictures {self.rendered:.2f} dB: "
            f"those fitted to {which} are kept"
        )


def hold_out(photographed: Sequence[Camera]) -> tuple[list[Camera], list[Camera]]:
    """Share photographed views out: those to fit to, and those to judge by, spread evenly.

    Raises:
        UsageError: there are fewer than two.
    """
    if len(photographed) < 2:
        raise UsageError(
            f"--photos has {len(photographed)} of the training views: two are needed, one of them to be held out and "
            "tell whether fitting to photographs helps"
        )
    every = min(_ONE_IN, len(photographed))
    judging = set(range(every // 2, len(photographed), every))
    return (
        [camera for number, camera in enumerate(photographed) if number not in judging],
        [camera for number, camera in enumerate(photographed) if number in judging],
    )


#: One view in so many is held out, but no more than the most.
_ONE_VIEW_IN, _MOST_HELD_OUT = 8, 8


def share_out(given: int, added: int) -> tuple[list[int], list[int]]:
    """Numbers of the views to fit to, and of those that are held out, spread evenly over those that were given.

    Args:
        given: how many views there are at first, and added: between these. A view that was added is never held out.

    Returns:
        Nothing is held out if there are fewer than two given views.
    """
    if given < 2:
        return list(range(given + added)), []
    every = max(min(_ONE_VIEW_IN, given), -(-given // _MOST_HELD_OUT))
    held_out = set(range(every // 2, given, every))
    return [number for number in range(given + added) if number not in held_out], sorted(held_out)
