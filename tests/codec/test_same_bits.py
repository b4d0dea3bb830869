"""A file decodes to the same bits on every processor, for ever."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np
import pytest
from numpy._core import _multiarray_umath as umath

from potr_cl.codec import quantize
from potr_cl.codec.bundles.streams import SIZES
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.codec.quantize import HyperParameters
from tests.cases.decoded_bits import decoded_bits
from tests.reference.scenes import random_scene

ROOT = Path(__file__).parents[2]
DISPATCHED = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]


def nearest_logarithm(value: float) -> np.float32:
    """By decimal arithmetic with far more digits than a tie could need."""
    with localcontext() as context:
        context.prec = 60
        exact = Decimal(value).ln()
        near = np.float32(float(exact))
        around = [np.nextafter(near, np.float32(-np.inf)), near, np.nextafter(near, np.float32(np.inf))]
        return min(around, key=lambda candidate: abs(Decimal(float(candidate)) - exact))


def test_the_logarithm_is_the_nearest_there_is():
    rng = np.random.default_rng(5)
    values = np.exp2(rng.uniform(-33, 76, 1500)).astype(np.float32)
    near_one = 1 + rng.uniform(-1e-3, 1e-3, 300).astype(np.float32)
    hard = [float.fromhex("0x1.bacb4ap+25"), 1, 2.0**-33, np.sqrt(0.5), np.nextafter(np.float32(1), np.float32(0))]
    values = np.concatenate([values, near_one, np.array(hard, np.float32)]).astype(np.float32)
    expected = np.array([nearest_logarithm(float(value)) for value in values])
    assert np.array_equal(natural_logarithm(values), expected)


@pytest.mark.parametrize("factor", [0.001, 1.0, 2001.0, 1e9])
def test_levels_beyond_the_tables_are_as_those_in_them(factor):
    """Whatever else is in a block: a table, a larger table, or none."""
    levels = np.array([0, 1, 2, 255, 256, 257, 65535, 65536, 65537, 1 << 20, 1 << 40], np.int64)
    for dequantise in (quantize.dequantize_scales, quantize.dequantize_opacities):
        together = dequantise(levels, factor)
        assert together.dtype == np.float32
        assert np.array_equal(together, np.concatenate([dequantise(level[None], factor) for level in levels]))
    scales = np.maximum(levels.astype(np.float32), np.float32(0.25)) / np.float32(factor)
    assert np.array_equal(quantize.dequantize_scales(levels, factor), [nearest_logarithm(float(s)) for s in scales])


def test_sizes_of_tokens_are_exact():
    """⌊16 log2(1 + m) + ½⌋ by whole numbers: (1 + m)³² lies between 2^(2k − 1) and 2^(2k + 1)."""
    for signed, sizes in SIZES.items():
        for token, size in enumerate(sizes.tolist()):
            least = token if token < 128 else (4 + token % 4) << (5 + (token - 128) // 4)
            power = (1 + ((least + 1) // 2 if signed else least)) ** 32
            assert 1 << max(2 * size - 1, 0) <= power < 1 << (2 * size + 1)


@pytest.mark.skipif(not DISPATCHED, reason="NumPy has no code of its own for this processor")
def test_other_vector_instructions_give_the_same_bits(tmp_path):
    """NumPy's logarithm differs between them, so this fails where it is used."""
    scene = random_scene(5000, 1, seed=3)
    for preset in ("paper", "best"):
        for q in (0.2, 0.9):
            pieces = code_scene(scene, HyperParameters.from_quality(q, preset), entropy=EntropyCoder("zstd", 1)).pieces
            (tmp_path / f"{preset}_{q}.potr").write_bytes(b"".join(pieces))
    paths = sorted(tmp_path.iterdir())
    here = {path.stem: decoded_bits(path) for path in paths}
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(DISPATCHED)}
    program = (
        "from numpy._core import _multiarray_umath as umath\n"
        "assert not any(umath.__cpu_features__[name] for name in umath.__cpu_dispatch__)\n"
        "import runpy, sys\n"
        "runpy.run_module('tests.cases.decoded_bits', run_name='__main__', alter_sys=True)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, *map(str, paths)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == here
