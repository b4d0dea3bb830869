"""Make the golden files of the versions of the format that are written, 1, 3 and 4; those of version 2 stay.

    python -m tools.make.golden_files

Writes tests/data/golden_vN_NAME.potr and has the tests' independent decoder write the values that they must yield for
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

from potr_cl.codec.blocks.encoder import code_blocks
from potr_cl.codec.blocks.geometry import GeometryOfBlocks, quantise
from potr_cl.codec.blocks.splitting import blocks_of
from potr_cl.codec.quantize import HyperParameters
from potr_cl.model.scene import MIP_SPLATTING_LOW_PASS, Scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tests.reference.scenes import random_scene, ring_of_cameras

DATA = Path(__file__).parents[2] / "tests" / "data"
KEEP = EncodeOptions.for_preset("paper", prune=False, compact=False)


def _with_means(scene: Scene, means: np.ndarray) -> Scene:
    return Scene(means.astype(np.float32), scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh)


def in_blocks(scene: Scene, most_a_block: int) -> bytes:
    """A scene in blocks of so few splats, each with steps of colours of its own."""
    parameters = HyperParameters.from_quality(0.5, "best")
    geometry = quantise(scene, parameters, ring_of_cameras(8), rows=blocks_of(scene.means, most_a_block))
    geometry = geometry.with_steps(np.exp(np.random.default_rng(3).normal(size=len(scene))))
    assert isinstance(geometry, GeometryOfBlocks)
    return b"".join(code_blocks(scene, geometry, b'{"q":0.5}').pieces)


def main() -> None:
    rng = np.random.default_rng(1)
    cameras = ring_of_cameras(8)
    deep = np.vstack([rng.normal(size=(39, 3)) * 1e-6, [[1e6, 1e6, 1e6]]])
    coincident = random_scene(60, 2, seed=3).subset(np.r_[np.arange(60), np.arange(20), [5, 5]])
    still = random_scene(50, 3, seed=8)
    still.sh[:, 4:] = 0
    scenes = {
        "degree3_cameras": encode(random_scene(200, 3, seed=1), cameras, KEEP),
        "degree1_npz": encode(random_scene(80, 1, seed=2), None, KEEP.changed(q=0.8, code={"entropy": "npz"})),
        "degree2_coincident": encode(coincident, None, KEEP.changed(q=0.2)),
        "degree0_one_splat": encode(random_scene(1, 0, seed=4), None, KEEP),
        "degree0_deep": encode(_with_means(random_scene(40, 0, seed=5), deep), None, KEEP.changed(q=1.0)),
        "degree0_all_coincident": encode(
            _with_means(random_scene(30, 0, seed=6), np.full((30, 3), 0.7)),
            cameras,
            KEEP,
        ),
        "degree3_zero_bands": encode(still, cameras, KEEP.changed(q=0.0)),
        "degree0_wide_integers": encode(
            random_scene(30, 0, seed=9, extent=1e3), None, KEEP.with_parameters(sf_scale=1e8, sf_sh=1e6)
        ),
    }
    best, fast = (EncodeOptions.for_preset(preset, prune=False, compact=False) for preset in ("best", "fast"))
    many = random_scene(1500, 3, seed=11)
    many.sh[:, 1:] *= np.random.default_rng(2).random((1500, 15, 1)) < 0.3
    scenes |= {
        "degree3_steps": encode(many, cameras, best),
        "degree1_fine": encode(random_scene(1000, 1, seed=12), None, best.changed(q=1.0)),
        "degree3_zstd": encode(random_scene(300, 3, seed=13), cameras, fast),
        "degree2_coincident_balanced": encode(coincident, None, best),
        "degree0_one_splat_balanced": encode(random_scene(1, 0, seed=14), None, best),
        "degree0_deep_balanced": encode(_with_means(random_scene(40, 0, seed=15), deep), None, best),
    }
    small = random_scene(120, 1, seed=16)
    sharper = dataclasses.replace(small, antialiased=True, low_pass=MIP_SPLATTING_LOW_PASS)
    scenes |= {
        "degree1_antialiased": encode(small.rendered(True), cameras, KEEP),
        "degree1_antialiased_balanced": encode(small.rendered(True), cameras, fast),
        "degree1_mip_splatting": encode(sharper, cameras, best),
    }
    scenes |= {
        "degree0_two_bundles": encode(random_scene(8500, 0, seed=17), None, best.changed(q=0.0)),
        "degree0_wide_integers_balanced": encode(
            random_scene(400, 0, seed=18, extent=1e3), None, best.with_parameters(sf_scale=1e8, sf_dc=1e6)
        ),
    }
    files = {name: b"".join(encoded.pieces) for name, encoded in scenes.items()}
    files["degree2_blocks"] = in_blocks(random_scene(900, 2, seed=19), 250)
    files["degree1_antialiased_blocks"] = in_blocks(random_scene(40, 1, seed=20).rendered(True), 39)
    for name, data in files.items():
        version = int.from_bytes(data[8:10], "little")
        path = DATA / f"golden_v{version}_{name}.potr"
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
