"""Build the npm package of the decoder for browsers (web/), and the viewer of pages.

    python -m tools.make.web [--only-wasm]

The package goes to web/dist, the viewer to potr_cl/formats/scenes/page.html.

The C is compiled to WebAssembly by Zig's C compiler, which PyPI has (pip install ziglang), or by clang, wasi-libc and
lld of Debian, whichever is there. All else is npm's: web/package-lock.json says what is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import potr_cl.native

WEB = Path(__file__).parents[2] / "web"
_NATIVE = Path(potr_cl.native.__file__).parent
#: bundles_tokens.c is part of web/src/tokens.c.
_SOURCES = ("bundles", "bundles_values", "steps", "octree", "quantise")
_ALWAYS = (
    "--target=wasm32-wasi", "-mexec-model=reactor", "-std=c11", "-flto", "-ffp-contract=off", "-fno-math-errno",
    "-fvisibility=hidden", "-fno-stack-protector", "-mbulk-memory", "-mnontrapping-fptoint", "-msign-ext",
    "-Wl,--no-entry", "-Wl,--gc-sections", "-Wl,--strip-all", "-Wl,--export=__heap_base",
)  # fmt: skip
#: The build that takes every file, as small as it can be; and the one for speed.
BUILDS = {"potr.wasm": ("-Oz", "-DPOTR_SMALL", "-DPOTR_WIDE_LEVELS"), "potr-simd.wasm": ("-O3", "-msimd128")}


def compiler() -> list[str]:
    """The command of a compiler for WebAssembly.

    Raises:
        SystemExit: there is none.
    """
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc"]
    if shutil.which("clang") and shutil.which("wasm-ld") and Path("/usr/include/wasm32-wasi").exists():
        return ["clang", "--sysroot=/usr", "-isystem", "/usr/include/wasm32-wasi", "-L/usr/lib/wasm32-wasi"]
    sys.exit("there is no compiler for WebAssembly: pip install ziglang, or apt install clang lld wasi-libc")


def compile_wasm(folder: Path) -> None:
    """Compile all :data:`BUILDS` to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    sources = [*sorted((WEB / "src").glob("*.c")), *(_NATIVE / f"{name}.c" for name in _SOURCES)]
    for name, options in BUILDS.items():
        _run([*compiler(), *_ALWAYS, *options, f"-I{_NATIVE}", *map(str, sources), "-o", str(folder / name)])


def _run(command: Sequence[str], folder: Path | None = None) -> None:
    if subprocess.run(command, cwd=folder, check=False).returncode:
        sys.exit(f"failed: {' '.join(command)}")


def lacking() -> str | None:
    """What building all of it needs and this machine has not; None where it has it."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        return "there is no npm: install Node 20 or newer"
    try:
        compiler()
    except SystemExit as lack:
        return str(lack)
    return None


def build() -> None:
    """Build the package and the viewer of pages.

    Raises:
        SystemExit: something is lacking, or refuses.
    """
    if lack := lacking():
        sys.exit(lack)
    compile_wasm(WEB / "dist")
    npm = str(shutil.which("npm"))
    if not (WEB / "node_modules").exists():
        _run([npm, "ci", "--ignore-scripts"], WEB)
    for script in ("check", "build"):
        _run([npm, "run", "--silent", script], WEB)
    print(f"built {WEB / 'dist'} and the viewer of pages: encode -o scene.html works now")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only-wasm", action="store_true", help="compile the C, and leave npm alone")
    args = parser.parse_args()
    if args.only_wasm:
        compile_wasm(WEB / "dist")
    else:
        build()


if __name__ == "__main__":
    main()
