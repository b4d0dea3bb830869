"""How much memory is left, of the machine and of a container."""

from __future__ import annotations

from pathlib import Path

import pytest

from potr_cl.host import mapped as module
from potr_cl.host.mapped import memory_left


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="not Linux")
def test_of_this_machine():
    assert 1 << 20 < memory_left() < 1 << 50


@pytest.mark.parametrize(
    ("most", "taken", "left"), [("max", "5", 2 << 30), (f"{1 << 30}", "1000", (1 << 30) - 1000), ("10", "20", 0)]
)
def test_of_a_container(most, taken, left, tmp_path, monkeypatch):
    for name, content in (("meminfo", "MemFree: 1 kB\nMemAvailable: 2097152 kB\n"), ("max", most), ("taken", taken)):
        (tmp_path / name).write_text(content)
    monkeypatch.setattr(module, "_SYSTEM", tmp_path / "meminfo")
    monkeypatch.setattr(module, "_GROUPS", ((tmp_path / "max", tmp_path / "taken"), (tmp_path / "no", tmp_path / "no")))
    assert memory_left() == left


def test_where_the_system_does_not_say(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_SYSTEM", tmp_path / "none")
    assert memory_left() == 0
