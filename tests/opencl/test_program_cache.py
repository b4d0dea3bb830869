"""Programs that are kept on the disk: nothing there stops a build, nothing damaged is loaded; what is loaded ahead."""

from __future__ import annotations

import json
import linecache
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl import program_cache
from potr_cl.opencl.cache_folder import cache_folder
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.opencl.program_cache import Foresight

ROOT = Path(__file__).parents[2]
#: Opens the device that would be chosen, and builds a program for it.
PROGRAM = """
from potr_cl.opencl.device import Device
Device().program("opencl/probe.cl", LANES=1)
print("built")
"""
NEEDED = ("raster/columns.cl", ())
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
    options, sources, create = ["-cl-std=CL1.2"], [], cl.Program.__init__

    def watched(self, context, arg1, *others) -> None:
        if isinstance(arg1, str):
            sources.append(arg1)
        create(self, context, arg1, *others)

    monkeypatch.setattr(cl.Program, "__init__", watched)
    for _ in range(2):
        program_cache.built(context, SOURCE, options)
    assert sources == [SOURCE]
    (path,) = cache.iterdir()
    damaged = damage(path.read_bytes())
    path.unlink()
    path.mkdir() if damaged is None else path.write_bytes(damaged)
    assert program_cache.built(context, SOURCE, options).nothing.num_args == 1
    assert sources == [SOURCE] * 2
    if damaged is not None:
        assert path.read_bytes()[32:]
        program_cache.built(context, SOURCE, options)
        assert sources == [SOURCE] * 2  # what it was replaced by is whole


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


# What was needed before is loaded before it is asked for --------------------------------------------------------------


def no_builds(monkeypatch) -> None:
    def refused(*_):
        raise cl.RuntimeError("nothing can be built")

    monkeypatch.setattr(cl, "Program", refused)


@pytest.fixture
def needed(cache) -> Device:
    """A device that has needed a program; what it was is noted."""
    device = Device()
    device.prepare_for("a test").result()
    device.program("raster/columns.cl")
    return device


def test_what_was_needed_once_is_there_the_next_time(needed, monkeypatch):
    second, other = Device(), Device()
    second.prepare_for("a test").result()
    other.prepare_for("another test").result()
    no_builds(monkeypatch)
    assert second.kernel("raster/columns.cl", "columns").name == "columns"
    with pytest.raises(DeviceError):
        other.program("raster/columns.cl")


@pytest.mark.parametrize("always", [False, True])
def test_warnings_that_become_errors_while_programs_are_loaded_stop_nobody(needed, monkeypatch, always):
    """As where the main thread runs in a block of its own: filters are the whole process's. What is always interrupted
    is loaded by who needs it: what is loaded ahead raises nothing."""
    second, build, warned = Device(), cl.Program.build, []

    def chatting(program, *arguments, **choices):
        if always or not warned:
            warned.append(1)
            warnings.simplefilter("error")
        warnings.warn("a compiler's words", cl.CompilerWarning, stacklevel=1)
        return build(program, *arguments, **choices)

    with warnings.catch_warnings(), monkeypatch.context() as patch:
        patch.setattr(cl.Program, "build", chatting)
        second.prepare_for("a test").result()
        assert warned
    if not always:
        no_builds(monkeypatch)
    assert second.kernel("raster/columns.cl", "columns").name == "columns"


def test_experiments_are_not_noted(cache):
    device = Device(macros={"ANY": 1})
    device.prepare_for("a test").result()
    device.program("raster/columns.cl")
    assert not list(cache.rglob("needed-*.json"))


def test_what_cannot_be_built_any_more_stops_nobody(needed, cache):
    (note,) = cache.rglob("needed-*.json")
    note.write_text(json.dumps([["raster/gone.cl", []], ["opencl/probe.cl", [["LANES", "no number"]]], NEEDED]))
    again = Device()
    again.prepare_for("a test").result()
    assert again.kernel("raster/columns.cl", "columns").name == "columns"


@pytest.mark.parametrize("content", ["", "{}", "[1]", '[["../../x.cl", []]]', '[["a/b.cl"]]', '[["a/b.cl", 3]]', "\0"])
def test_a_damaged_note_is_as_good_as_none(tmp_path, content):
    Foresight(tmp_path, "a test").note(NEEDED)
    (note,) = tmp_path.iterdir()
    note.write_text(content)
    assert Foresight(tmp_path, "a test").programs == []


def test_a_folder_that_cannot_be_written_stops_nobody(tmp_path):
    foresight = Foresight(tmp_path / "gone" / "further", "a test")
    foresight.note(NEEDED)
    assert foresight.programs == [NEEDED]


def test_notes_end_somewhere(tmp_path):
    foresight = Foresight(tmp_path, "a test")
    for number in range(100):
        foresight.note((f"a/b{number}.cl", (("X", "1"),)))
    kept = Foresight(tmp_path, "a test").programs
    assert kept == foresight.programs
    assert len(kept) == 64
