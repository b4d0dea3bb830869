"""How size and quality go together for one scene, as CSV.

python examples/quality_ladder.py SCENE CAMERAS > ladder.csv
"""

from __future__ import annotations

import argparse

import potr_cl
from potr_cl.opencl.device import Device


def main() -> None:
    parser = argparse.ArgumentParser(description="Encode a scene at several qualities and judge each.")
    parser.add_argument("scene")
    parser.add_argument("cameras")
    parser.add_argument("--preset", default="best", choices=("best", "smallest", "fast", "paper"))
    parser.add_argument("--steps", type=int, default=5, help="qualities from 0 to 1")
    args = parser.parse_args()
    device = Device()
    # Read once; the functions take objects as well as paths.
    scene, cameras = potr_cl.read_scene(args.scene), potr_cl.read_cameras(args.cameras)
    print("q,bytes,splats,psnr,ssim")
    for step in range(args.steps):
        q = step / max(args.steps - 1, 1)
        encoded = potr_cl.encode(scene, cameras, q=q, preset=args.preset, device=device)
        lost = potr_cl.compare(scene, encoded, cameras, device=device)  # on test views, which encoding never looks at
        print(f"{q:g},{encoded.nbytes},{len(encoded.order)},{lost.psnr:.3f},{lost.ssim:.5f}", flush=True)


if __name__ == "__main__":
    main()
