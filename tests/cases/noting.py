"""What objects of a class are made: :func:`noted`."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import pytest


def noted(monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str) -> list[Any]:
    """The objects that a module makes of a class that it knows by this name, from now on."""
    made: list[Any] = []
    kind: Any = getattr(module, name)

    class Noting(kind):
        def __init__(self, *args: Any, **named: Any) -> None:
            made.append(self)
            super().__init__(*args, **named)

    monkeypatch.setattr(module, name, Noting)
    return made
