"""A scene of any size with the statistics of a real one: splats of a trained scene, drawn again with jitter.

    python -m tools.make.large_scene SPLATS -o OUT.ply [--like SCENE.ply] [--split]

tools.make.city makes large scenes that have views, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import Scene
from tools.workloads import SCENES, TEST_DATA

_EXCERPT = TEST_DATA / "plush_excerpt.ply"


def default_scene() -> Path:
    """Plush, or the excerpt of it where that is not there."""
    whole = SCENES / "plush" / "point_cloud.ply"
    return whole if whole.exists() else _EXCERPT


def cameras_beside(scene: Path) -> Path:
    """The cameras of a scene's file."""
    return scene.with_name("plush_excerpt_cameras.json" if scene == _EXCERPT else "cameras.json")


def large_scene(like: Scene, splats: int, seed: int = 0, split: bool = False) -> Scene:
    """Splats drawn from ``like``, each moved by a normal deviate of its own size, scales and colours varied a little.

    The variation keeps the entropy coder from finding the copies. With ``split`` they are made smaller by the root of
    the number of copies, as a trainer's splitting does: together they cover about what one splat did.
    """
    rng = np.random.default_rng(seed)
    scene = like.subset(rng.integers(0, len(like), splats))
    means = scene.means + rng.normal(size=(splats, 3)).astype(np.float32) * np.exp(scene.log_scales)
    log_scales = scene.log_scales + rng.normal(0, 0.1, size=(splats, 3)).astype(np.float32)
    if split:
        log_scales -= np.float32(0.5 * np.log(max(splats / len(like), 1)))
    sh = scene.sh
    for m in range(sh.shape[1]):
        sh[:, m] += rng.laplace(0, 0.01, size=(splats, 3)).astype(np.float32)
    return Scene(means, log_scales, scene.quaternions, scene.opacity_logits, sh)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splats", type=int)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--like", type=Path, default=default_scene())
    parser.add_argument("--split", action="store_true", help="smaller splats, as many cover what one did")
    args = parser.parse_args()
    ply.save(args.output, large_scene(load_scene(args.like), args.splats, split=args.split))


if __name__ == "__main__":
    main()
