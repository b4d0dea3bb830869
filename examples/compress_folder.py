"""Compress every scene of a folder, folders in it included.

    python examples/compress_folder.py SCENES OUT --max-size 8MB

Beside a scene there may be its cameras, as COLMAP or the usual trainers leave them; else virtual ones are placed. What
is there already is left as it is, so that the script can be stopped and started again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import potr_cl
from potr_cl.opencl.device import Device


def cameras_beside(scene: Path) -> Path | None:
    """The cameras of a scene's folder, if it holds any that are read."""
    try:
        potr_cl.read_cameras(scene.parent)
    except potr_cl.UsageError:
        return None
    return scene.parent


def main() -> int:
    parser = argparse.ArgumentParser(description="Compress every .ply scene of a folder.")
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--max-size", help="of each file, such as 8MB; else quality 0.5")
    parser.add_argument("--preset", default="best", choices=("best", "smallest", "fast", "paper"))
    args = parser.parse_args()
    device = Device()  # opened once, so that its kernels are built once
    failed = 0
    for scene in sorted(args.scenes.rglob("*.ply")):
        target = (args.out / scene.relative_to(args.scenes)).with_suffix(".potr")
        if target.exists():
            print(f"{target}: is there already")
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            encoded = potr_cl.encode(
                scene, cameras_beside(scene), max_size=args.max_size, preset=args.preset, output=target, device=device
            )
        except potr_cl.PotrError as error:  # one line for people, which names the file
            print(f"{scene}: {error}", file=sys.stderr)
            failed += 1
        else:
            print(f"{target}: {encoded}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
