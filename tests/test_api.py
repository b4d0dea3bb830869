"""The package's own names, and the README's example as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import potr_cl

ROOT = Path(__file__).parents[1]


def test_every_name_is_there():
    for name in potr_cl.__all__:
        assert getattr(potr_cl, name) is not None
    assert dir(potr_cl) == sorted(potr_cl.__all__)
    with pytest.raises(AttributeError, match="no attribute 'enocde'"):
        _ = potr_cl.enocde


def test_importing_is_cheap():
    script = "import sys, potr_cl; print(sorted({'numpy', 'pyopencl'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert out.stdout.strip() == "[]"


def test_the_example_in_the_readme_runs(tmp_path, data, monkeypatch, capsys):
    readme = (ROOT / "README.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", readme, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 1
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "data").symlink_to(data)
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks[0], "README.md", "exec"), {"__name__": "__main__"})
    out = capsys.readouterr().out
    assert re.search(r"1,\d{3} of 1,500 splats, \d\d,\d{3} bytes, PSNR [45]\d\.\d dB\n", out), out
    assert (tmp_path / "excerpt.potr").stat().st_size <= 20_000
