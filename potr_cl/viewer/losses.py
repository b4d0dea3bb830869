"""What each view has lost (:class:`Losses`): found one view after the other, while nobody waits for a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from potr_cl.errors import DataError, UsageError
from potr_cl.formats.images import to_8_bits
from potr_cl.model.camera import Camera
from potr_cl.quality.metrics import psnr
from potr_cl.quality.photographs import GroundTruth
from potr_cl.report.labels import U8
from potr_cl.viewer.session import Session


@dataclass(frozen=True)
class Loss:
    """Figures of one view at its own size, in decibels; infinite for identical pictures.

    Attributes:
        psnr, ssim: of B against A; None without B.
        photograph_a, photograph_b: PSNR against the photograph; None where there is none, or no such scene.
    """

    psnr: float | None
    ssim: float | None
    photograph_a: float | None = None
    photograph_b: float | None = None

    @property
    def order(self) -> float:
        """The lower, the worse: what B loses to A on the photograph, else how close B is to A, else A's own PSNR."""
        if self.photograph_a is not None and self.photograph_b is not None:
            return self.photograph_b - self.photograph_a
        known = [value for value in (self.psnr, self.photograph_a, self.photograph_b) if value is not None]
        return known[0] if known else math.inf


class Losses:
    """The views, and what is known of each.

    Args:
        views: looking within their photographs, if there are any.
        photographs: of the views.
    """

    def __init__(self, views: Sequence[Camera], photographs: GroundTruth | None) -> None:
        self.views = list(views)
        self._photographs = photographs
        having = set() if photographs is None else {camera.name for camera in photographs.of(self.views)}
        self._with_photograph = [camera.name in having for camera in self.views]
        self._found: dict[int, Loss] = {}
        self._unknown: list[int] = []
        #: Why the last view has none, where its photograph could not be read.
        self.trouble = ""

    def begin(self, is_pair: bool) -> None:
        """Forget what was known, because other scenes are shown; test views will be judged first."""
        worth = [k for k, has in enumerate(self._with_photograph) if has or is_pair]
        self._found = {}
        self._unknown = sorted(worth, key=lambda k: (self.views[k].split == "test", -k))

    @property
    def is_complete(self) -> bool:
        return not self._unknown

    def has_photograph(self, number: int) -> bool:
        """Whether a view has a photograph."""
        return self._with_photograph[number]

    def photograph(self, number: int) -> U8:
        """(H, W, 3) uint8, the photograph of a view.

        Raises:
            UsageError, DataError: it cannot be read.
        """
        assert self._photographs is not None
        return to_8_bits(self._photographs.picture(self.views[number]))

    def step(self, session: Session) -> None:
        """Find the figures of one more view.

        Raises:
            DeviceError: it does not fit the device, or the device failed; the view is not tried again.
        """
        number = self._unknown.pop()
        camera = self.views[number]
        look = session.look(camera, figures=True)
        against: list[float | None] = [None, None]
        if self._with_photograph[number] and self._photographs is not None:
            try:
                photograph = self._photographs.picture(camera)
                against = [None if image is None else psnr(image, photograph) for image in (look.a, look.b)]
            except (UsageError, DataError) as error:
                self.trouble = str(error)
                self._with_photograph[number] = False
        self._found[number] = Loss(look.psnr, look.ssim, *against)

    def of(self, number: int) -> Loss | None:
        """What is known of a view."""
        return self._found.get(number)

    def order(self) -> list[int]:
        """The views' numbers: those of which something is known first, the worst at the top; the others as given."""
        known = sorted(self._found, key=lambda number: (self._found[number].order, number))
        return known + [number for number in range(len(self.views)) if number not in self._found]

    def mean(self) -> float | None:
        """Mean PSNR of B against A over the views known so far; identical ones are left out, as ``compare`` does."""
        values = [loss.psnr for loss in self._found.values() if loss.psnr is not None and math.isfinite(loss.psnr)]
        return sum(values) / len(values) if values else None
