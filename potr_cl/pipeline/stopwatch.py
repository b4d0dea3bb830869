"""The time that stages take, and how far they are: :class:`Stopwatch`."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

from potr_cl.stages.stage import Progress

_log = logging.getLogger("potr_cl")


def added_up(*parts: Mapping[str, float]) -> dict[str, float]:
    """Seconds by stage of several stopwatches together."""
    found: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            found[stage] = found.get(stage, 0.0) + seconds
    return found


class Stopwatch:
    """Passes progress on, and notes how long each stage took. Time of a stage within another is not counted twice.

    Attributes:
        seconds: wall time by stage, in the order in which they began.
        tell: takes lines about the work.
    """

    def __init__(self, progress: Progress | None = None, tell: Callable[[str], None] | None = None) -> None:
        self._progress = progress
        self.tell: Callable[[str], None] = tell or _log.debug
        self._running: str | None = None
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: float) -> None:
        now = time.perf_counter()
        self.seconds.setdefault(stage, 0.0)
        self.seconds[self._running or stage] += now - self._last
        self._running, self._last = stage if done < 1 else None, now
        if self._progress is not None:
            self._progress(stage, done)
