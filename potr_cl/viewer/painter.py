"""The thread that makes all pictures (:class:`Painter`): nobody else uses the device.

While a visitor's camera moves it gets small pictures, when it stands one of full size. Visitors take turns. Between
pictures the views' losses are found. Without visitors nothing is done.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from potr_cl.errors import PotrError
from potr_cl.formats.images import to_8_bits
from potr_cl.plain_text import plain
from potr_cl.viewer.comparison import compared, under_photograph
from potr_cl.viewer.losses import Losses
from potr_cl.viewer.pace import Pace
from potr_cl.viewer.pose import camera_of
from potr_cl.viewer.session import Look, Session
from potr_cl.viewer.visitor import PAUSE, Shown, Visitor

T = TypeVar("T")

#: Seconds without any movement after which losses are found: nobody should feel that they are.
_QUIET = 0.6


class Painter:
    """Paints for all visitors of a session. Its methods may be called by any thread.

    Args:
        session: what is shown.
        losses: of the views.
        found_loss: called by the painter's thread when another view's loss is known.
    """

    def __init__(self, session: Session, losses: Losses, found_loss: Callable[[], None]) -> None:
        self._session = session
        self._losses = losses
        self._found_loss = found_loss
        self._visitors: dict[int, Visitor] = {}
        self._jobs: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="potr_cl painter", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, patience: float = 5.0) -> None:
        """End after the picture that is being made, and give the device's memory back.

        Args:
            patience: seconds to wait for that.
        """
        with self._changed:
            self._stopped = True
            self._changed.notify()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(patience)

    @property
    def visitors(self) -> list[Visitor]:
        """Those who are there."""
        with self._changed:
            return list(self._visitors.values())

    def enter(self, visitor: Visitor) -> None:
        """Paint for one more."""
        with self._changed:
            self._visitors[visitor.number] = visitor
            self._changed.notify()

    def leave(self, number: int) -> None:
        """Paint for one no longer."""
        with self._changed:
            self._visitors.pop(number, None)
            self._changed.notify()

    def wake(self, visitor: Visitor, look: bool = False) -> None:
        """A visitor's wishes have changed.

        Args:
            visitor: whose.
            look: whether what is rendered changes, and not only what is made of it.
        """
        with self._changed:
            visitor.stale_picture = True
            visitor.stale_look |= look
            self._changed.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Have something done by the painter's thread, before the next picture; it must not raise."""
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()

    def ask(self, work: Callable[[], T]) -> T | None:
        """Have the painter's thread find something out, and wait for it; None if the painter ends before.

        Raises:
            Whatever ``work`` raises.
        """
        answer: Future[T] = Future()

        def job() -> None:
            try:
                answer.set_result(work())
            except Exception as error:
                answer.set_exception(error)

        self.do(job)
        while self._thread.is_alive():
            with contextlib.suppress(TimeoutError):
                return answer.result(timeout=0.2)
        return answer.result() if answer.done() else None

    def all_anew(self) -> None:
        """Other scenes are shown: everything is to be rendered and judged again."""
        with self._changed:
            self._losses.begin(self._session.is_pair)
            for visitor in self._visitors.values():
                visitor.stale_look = visitor.stale_picture = True
                visitor.is_still = False
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                work = self._next()
                while work is None and not self._stopped:
                    self._changed.wait(self._until_something_is_due())
                    work = self._next()
                if self._stopped or work is None:
                    break
            work()
        self._session.close()

    def _next(self) -> Callable[[], None] | None:
        """What to do now, if anything."""
        if self._jobs:
            return self._jobs.popleft()
        now = time.monotonic()
        due = [v for v in self._visitors.values() if v.gaze is not None and _is_due(v, now)]
        if due:
            visitor = min(due, key=lambda v: v.painted)
            return lambda: self._paint(visitor)
        quiet = all(now - visitor.moved > _QUIET for visitor in self._visitors.values())
        if self._visitors and quiet and not self._losses.is_complete:
            return self._find_loss
        return None

    def _until_something_is_due(self) -> float | None:
        now = time.monotonic()
        waits = [max(v.moved + PAUSE - now, 0.0) + 0.005 for v in self._visitors.values() if v.gaze and not v.is_still]
        if self._visitors and not self._losses.is_complete:
            waits.append(_QUIET / 2)
        return min(waits, default=None)

    def _paint(self, visitor: Visitor) -> None:
        began = time.monotonic()
        gaze, moving = visitor.gaze, began - visitor.moved < PAUSE
        assert gaze is not None
        try:
            bare = visitor.look is not None and visitor.look.a is None and visitor.look.b is None
            if visitor.stale_look or not visitor.is_still or (bare and visitor.is_pictured):
                visitor.stale_look = visitor.stale_picture = False
                self._render(visitor, moving)
                # A still picture of where the camera was is none of where it is.
                visitor.is_still = not moving and visitor.gaze is gaze
            visitor.stale_picture = False
            self._compose(visitor)
            visitor.tell("")
        except PotrError as error:
            self._give_up(visitor, str(error))
        except MemoryError:
            self._give_up(visitor, "not enough memory for this picture: make the window smaller")
        except Exception as error:
            self._give_up(visitor, f"unforeseen {type(error).__name__}: {error}")
        visitor.painted = time.monotonic()
        if moving and visitor.look is not None and visitor.is_pictured:
            self._pace(visitor).took(visitor.painted - began)

    def _render(self, visitor: Visitor, moving: bool) -> None:
        gaze, is_pair = visitor.gaze, self._session.is_pair
        assert gaze is not None
        pace = self._pace(visitor)
        width, height = visitor.size()
        if is_pair and visitor.mode == "side by side":
            width = max(width // 2, 1)
        if moving:
            width, height = pace.size(width, height)
        figures = is_pair and (not moving or (pace.is_full and visitor.is_pictured))
        scenes = ("A", "B") if figures else visitor.needs(is_pair)
        visitor.look = self._session.look(camera_of(gaze, width, height), scenes, figures)

    def _compose(self, visitor: Visitor) -> None:
        look = visitor.look
        if look is not None and not visitor.is_pictured:
            visitor.show(Shown(None, visitor.is_still, look, 1))
            return
        if look is None or (look.a is None and look.b is None):
            return
        a, b = (look.b, look.a) if visitor.swapped else (look.a, look.b)
        factor = 1
        if a is not None and b is not None:
            picture, factor = compared(visitor.mode, a, b, visitor.divider, visitor.factor)
        else:
            only = a if a is not None else b
            assert only is not None
            picture = to_8_bits(only)
        number = visitor.view
        if visitor.fade > 0 and number is not None and self._losses.has_photograph(number) and _is_whole(visitor, look):
            if visitor.photograph is None or visitor.photograph[0] != number:
                visitor.photograph = (number, self._losses.photograph(number))
            photograph = visitor.photograph[1]
            picture = under_photograph(picture, look.camera, photograph, self._losses.views[number], visitor.fade)
        elif number is None:
            visitor.photograph = None
        visitor.show(Shown(picture, visitor.is_still, look, factor))

    def _give_up(self, visitor: Visitor, said: str) -> None:
        """Say what went wrong, and try no more until something changes."""
        visitor.look = None
        visitor.is_still, visitor.stale_look, visitor.stale_picture = True, False, False
        visitor.tell(plain(said))

    def _find_loss(self) -> None:
        try:
            self._losses.step(self._session)
        except PotrError as error:
            for visitor in self.visitors:
                visitor.tell(plain(error))
        self._found_loss()

    def _pace(self, visitor: Visitor) -> Pace:
        kind = "one" if not self._session.is_pair or len(visitor.needs(True)) == 1 else "two"
        return visitor.paces.setdefault(kind, Pace())


def _is_due(visitor: Visitor, now: float) -> bool:
    if visitor.stale_look or visitor.stale_picture:
        return True
    return not visitor.is_still and now - visitor.moved >= PAUSE


def _is_whole(visitor: Visitor, look: Look) -> bool:
    """Whether a photograph fits over the picture: not beside another one, nor over half of it."""
    return look.b is None or visitor.mode != "side by side"


def decibels(value: float | None) -> str:
    """A PSNR for people."""
    return "–" if value is None else "identical" if math.isinf(value) else f"{value:.2f} dB"
