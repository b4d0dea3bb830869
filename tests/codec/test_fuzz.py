"""Mutated files: never a crash, a hang, or memory taken on a lie."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def fuzz(count: int, seed: int) -> None:
    command = [sys.executable, "-m", "tests.codec.fuzz_decoder", str(count), str(seed)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    outcome = json.loads(result.stdout)
    assert outcome["refused"] + outcome["decoded"] == count
    # Both kinds must occur, else the mutations test nothing.
    assert outcome["refused"] > count // 10
    assert outcome["decoded"] > count // 100
    assert outcome["growth"] <= 3 * outcome["honest"] + (256 << 20)


def test_some_mutated_files():
    fuzz(1500, 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_many_mutated_files(seed):
    fuzz(6000, seed)
