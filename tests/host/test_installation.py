"""What the messages say about a missing extra works wherever the package came from."""

from __future__ import annotations

import importlib.metadata

import pytest

from potr_cl.host.libraries import install_command


def test_what_is_installed_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """pip takes the extra's libraries from what is installed; tried with a package that is on no index."""
    monkeypatch.setattr(importlib.metadata, "version", lambda _name: "1.0")
    assert install_command("view") == 'pip install "potr_cl[view]"'


def test_a_clone_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_name: str) -> str:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "version", unknown)
    assert install_command("view") == 'pip install ".[view]" in a clone of the repository'
