"""Make the golden files of the format.

    python -m tools.make.golden_files

Writes tests/data/golden_NAME.potr and has the tests' independent decoder write the values that they must yield for
ever. Refuses to touch a golden file that exists: those are never made again. What an encoder of another day makes
of the same scenes differs (metadata, steps, what the re-fit and the coder find), which is as it should be: an encoder
may change, what a decoder makes of an old file may not.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np

from potr_cl.codec.blocks import AnyGeometry, blocks_of, quantise
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import Level, code_levels
from potr_cl.codec.quantize import HyperParameters, Preset
from potr_cl.model.scene import MIP_SPLATTING_LOW_PASS, Scene
from tests.reference.scenes import random_scene, ring_of_cameras

DATA = Path(__file__).parents[2] / "tests" / "data"


def _with_means(scene: Scene, means: np.ndarray) -> Scene:
    return dataclasses.replace(scene, means=means.astype(np.float32))


def _geometry(scene: Scene, q: float, preset: Preset, most: int | None = None, **replaced: float | None) -> AnyGeometry:
    """Of a scene, in blocks of so few splats if a number is given; with steps of colours where there can be."""
    parameters = HyperParameters.from_quality(q, preset, **replaced)
    rows = None if most is None else blocks_of(scene.means, most)
    geometry = quantise(scene, parameters, ring_of_cameras(8), rows=rows)
    effects = np.exp(np.random.default_rng(3).normal(size=len(scene)))
    return geometry.with_steps(effects) if preset != "paper" else geometry


def _coded(*levels: Level, entropy: str = "bundles") -> bytes:
    return b"".join(code_levels(levels, b'{"q":0.5}', EntropyCoder(entropy)).pieces)


def _of(scene: Scene, q: float, preset: Preset, most: int | None = None, **replaced: float | None) -> bytes:
    geometry = _geometry(scene, q, preset, most, **replaced)
    return _coded(Level(scene, geometry), entropy="zstd" if preset == "paper" else "bundles")


def main() -> None:
    rng = np.random.default_rng(1)
    deep = np.vstack([rng.normal(size=(39, 3)) * 1e-6, [[1e6, 1e6, 1e6]]])
    coincident = random_scene(60, 2, seed=3).subset(np.r_[np.arange(60), np.arange(20), [5, 5]])
    still = random_scene(50, 3, seed=8)
    still.sh[:, 4:] = 0
    some = random_scene(700, 3, seed=11)
    some.sh[:, 1:] *= np.random.default_rng(2).random((700, 15, 1)) < 0.3
    small = random_scene(60, 1, seed=16)
    alike = random_scene(1, 0, seed=5).subset(np.zeros(8300, np.int64))
    alike = _with_means(alike, rng.normal(size=(8300, 3)).round(1))
    sharper = dataclasses.replace(small, antialiased=True, low_pass=MIP_SPLATTING_LOW_PASS)
    balanced = Level(small, _geometry(small, 0.9, "best"))
    half = random_scene(60, 1, seed=20)
    quarter = half.subset(np.arange(0, 60, 4))
    levels = Level(half, _geometry(half, 0.5, "best", 30)), Level(quarter, _geometry(quarter, 0.3, "best"), 0.25)
    files = {
        "paper_degree3": _of(random_scene(120, 3, seed=1), 0.5, "paper"),
        "paper_coincident": _of(coincident, 0.2, "paper"),
        "paper_deep": _of(_with_means(random_scene(40, 0, seed=5), deep), 1.0, "paper"),
        "paper_zero_degrees": _of(still, 0.0, "paper"),
        "paper_wide_integers": _of(random_scene(30, 0, seed=9), 0.5, "paper", sf_scale=1e8, sf_sh=1e6),
        "plain_balanced": _coded(balanced, entropy="zstd"),
        "bundles_degree3": _of(some, 0.5, "best"),
        "bundles_one_splat": _of(random_scene(1, 0, seed=4), 0.5, "best"),
        "bundles_coincident": _of(coincident, 0.5, "best"),
        "bundles_antialiased": _of(small.rendered(True), 0.5, "best"),
        "bundles_mip_splatting": _of(sharper, 0.5, "best"),
        "bundles_wide_integers": _of(random_scene(200, 0, seed=18), 0.5, "best", sf_scale=1e8, sf_dc=1e6),
        "bundles_two": _of(alike, 0.0, "best"),
        "blocks": _of(random_scene(300, 2, seed=19), 0.5, "best", 90),
        "levels": _coded(*levels),
    }
    for name, data in files.items():
        path = DATA / f"golden_{name}.potr"
        if path.exists():
            print(f"{path.name} exists: kept")
            continue
        path.write_bytes(data)
        # A program of its own: what the package's decoder makes of the file must not count here.
        command = [sys.executable, "-m", "tests.oracles.decoder", str(path), str(path.with_suffix(".npz"))]
        subprocess.run(command, cwd=DATA.parents[1], check=True)
        print(f"{path.name}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
