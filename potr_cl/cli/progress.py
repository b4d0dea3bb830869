"""Progress on the terminal."""

from __future__ import annotations

import sys
import time
from typing import Any

from tqdm import tqdm

from potr_cl.cli.terminal import note


class Progress:
    """A bar with the time left on a terminal; elsewhere a line when a stage begins and ends.

    A stage may be interrupted by another and go on.
    """

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Any = None
        self._began: dict[str, float] = {}

    def __call__(self, stage: str, done: float) -> None:
        if stage != self._stage:
            self.close()
            self._stage = stage
            if sys.stderr.isatty():
                form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} elapsed, {remaining} left"
                self._bar = tqdm(total=1.0, initial=done, desc=stage, bar_format=form, leave=False)
            elif stage not in self._began:
                note(f"{stage} …")
            self._began.setdefault(stage, time.perf_counter())
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        if done >= 1:
            self.close()
            note(f"{stage}: {time.perf_counter() - self._began.pop(stage):.1f} s")
            self._stage = ""

    def tell(self, line: str) -> None:
        """Print a line of its own."""
        with tqdm.external_write_mode(file=sys.stderr):
            note(line)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
