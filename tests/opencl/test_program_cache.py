"""Programs that are kept on the disk: whatever lies there stops no build, and nothing is loaded that is damaged."""

from __future__ import annotations

import linecache
import os
import subprocess
import sys
from pathlib import Path

import pyopencl as cl
import pytest

from potr_cl.opencl import program_cache
from potr_cl.opencl.cache_folder import cache_folder
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices

ROOT = Path(__file__).parents[2]
#: Opens the device that would be chosen, and builds a program for it.
PROGRAM = """
from potr_cl.opencl.device import Device
Device().program("opencl/probe.cl", LANES=1)
print("built")
"""
SOURCE = "kernel void nothing(global int *out) { out[0] = 1; }"


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """The folder, in an empty place."""
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_: str(tmp_path / "cache"))
    folder = program_cache.folder()
    assert folder is not None
    return folder


@pytest.fixture
def context() -> cl.Context:
    """Of a device whose driver keeps no programs itself."""
    infos = [info for info in list_devices() if not program_cache.has_src_build_cache(info.handle)]
    if not infos:
        pytest.skip("nothing is kept of these drivers' programs")
    return cl.Context([infos[0].handle])


def flipped(content: bytes) -> bytes:
    return content[:-9] + bytes([content[-9] ^ 16]) + content[-8:]


@pytest.mark.parametrize("damage", [flipped, lambda content: content[:100], lambda content: b"", lambda content: None])
def test_a_damaged_program_is_built_anew(cache, context, damage, monkeypatch):
    options = ["-cl-std=CL1.2"]
    program_cache.built(context, SOURCE, options)
    (path,) = cache.iterdir()
    content = path.read_bytes()
    sources = watch_sources(monkeypatch)
    program_cache.built(context, SOURCE, options)
    assert not sources
    damaged = damage(content)
    path.unlink()
    path.mkdir() if damaged is None else path.write_bytes(damaged)
    kernel = program_cache.built(context, SOURCE, options).nothing
    assert sources == [SOURCE]
    assert kernel.num_args == 1
    if damaged is not None:
        assert path.read_bytes()[32:]
        program_cache.built(context, SOURCE, options)
        assert sources == [SOURCE]  # what it was replaced by is whole


def watch_sources(monkeypatch) -> list[str]:
    """What is built from source from now on."""
    sources: list[str] = []
    create = cl.Program.__init__

    def watched(self, context, arg1, *others) -> None:
        if isinstance(arg1, str):
            sources.append(arg1)
        create(self, context, arg1, *others)

    monkeypatch.setattr(cl.Program, "__init__", watched)
    return sources


def test_what_another_processor_computes_with_is_not_loaded(cache, context, monkeypatch):
    """Machines that share a home can have processors of one name and other instructions."""
    program_cache.built(context, SOURCE, [])
    monkeypatch.setenv("CL_CONFIG_CPU_TARGET_ARCH", "corei7")
    program_cache.built(context, SOURCE, [])
    assert len(list(cache.iterdir())) == 2


def test_opening_devices_leaves_nothing_behind():
    """But what pyopencl generates to call a kernel, which it keeps the source of, once a kernel."""
    Device().shared_kernel("opencl/fill.cl", "fill")
    known = len(linecache.cache)
    for _ in range(3):
        Device().shared_kernel("opencl/fill.cl", "fill")
    assert len(linecache.cache) == known


@pytest.mark.skipif(os.name != "posix", reason="folders have no such owners")
def test_a_folder_that_others_can_write_to_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_: str(tmp_path / "cache"))
    folder = cache_folder("some")
    assert folder is not None
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o770)
    assert cache_folder("some") is None
    folder.rmdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(0o700)
    folder.symlink_to(elsewhere)
    assert cache_folder("some") is None
    folder.unlink()
    assert cache_folder("some") is not None
    tmp_path.chmod(0o777)  # whoever likes can put another folder "cache" there
    assert cache_folder("some") is None
    tmp_path.chmod(0o1777)
    assert cache_folder("some") is not None
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert cache_folder("some") is None


@pytest.mark.skipif(os.name != "posix", reason="the cache lies elsewhere")
def test_a_device_opens_where_there_is_no_cache(tmp_path):
    """A home that cannot be written, as in containers."""
    (tmp_path / "file").touch()
    opened(tmp_path / "file" / "folder")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="the cache lies elsewhere")
def test_a_device_opens_whatever_lies_in_pyopencls_caches(tmp_path):
    """A database that was cut short, and one that is another process's."""
    opened(tmp_path)
    names = {"pdict-v5-pyopencl-invoker-cache-v42-nano-" + ".".join(map(str, sys.version_info)) + ".sqlite"}
    names |= {path.name for path in tmp_path.rglob("*.sqlite")}
    (tmp_path / "pytools").mkdir(exist_ok=True)
    for name in names:
        (tmp_path / "pytools" / name).write_bytes(b"SQLite format 3\0" + b"damaged" * 100)
    opened(tmp_path)


def opened(cache: Path) -> None:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "POCL_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "built\n", "")
