"""The package's own names."""

from __future__ import annotations

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
