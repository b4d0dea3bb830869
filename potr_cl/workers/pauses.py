"""How long those are left alone that were lost as they were met: :class:`Pauses`."""

from __future__ import annotations

#: The first pause, in looks at who has come; each that follows is twice as long, up to the last number of seconds.
_FIRST, _LONGEST = 1.0, 600.0


class Pauses:
    """Whom to ask again, and when: each time that somebody of a computer is lost, later.

    By computers and not by processes: one that Dask's nanny starts again has another address.

    Args:
        look: seconds between two looks at who has come.
    """

    def __init__(self, look: float) -> None:
        self._look = look
        self._until: dict[str, tuple[float, float]] = {}  # by computer: the time, and the pause

    def may_ask(self, host: str, now: float) -> bool:
        """Whether to ask somebody of a computer, at a time in seconds."""
        return host not in self._until or now >= self._until[host][0]

    def note_lost(self, host: str, now: float) -> bool:
        """Somebody was lost there as it was met; whether that is the first one."""
        before = self._until.get(host)
        pause = _FIRST * self._look if before is None else min(2 * before[1], _LONGEST)
        self._until[host] = now + pause, pause
        return before is None

    def note_met(self, host: str) -> None:
        """Somebody was met there: whoever is lost next is asked again soon."""
        self._until.pop(host, None)
