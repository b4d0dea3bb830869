"""Make docs/images/plush.jpg, the README's picture: the worst test view of plush, before and after.

    python -m tools.make.readme_picture SCENES [--encoded FILE.potr]

SCENES holds the folder ``plush`` with point_cloud.ply and cameras.json: of our scenes the one whose photographs are
under a free licence. The scene is encoded as ``encode`` does by itself, unless FILE.potr has that already.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from PIL import Image

from potr_cl.cli import main as potr_cl

_PICTURE = Path(__file__).parents[2] / "docs" / "images" / "plush.jpg"
#: Of the three pictures together.
_WIDTH = 1188


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder that holds plush")
    parser.add_argument("--encoded", type=Path, metavar="FILE.potr", help="the scene, encoded already")
    args = parser.parse_args()
    scene, cameras = (args.scenes / "plush" / name for name in ("point_cloud.ply", "cameras.json"))
    with tempfile.TemporaryDirectory() as folder:
        encoded, picture = args.encoded or Path(folder, "plush.potr"), Path(folder, "plush.png")
        if args.encoded is None:
            _call("encode", scene, "-o", encoded, "--cameras", cameras)
        _call("compare", scene, encoded, "--cameras", cameras, "-o", picture)
        with Image.open(picture) as image:
            size = (_WIDTH, round(image.height * _WIDTH / image.width))
            image.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(_PICTURE, quality=88, optimize=True)
    print(f"{_PICTURE}: {_PICTURE.stat().st_size} bytes")


def _call(*arguments: object) -> None:
    code = potr_cl([str(argument) for argument in arguments])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
