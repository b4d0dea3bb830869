"""What the messages say about a missing extra works wherever the package came from."""

from __future__ import annotations

import importlib.metadata

import pytest

from potr_cl.host.libraries import install_command

REQUIRES = [
    "numpy>=2.0",
    'intel-opencl-rt; ((sys_platform == "linux" and platform_machine == "x86_64")) and extra == "intel-cpu"',
    "intel-cmplr-lib-rt; (sys_platform == 'linux') and extra == 'intel-cpu'",
    'viser>=1.1; extra == "view"',
]


def test_the_libraries_are_named_and_not_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which is on no index."""
    monkeypatch.setattr(importlib.metadata, "requires", lambda _name: REQUIRES)
    assert install_command("view") == 'pip install "viser>=1.1"'
    assert install_command("intel-cpu") == 'pip install "intel-opencl-rt" "intel-cmplr-lib-rt"'


def test_a_clone_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_name: str) -> list[str]:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "requires", unknown)
    assert install_command("view") == 'pip install ".[view]" in a clone of the repository'
