"""Programs that pyopencl keeps on the disk: what a killed process or a disk leaves there stops no build."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from potr_cl.opencl import program_cache

ROOT = Path(__file__).parents[2]
#: Opens the device that would be chosen, and builds a program for it.
PROGRAM = """
from potr_cl.opencl.device import Device
Device().program("opencl/probe.cl", LANES=1)
print("built")
"""


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """The folder, in an empty place."""
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_: str(tmp_path / "cache"))
    name = program_cache.folder()
    assert isinstance(name, str)
    return Path(name)


def test_an_old_lock_is_removed_at_once(cache, monkeypatch):
    monkeypatch.setattr(program_cache, "PATIENCE", 600.0)
    lock = cache / "lock"
    lock.touch()
    os.utime(lock, (1e9, 1e9))
    began = time.monotonic()
    assert program_cache.folder() == str(cache)
    assert not lock.exists()
    assert time.monotonic() - began < 300


def test_a_lock_that_stays_the_same_is_removed(cache, monkeypatch):
    monkeypatch.setattr(program_cache, "PATIENCE", 0.3)
    (cache / "lock").touch()
    program_cache.folder()
    assert not (cache / "lock").exists()


def test_a_lock_in_use_is_left_alone(cache, monkeypatch):
    """Another process gives it back and takes it again."""
    monkeypatch.setattr(program_cache, "PATIENCE", 300.0)
    lock = cache / "lock"
    lock.touch()
    before = lock.stat().st_mtime

    def take_again() -> None:
        time.sleep(0.2)
        lock.unlink()
        lock.touch()
        os.utime(lock, (before + 1, before + 1))

    other = threading.Thread(target=take_again)
    other.start()
    program_cache.folder()
    other.join()
    assert lock.exists()


@pytest.mark.skipif(os.name != "posix", reason="the cache lies elsewhere")
def test_a_device_opens_where_there_is_no_cache(tmp_path):
    """A home that cannot be written, as in containers."""
    (tmp_path / "file").touch()
    assert opened(tmp_path / "file" / "folder").stdout == "built\n"


@pytest.mark.skipif(os.name != "posix", reason="the cache lies elsewhere")
def test_a_device_opens_after_another_process_was_killed(tmp_path):
    """It had the lock of the cache in its hands."""
    assert opened(tmp_path).stdout == "built\n"
    kept = [path.parent for path in tmp_path.rglob("*/binary")]
    if not kept:
        pytest.skip("nothing is kept of this driver's programs")
    lock = kept[0].parent / "lock"
    lock.touch()
    os.utime(lock, (1e9, 1e9))
    # Were it left to pyopencl, the lock would still be there after a minute of waiting for it.
    assert opened(tmp_path).stdout == "built\n"
    assert not lock.exists()


def opened(cache: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "POCL_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done
