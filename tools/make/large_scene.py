"""A scene of any size with the statistics of a real one: splats of a trained scene, drawn again with jitter.

    python -m tools.make.large_scene SPLATS -o OUT.ply [--like SCENE.ply] [--split] [--cameras OUT.json] [options]

The views are those of the cameras.json beside the scene, drawn again with jitter too.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.scenes import ply
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import Scene

DEFAULT_SCENE = Path(__file__).parents[3] / "shared" / "scenes" / "plush" / "point_cloud.ply"
EXCERPT = Path(__file__).parents[2] / "tests" / "data" / "plush_excerpt.ply"


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


def more_views(like: Sequence[Camera], views: int, width: int, height: int, seed: int = 0) -> list[dict[str, Any]]:
    """The entries of a cameras.json: ``views`` training views with the field of view and the whereabouts of ``like``.

    Each is one of ``like``, moved and turned a little, so that no two are the same.
    """
    rng = np.random.default_rng(seed)
    spread = camera_centres(like).std(axis=0).mean()
    entries = []
    for number in range(views):
        camera = like[number * len(like) // views]
        angles = rng.normal(0, 0.02, 3)
        skew = np.array([[0, -angles[2], angles[1]], [angles[2], 0, -angles[0]], [-angles[1], angles[0], 0]])
        turn = np.linalg.qr(np.eye(3) + skew)[0]
        turn *= np.sign(np.diag(turn))
        camera_centre = camera_centres([camera])[0] + rng.normal(0, 0.02 * spread, 3)
        entries.append(
            {
                "id": number,
                "img_name": f"view_{number:04}",
                "width": width,
                "height": height,
                "position": camera_centre.tolist(),
                "rotation": (camera.rotation.T @ turn).tolist(),
                "fx": camera.fx * width / camera.width,
                "fy": camera.fx * width / camera.width,
                "split": "train",
            }
        )
    return entries


def cameras_beside(scene: Path) -> Path:
    """The cameras of a scene's file."""
    return scene.with_name("plush_excerpt_cameras.json" if scene.resolve() == EXCERPT.resolve() else "cameras.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splats", type=int)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--like", type=Path, default=DEFAULT_SCENE if DEFAULT_SCENE.exists() else EXCERPT)
    parser.add_argument("--split", action="store_true", help="smaller splats, as many cover what one did")
    parser.add_argument("--cameras", type=Path, metavar="OUT.json")
    parser.add_argument("--views", type=int, default=200, metavar="N")
    parser.add_argument("--size", default="1600x1064", metavar="WxH")
    args = parser.parse_args()
    if args.cameras is not None:
        width, height = map(int, args.size.split("x"))
        args.cameras.write_text(
            json.dumps(more_views(load_cameras(cameras_beside(args.like)), args.views, width, height))
        )
    ply.save(args.output, large_scene(load_scene(args.like), args.splats, split=args.split))


if __name__ == "__main__":
    main()
