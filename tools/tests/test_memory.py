"""Memory by stage: what of it is anonymous, and what lies in files."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tools.bench import memory

pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="asks the kernel of Linux")


def test_stages_and_their_peaks(tmp_path, monkeypatch, capsys):
    data = Path(__file__).parents[2] / "tests" / "data"
    result = tmp_path / "memory.json"
    monkeypatch.setattr(
        sys,
        "argv",
        ["memory", str(data / "plush_excerpt.ply"), str(data / "plush_excerpt_cameras.json"), "--views", "3",
         "--iterations", "2", "--preset", "fast", "--memory", "1", "--json", str(result)],
    )  # fmt: skip
    memory.main()
    rows = json.loads(result.read_text())["stages"]["rows"]
    assert {"read", "prune", "refit"} <= {row[0] for row in rows}
    for _, peak, anonymous, device, at_end, seconds, processors in rows:
        assert 0.01 < anonymous < peak * 1.05
        assert at_end < peak * 1.05
        assert device < peak
        assert seconds >= 0
        assert processors >= 0
    assert max(row[3] for row in rows) > 0, "nothing was on the device"
    assert "peak" in capsys.readouterr().out
