"""Make tests/data/foreign: the excerpt in the formats of another tool, to test that they are read as that tool means.

    python -m tools.make.foreign_files [--transform COMMAND]

COMMAND is splat-transform (npm install @playcanvas/splat-transform).
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
from pathlib import Path

DATA = Path(__file__).parents[2] / "tests" / "data"
#: File names and what the tool is told besides.
FILES: dict[str, list[str]] = {
    "version_3.spz": ["--spz-version", "3"],
    "version_4.spz": [],
    "degree_1.spz": ["--filter-harmonics", "1"],
    "degree_0.sog": ["--filter-harmonics", "0"],
    "degree_3.sog": [],
    "degree_3.compressed.ply": [],
    "degree_0.compressed.ply": ["--filter-harmonics", "0"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--transform", default="npx splat-transform", metavar="COMMAND")
    args = parser.parse_args()
    folder = DATA / "foreign"
    folder.mkdir(exist_ok=True)
    for name, options in FILES.items():
        command = [*shlex.split(args.transform), "-w", "-g", "cpu", str(DATA / "plush_excerpt.ply")]
        # Options before the output apply to the splats, options of the output anywhere.
        subprocess.run([*command, *options, str(folder / name)], check=True)


if __name__ == "__main__":
    main()
