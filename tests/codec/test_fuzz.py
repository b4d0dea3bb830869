"""Mutated files: never a crash, a hang, or memory taken on a lie. In a process of its own, where these would show."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl.codec.container import EntropyCoder
from potr_cl.pipeline.encode import encode
from potr_cl.reference.scenes import random_scene, ring_of_cameras
from tests.cases.options import as_it_is

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> list[Path]:
    """A file of each kind: both versions, all coders, coincident splats, a single one."""
    coincident = random_scene(120, 1, seed=2).subset(np.r_[np.arange(120), np.arange(40), [3, 3]])
    encoded = [
        encode(random_scene(150, 3, seed=1), ring_of_cameras(6), as_it_is()),
        encode(coincident, None, as_it_is(entropy=EntropyCoder("npz"), q=0.3)),
        encode(random_scene(400, 0, seed=3), None, as_it_is(entropy=EntropyCoder("zstd", 1), q=1.0)),
        encode(random_scene(1, 0, seed=4), None, as_it_is()),
        encode(random_scene(1200, 2, seed=5), None, as_it_is("best")),
        encode(random_scene(200, 1, seed=6), ring_of_cameras(6), as_it_is("fast")),
    ]
    folder = tmp_path_factory.mktemp("fuzz")
    paths = [folder / f"{number}.potr" for number in range(len(encoded))]
    for path, each in zip(paths, encoded, strict=True):
        path.write_bytes(b"".join(each.pieces))
    return paths


def fuzz(files: list[Path], count: int, seed: int) -> None:
    command = [sys.executable, "-m", "tools.stress.fuzz", str(count), str(seed), *map(str, files)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    outcome = json.loads(result.stdout)
    assert outcome["refused"] + outcome["decoded"] == count
    # Both kinds must occur, else the mutations test nothing.
    assert outcome["refused"] > count // 10
    assert outcome["decoded"] > count // 100
    assert outcome["growth"] <= 3 * outcome["honest"] + (256 << 20)


def test_some_mutated_files(files):
    fuzz(files, 1500, 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_many_mutated_files(files, seed):
    fuzz(files, 6000, seed)
