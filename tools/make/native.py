"""Compile the native path (potr_cl/native) in the checkout, without installing the package.

    python -m tools.make.native [--sanitize] [-o FILE] [--compiler CC]

Without -o it goes where the package looks for it. ``pip install -e .`` does the same (setup.py); this needs nothing but
a C compiler. --sanitize builds one that finds what it does wrong by itself, for tools.stress.native: AddressSanitizer
and UndefinedBehaviorSanitizer.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import potr_cl.native

SOURCES = Path(potr_cl.native.__file__).parent
PLAIN = ["-O3"]
_SANITIZED = [
    "-O2", "-g", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fno-sanitize-recover=all",
    "-DPOTR_SANITIZED",
]  # fmt: skip
#: The same as those of setup.py.
ALWAYS = ["-std=c11", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-fPIC", "-shared"]


def compile_library(output: Path, sanitize: bool = False, compiler: str | None = None) -> None:
    """Compile the library for this machine.

    Raises:
        SystemExit: there is no compiler, or it refuses.
    """
    found = compiler or next(filter(shutil.which, ("cc", "gcc", "clang")), None)
    if found is None:
        sys.exit("there is no C compiler: install gcc or clang")
    compile_by([found], [*ALWAYS, *(_SANITIZED if sanitize else PLAIN)], output)


def compile_by(compiler: Sequence[str], options: Sequence[str], output: Path) -> None:
    """Compile all sources but the one that is for Python's build. Raises SystemExit if the compiler refuses."""
    sources = sorted(str(source) for source in SOURCES.glob("*.c") if source.name != "module.c")
    command = [*compiler, *options, *sources, "-lm", "-o", str(output)]
    if subprocess.run(command, check=False).returncode:
        sys.exit(f"failed: {' '.join(command)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=SOURCES / "_library.abi3.so")
    parser.add_argument("--sanitize", action="store_true")
    parser.add_argument("--compiler", metavar="CC", help="default: cc, gcc or clang, whichever there is")
    args = parser.parse_args()
    compile_library(args.output, args.sanitize, args.compiler)


if __name__ == "__main__":
    main()
