"""A viewer on the excerpt, and Chromium, headless, to look at it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import potr_cl

#: Where Chromium is, if it has another name than systems give it.
CHROMIUM_VARIABLE = "POTR_CL_CHROMIUM"


@pytest.fixture(scope="session")
def ladder(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    """The folder of a ladder of the excerpt: three qualities, no views, so that it takes no time."""
    pytest.importorskip("viser", reason="the extra view is not installed")
    folder = tmp_path_factory.mktemp("ladder")
    potr_cl.encode_ladder(data / "plush_excerpt.ply", folder, [0, 0.5, 1], prune=False, refit=False, compact=False)
    return folder


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium of the system, driven by Playwright; WebGL is computed on the CPU."""
    library = pytest.importorskip("playwright.sync_api", reason="the extra browser is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = os.environ.get(CHROMIUM_VARIABLE) or next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no Chromium is installed, and {CHROMIUM_VARIABLE} names none")
    arguments = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        arguments.append("--no-sandbox")
    with library.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=path, args=arguments)
        yield chromium
        chromium.close()
