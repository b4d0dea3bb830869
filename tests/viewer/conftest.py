"""A ladder to look at."""

from __future__ import annotations

from pathlib import Path

import pytest

import potr_cl


@pytest.fixture(scope="session")
def ladder(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    """The folder of a ladder of the excerpt: three qualities, no views, so that it takes no time."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    folder = tmp_path_factory.mktemp("ladder")
    potr_cl.encode_ladder(data / "plush_excerpt.ply", folder, [0, 0.5, 1], prune=False, refit=False, compact=False)
    return folder
