"""What an installation takes, and where it works: sizes on disk, and wheels by platform and Python.

    python -m tools.bench.install --json docs/benchmarks/results/install.json

The package and each of its extras for users are installed into new folders. For the wheels, the index is asked whether
all core dependencies have some; nothing is installed. Both need a package index.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterable, Sequence
from pathlib import Path

from tools.results import Cell, Column, Results

ROOT = Path(__file__).parents[2]
#: Those that users may want; the others are for developers.
EXTRAS = ("intel-cpu", "pocl", "convert", "view", "completion")
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
#: Platforms as people call them, and the tags that pip accepts wheels for there, of systems that are still maintained.
PLATFORMS = {
    "Linux x86-64": ["manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"],
    "Linux aarch64": ["manylinux_2_28_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64"],
    "macOS 14, Apple silicon": ["macosx_14_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"],
    "macOS 11, Apple silicon": ["macosx_11_0_arm64"],
    "macOS 14, Intel": ["macosx_14_0_x86_64", "macosx_10_15_x86_64", "macosx_10_13_x86_64", "macosx_10_9_x86_64"],
    "Windows x86-64": ["win_amd64"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also keep the results here")
    results = Results(None, parser.parse_args().json)
    title = f"What an installation takes on disk, Linux x86-64, Python {sys.version_info[0]}.{sys.version_info[1]}"
    size = results.table("sizes", title, Column(""), Column("size", "MB", ".0f"), Column("most of it"))
    for row in sizes():
        size.add(*row)
    title = "Whether all core dependencies have wheels, by Python"
    there = results.table("wheels", title, Column("platform"), *map(Column, PYTHONS))
    for cells in wheels():
        there.add(*cells)


def sizes() -> Iterable[list[Cell]]:
    """A row for the core and for each extra, which says what it takes besides: MB (10⁶ bytes), the largest parts."""
    core = _installed("")
    yield ["the package without extras", _megabytes(core), _largest(core)]
    for extra in EXTRAS:
        whole = _installed(f"[{extra}]")
        more = {name: size - core.get(name, 0) for name, size in whole.items() if size > core.get(name, 0)}
        yield [f"extra `{extra}`, besides", _megabytes(more), _largest(more)]


def _installed(extra: str) -> dict[str, int]:
    """Bytes of each folder or file that pip installs, compiled modules included, as a new environment has them."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, symlinks=True)
        _pip("--python", f"{folder}/bin/python", "install", f"{ROOT}{extra}")
        found: dict[str, int] = {}
        for path in Path(folder).rglob("*"):
            if path.is_file() and not path.is_symlink():
                parts = path.relative_to(folder).parts
                # lib/pythonX.Y/site-packages/NAME, or what a wheel puts beside it, as Intel's do.
                name = parts[3] if parts[2:3] == ("site-packages",) and len(parts) > 3 else "/".join(parts[:2])
                found[name] = found.get(name, 0) + path.stat().st_size
        return found


def _megabytes(parts: dict[str, int]) -> float:
    return round(sum(parts.values()) / 1e6, 1)


def _largest(parts: dict[str, int]) -> str:
    names = sorted(parts, key=lambda name: -parts[name])[:4]
    return ", ".join(f"{name} {parts[name] / 1e6:.0f}" for name in names if parts[name] >= 1e6)


def wheels() -> Iterable[list[Cell]]:
    """A row for each platform: for each Python "yes", or what there is no wheel of."""
    for name, tags in PLATFORMS.items():
        yield [name, *(_resolves(python, tags, "win" in tags[0]) for python in PYTHONS)]


def _resolves(python: str, tags: Sequence[str], windows: bool) -> str:
    # pip judges markers by the machine that it runs on, so what Windows alone needs is named here.
    needed = [*_core(), *(["colorama"] if windows else [])]
    missing = []
    command = ["install", "--dry-run", "--ignore-installed", "--target", "unused", "--only-binary", ":all:"]
    command += ["--python-version", python, *(part for tag in tags for part in ("--platform", tag))]
    if _pip(*command, *needed, check=False) == 0:
        return "yes"
    for each in needed:
        if _pip(*command, each, check=False):
            missing.append(re.split(r"[<>=;\[ ]", each)[0])
    return f"no {', '.join(missing)}"


def _core() -> list[str]:
    """The dependencies that pyproject.toml names for everyone."""
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    listed = re.search(r"^dependencies = \[\n(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    assert listed is not None
    return re.findall(r'^\s*"([^"]+)"', listed[1], re.MULTILINE)


def _pip(*arguments: str, check: bool = True) -> int:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if check and done.returncode:
        sys.exit(done.stderr.strip())
    return done.returncode


if __name__ == "__main__":
    main()
