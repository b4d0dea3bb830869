"""How much memory a process may still take before the system ends one: :func:`memory_left`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

_SYSTEM = Path("/proc/meminfo")
#: Of a container: what it may take and what it has taken, by version 2 and version 1 of Linux' control groups.
_GROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def memory_left() -> int:
    """Bytes of memory that are free, or that the system would free at once; 0 where it does not say (not Linux)."""
    left: int | None = None
    with suppress(OSError, ValueError, IndexError):
        for line in _SYSTEM.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                left = int(line.split()[1]) << 10
    if left is None:
        return 0
    for most, taken in _GROUPS:
        with suppress(OSError, ValueError):  # "max" is no number: there is no limit
            left = min(left, int(most.read_text()) - int(taken.read_text()))
    return max(left, 0)
