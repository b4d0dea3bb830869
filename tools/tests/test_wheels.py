"""Wheels for platforms that are not here: each has the library that its tag promises, with every function."""

from __future__ import annotations

import base64
import csv
import hashlib
import re
import struct
import sys
import zipfile
from pathlib import Path
from platform import machine

import pytest

from potr_cl.native.declarations import _DECLARATIONS, declared
from tools.make import wheels
from tools.make.wheels import PLATFORMS, wheel_for

_ABOUT = "potr_cl-1.dist-info"


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """One for another machine, with a library that must not stay."""
    path = tmp_path / "potr_cl-1-cp310-abi3-linux_riscv64.whl"
    with zipfile.ZipFile(path, "w") as made:
        made.writestr("potr_cl/__init__.py", "")
        made.writestr("potr_cl/native/_library.abi3.so", "another's")
        made.writestr(f"{_ABOUT}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: cp310-abi3-linux_riscv64\n")
        made.writestr(f"{_ABOUT}/RECORD", "")
    return path


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def test_a_wheel_has_its_library_its_tags_and_its_record(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wheels, "compiled", lambda platform, folder: platform.target.encode())
    (tmp_path / "out").mkdir()
    for platform in PLATFORMS.values():
        path = wheel_for(platform, wheel, tmp_path / "out")
        assert path.name == f"potr_cl-1-py3-none-{platform.tag}.whl"
        parts = contents(path)
        libraries = [name for name in parts if "_library" in name]
        assert libraries == [f"potr_cl/native/{platform.library}"]
        assert parts[libraries[0]] == platform.target.encode()
        tags = re.findall(r"^Tag: (.*)$", parts[f"{_ABOUT}/WHEEL"].decode(), re.MULTILINE)
        assert tags == [f"py3-none-{tag}" for tag in platform.tag.split(".")]
        rows = {
            name: (digest, size) for name, digest, size in csv.reader(parts[f"{_ABOUT}/RECORD"].decode().splitlines())
        }
        assert rows.keys() == parts.keys()
        for name in parts.keys() - {f"{_ABOUT}/RECORD"}:
            digest = base64.urlsafe_b64encode(hashlib.sha256(parts[name]).digest()).rstrip(b"=").decode()
            assert rows[name] == (f"sha256={digest}", str(len(parts[name])))


def kind(library: bytes) -> str:
    """What system and processor a library is for, by its head."""
    if library.startswith(b"\x7fELF"):
        return {62: "linux-x86_64", 183: "linux-aarch64"}[struct.unpack_from("<H", library, 18)[0]]
    if library.startswith(b"MZ"):
        head = struct.unpack_from("<I", library, 0x3C)[0]
        assert library[head : head + 4] == b"PE\0\0"
        return {0x8664: "windows-x86_64"}[struct.unpack_from("<H", library, head + 4)[0]]
    assert library.startswith(b"\xcf\xfa\xed\xfe")
    return {0x01000007: "macos-x86_64", 0x0100000C: "macos-arm64"}[struct.unpack_from("<I", library, 4)[0]]


def is_signed(library: bytes) -> bool:
    """Whether a Mach-O library has a signature, without which Macs with Apple silicon load none."""
    count, place = struct.unpack_from("<I", library, 16)[0], 32
    commands = []
    for _ in range(count):
        command, size = struct.unpack_from("<II", library, place)
        commands.append(command)
        place += size
    return 0x1D in commands  # LC_CODE_SIGNATURE


@pytest.mark.slow
@pytest.mark.skipif(not wheels.has_compiler(), reason="ziglang is not installed")
@pytest.mark.parametrize("name", PLATFORMS)
def test_the_library_is_for_the_platform(name: str, tmp_path: Path) -> None:
    library = wheels.compiled(PLATFORMS[name], tmp_path)
    assert kind(library) == name
    assert [function for function in _DECLARATIONS if function.encode() not in library] == []
    needed = [tuple(map(int, found.split(b"."))) for found in re.findall(rb"GLIBC_(\d+\.\d+)", library)]
    assert max(needed, default=(0,)) <= (2, 17)
    assert name != "macos-arm64" or is_signed(library)
    if name == f"{sys.platform}-{machine()}":
        declared(str(tmp_path / PLATFORMS[name].library))
