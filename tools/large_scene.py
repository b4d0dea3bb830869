"""A scene of any size with the statistics of a real one: splats of a trained scene, drawn again with jitter.

python -m tools.large_scene SPLATS -o OUT.ply [--like SCENE.ply]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from potr_cl.formats import load_scene, ply
from potr_cl.scene import Scene

DEFAULT_SCENE = Path(__file__).parents[2] / "shared" / "scenes" / "plush" / "point_cloud.ply"
EXCERPT = Path(__file__).parents[1] / "tests" / "data" / "lego_excerpt.ply"


def large_scene(like: Scene, splats: int, seed: int = 0) -> Scene:
    """Splats drawn from ``like``, each moved by a normal deviate of its own size, scales and colours varied a little.

    The variation keeps the entropy coder from finding the copies.
    """
    rng = np.random.default_rng(seed)
    scene = like.subset(rng.integers(0, len(like), splats))
    means = scene.means + rng.normal(size=(splats, 3)).astype(np.float32) * np.exp(scene.log_scales)
    log_scales = scene.log_scales + rng.normal(0, 0.1, size=(splats, 3)).astype(np.float32)
    sh = scene.sh
    for m in range(sh.shape[1]):
        sh[:, m] += rng.laplace(0, 0.01, size=(splats, 3)).astype(np.float32)
    return Scene(means, log_scales, scene.quaternions, scene.opacity_logits, sh)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("splats", type=int)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--like", type=Path, default=DEFAULT_SCENE if DEFAULT_SCENE.exists() else EXCERPT)
    args = parser.parse_args()
    ply.save(args.output, large_scene(load_scene(args.like), args.splats))


if __name__ == "__main__":
    main()
