"""What several tests compute of the same arguments, computed once: :func:`once`."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from typing import Any


def once(function: Callable[..., Any], most: int) -> Callable[..., Any]:
    """A function that is not called again with equal arguments; the results of the last ones are kept."""
    known: dict[bytes, Any] = {}

    def known_or_made(*arguments: Any) -> Any:
        key = hashlib.sha256(pickle.dumps(arguments)).digest()
        known[key] = known.pop(key) if key in known else function(*arguments)
        while len(known) > most:
            del known[next(iter(known))]
        return known[key]

    return known_or_made
