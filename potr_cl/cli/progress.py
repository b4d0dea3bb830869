"""Progress on the terminal, or in a log."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from potr_cl.cli.terminal import duration, is_quiet, is_terminal, note

if TYPE_CHECKING:
    from typing_extensions import Self

#: What is done is a part of the time: the mean tells more about what is left than the last moments do.
_BAR = "{desc}: {percentage:3.0f}% |{bar}| {elapsed} elapsed, {remaining} left"
_CLOCK = "{desc}: {elapsed} elapsed"
#: A stage that goes on from here has only something left to do that it cannot measure.
_NEARLY = 0.99
#: Part of a stage from which on its time tells that of the rest; and seconds of the rest that are worth a line.
_ENOUGH, _LONG = 0.05, 20


class Progress:
    """A bar with the time left on a terminal; elsewhere a line when a stage begins and one when it has ended.

    Each stage is told once, however often it is done: a search does some of them for every quality that it tries. A
    stage may be interrupted by another and go on. On a terminal the clock ticks whatever the work does, also between
    stages. To be used as a context; what an exception ends is not told as done.
    """

    def __init__(self) -> None:
        self._on_terminal = is_terminal(sys.stderr) and not is_quiet()
        self._stage = ""
        self._bar: Any = None
        self._began: dict[str, float] = {}
        self._told: set[str] = set()
        self._foretold: set[str] = set()
        #: The stage that has come to its end, and its line, while it is not certain that it does not go on.
        self._ended: tuple[str, str] | None = None
        self._lock = threading.RLock()
        self._closed = threading.Event()

    def __enter__(self) -> Self:
        if self._on_terminal:
            threading.Thread(target=self._tick, name="potr_cl clock", daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._closed.set()
        with self._lock:
            self._end_bar()
            if kind is None:
                self._tell_end()

    def __call__(self, stage: str, done: float) -> None:
        with self._lock:
            if stage != self._stage:
                self._end_bar()
                if self._ended is not None and self._ended[0] != stage:
                    self._tell_end()
                self._stage = stage
                self._begin(stage, done)
            if done >= 1:  # its bar goes as it is: a stage may have been interrupted
                self._end_bar()
                if stage in self._began:
                    self._ended = stage, f"{stage}: {time.perf_counter() - self._began[stage]:.1f} s"
                self._stage = ""
            elif self._bar is not None:
                self._bar.update(done - self._bar.n)
            elif stage in self._began and stage not in self._foretold and done >= _ENOUGH:
                self._foretell(stage, done)

    def _tick(self) -> None:
        while not self._closed.wait(1.0):
            with self._lock:
                if self._closed.is_set():
                    return
                if self._bar is None:
                    self._show("preparing" if not self._told else "working", _CLOCK)
                else:
                    self._bar.refresh()

    def _begin(self, stage: str, done: float) -> None:
        if self._on_terminal:
            self._show(stage, _BAR if done < _NEARLY else _CLOCK, done)
        elif stage not in self._began and stage not in self._told:
            note(f"{stage} …")
        if stage not in self._told:
            self._began.setdefault(stage, time.perf_counter())

    def _show(self, what: str, form: str, done: float = 0.0) -> None:
        self._bar = tqdm(total=1.0, initial=done, desc=what, bar_format=form, leave=False, smoothing=0)

    def _foretell(self, stage: str, done: float) -> None:
        """In a log: how long a stage will go on, if it goes on for long, by what its first part took."""
        left = (time.perf_counter() - self._began[stage]) * (1 - done) / done
        self._foretold.add(stage)
        if left >= _LONG:
            note(f"{stage}: about {duration(left)} left")

    def _tell_end(self) -> None:
        if self._ended is not None:
            stage, line = self._ended
            self._ended = None
            if self._began.pop(stage, None) is not None:
                self._told.add(stage)
                note(line)

    def _end_bar(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
