"""Wheels for all platforms from one: python -m tools.make.wheels [WHEEL] [-o dist] [--platform NAME …]

The compiled part of the codec is called through ctypes and knows nothing of Python, so Zig's C compiler (pip install
ziglang) builds it here for Linux, Windows and macOS, and each wheel is the given one (or one that pip makes of the
checkout) with another library and other tags. Nothing of it is run but what is for this machine: docs/install.md says
what was tried where.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import importlib.util
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from tools.make.native import ALWAYS, PLAIN, compile_by
from tools.results import ROOT

_FOLDER = "potr_cl/native"


@dataclass(frozen=True)
class Platform:
    """One that wheels are for.

    Attributes:
        target: what Zig calls it. tag: what pip calls it. library: the file that the package looks for there.
    """

    target: str
    tag: str
    library: str = "_library.abi3.so"


#: glibc 2.17 is that of manylinux2014; no older macOS has Python 3.10 and OpenCL on both kinds of Macs.
PLATFORMS = {
    "linux-x86_64": Platform("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64.manylinux2014_x86_64"),
    "linux-aarch64": Platform("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64.manylinux2014_aarch64"),
    "windows-x86_64": Platform("x86_64-windows-gnu", "win_amd64", "_library.pyd"),
    "macos-x86_64": Platform("x86_64-macos.11.0", "macosx_11_0_x86_64"),
    "macos-arm64": Platform("aarch64-macos.11.0", "macosx_11_0_arm64"),
}


def has_compiler() -> bool:
    """Whether Zig is here."""
    return importlib.util.find_spec("ziglang") is not None


def compiled(platform: Platform, folder: Path) -> bytes:
    """The library for a platform.

    Raises:
        SystemExit: the compiler refuses.
    """
    output = folder / platform.library
    options = [option for option in ALWAYS if option != "-fPIC" or "windows" not in platform.target]
    compile_by([sys.executable, "-m", "ziglang", "cc", "-target", platform.target], [*options, *PLAIN, "-s"], output)
    return output.read_bytes()


def wheel_for(platform: Platform, wheel: Path, output: Path) -> Path:
    """A wheel for a platform, made of one for another.

    Args:
        wheel: with or without a compiled part.
        output: folder that it is written to.
    """
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(wheel) as given:
        parts = {name: given.read(name) for name in given.namelist() if not name.startswith(f"{_FOLDER}/_library")}
        parts[f"{_FOLDER}/{platform.library}"] = compiled(platform, Path(folder))
    about = next(name for name in parts if name.endswith(".dist-info/WHEEL"))
    kept = [line for line in parts[about].decode().splitlines() if line and not line.startswith("Tag:")]
    tags = [f"Tag: py3-none-{tag}" for tag in platform.tag.split(".")]
    parts[about] = "\n".join([*kept, *tags, ""]).encode()
    record = about.replace("WHEEL", "RECORD")
    del parts[record]
    lines = [f"{name},sha256={_digest(content)},{len(content)}" for name, content in parts.items()]
    parts[record] = "\n".join([*lines, f"{record},,", ""]).encode()
    name, version = wheel.name.split("-")[:2]
    path = output / f"{name}-{version}-py3-none-{platform.tag}.whl"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for part, content in parts.items():
            # As old as the format goes: the same bytes whenever it is made.
            made.writestr(zipfile.ZipInfo(part), content, zipfile.ZIP_DEFLATED)
    return path


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path, nargs="?", help="default: pip makes one of the checkout")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", metavar="DIR")
    parser.add_argument("--platform", action="append", choices=list(PLATFORMS))
    args = parser.parse_args()
    if not has_compiler():
        sys.exit("there is no Zig: pip install ziglang")
    args.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        wheel = args.wheel
        if wheel is None:
            pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, str(ROOT)]
            subprocess.run(pip, check=True)
            wheel = next(Path(folder).glob("*.whl"))
        for name in args.platform or PLATFORMS:
            path = wheel_for(PLATFORMS[name], wheel, args.output)
            print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
