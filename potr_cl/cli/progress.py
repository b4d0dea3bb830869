"""Progress on the terminal."""

from __future__ import annotations

import sys
import time
from typing import Any

from tqdm import tqdm


class Progress:
    """A bar with the time left on a terminal; elsewhere a line when a stage begins and ends."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: Any = None
        self._began = 0.0

    def __call__(self, stage: str, done: float) -> None:
        if stage != self._stage:
            self.close()
            self._stage, self._began = stage, time.perf_counter()
            if sys.stderr.isatty():
                form = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} elapsed, {remaining} left"
                self._bar = tqdm(total=1.0, desc=stage, bar_format=form, leave=False)
            else:
                print(f"{stage} …", file=sys.stderr, flush=True)
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        if done >= 1:
            self.close()
            print(f"{stage}: {time.perf_counter() - self._began:.1f} s", file=sys.stderr, flush=True)
            self._stage = ""

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
