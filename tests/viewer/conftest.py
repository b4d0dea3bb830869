"""A viewer to look at."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import potr_cl


@pytest.fixture(scope="module")
def viewer(data: Path) -> Iterator[Any]:
    pytest.importorskip("viser", reason="the extra view is not installed")
    with potr_cl.view(data / "plush_excerpt.ply", cameras=data / "plush_excerpt_cameras.json") as viewer:
        yield viewer
