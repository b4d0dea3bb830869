"""How many pixels to render while a camera moves (:class:`Pace`): as many as keep the pictures coming."""

from __future__ import annotations

#: Seconds that a picture may take while the camera moves: ten pictures a second, and some time for the browser.
TARGET = 0.085
#: Part of the full width and height; from one to the next the pixels change by a factor of √2.
_STEPS = tuple(2.0 ** (-k / 4) for k in range(16))
#: Pixels along the shorter side that are rendered at least.
_LEAST = 96


class Pace:
    """Chooses a picture's size by what the last ones took.

    A picture's time has a part that does not depend on its size, such as the projection of all splats. So the size
    goes down at once by what the pixels alone would need, and up again one step at a time, where there is room.

    Args:
        target: seconds that a picture may take.
    """

    def __init__(self, target: float = TARGET) -> None:
        self._target = target
        self._step = 4  # a quarter of the pixels, until something is known

    @property
    def is_full(self) -> bool:
        """Whether pictures of full size come fast enough."""
        return self._step == 0

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the next picture, which has the full picture's shape as well as whole pixels can."""
        part = max(_STEPS[self._step], min(1.0, _LEAST / min(width, height)))
        return max(round(width * part), 1), max(round(height * part), 1)

    def took(self, seconds: float) -> None:
        """Learn from a picture of the size that :meth:`size` gave."""
        step, last = self._step, len(_STEPS) - 1
        expected = seconds
        while expected > self._target and step < last:
            step += 1
            expected /= 2**0.5
        if step == self._step and seconds * 2**0.5 < 0.85 * self._target:
            step = max(step - 1, 0)
        self._step = step
