"""Arrays in temporary files: where they lie, what a full disk does, and how much memory is left."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl.errors import PotrError
from potr_cl.formats import load_scene
from potr_cl.host import mapped
from potr_cl.host.threads import in_background
from tests.reference.scenes import random_scene

linux = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="looks at /proc")


def in_a_file(array: np.ndarray) -> bool:
    """Whether an array's first byte lies in a mapped file."""
    place = array.__array_interface__["data"][0]
    for line in Path("/proc/self/maps").read_text().splitlines():
        first, last = (int(part, 16) for part in line.split()[0].split("-"))
        if first <= place < last:
            return len(line.split()) > 5 and line.split()[5].startswith("/")
    raise AssertionError("the array lies nowhere")


@linux
def test_an_array_lies_in_a_file_without_a_name(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    array = mapped.mapped((3, 50_000), np.float32, "numbers")
    assert array.shape == (3, 50_000)
    assert not array.any()
    array[:] = 7
    assert in_a_file(array)
    assert not list(tmp_path.iterdir())


@linux
def test_only_large_arrays_and_only_where_memory_is_bounded():
    def place(nbytes):
        return in_a_file(mapped.array((nbytes,), np.uint8, "bytes"))

    assert not place(10_000_000)
    with mapped.bounded(64_000_000):
        assert place(1_000_001)
        with mapped.bounded(None):
            assert place(1_000_001)
        with mapped.bounded(1_280_000_000):
            assert not place(1_000_001)
    assert not place(10_000_000)


@pytest.mark.parametrize("kind", ["numbers", "mask"])
def test_rows_are_those_that_numpy_takes(kind):
    values = np.random.default_rng(0).random((1000, 4, 3)).astype(np.float32)
    mask = np.random.default_rng(1).random(1000) < 0.3
    numbers = mask if kind == "mask" else np.flatnonzero(mask)[::-1]
    assert mapped.rows(values, numbers, "numbers") is None
    with mapped.bounded(1000):
        assert np.array_equal(mapped.rows(values, numbers, "numbers"), values[numbers])
        assert np.array_equal(mapped.rows(values, None, "numbers"), values)


@linux
@linux
def test_a_bound_holds_for_what_goes_on_in_the_background():
    with mapped.bounded(64_000_000):
        assert in_a_file(in_background(mapped.array, (1_000_001,), np.uint8, "bytes").result())


def test_a_scene_that_is_read_and_what_is_taken_of_it(tmp_path):
    scene = random_scene(500, 3)
    potr_cl.save(scene, tmp_path / "scene.ply")
    with mapped.bounded(1_000_000):
        read = load_scene(tmp_path / "scene.ply")
        part = read.subset(np.arange(0, 500)[::-1])
        assert in_a_file(read.sh)
        assert in_a_file(part.sh)
    assert read == scene
    assert part == scene[::-1]


@pytest.mark.slow
def test_a_file_is_the_same_wherever_arrays_lie(plush_excerpt, plush_excerpt_cameras, tmp_path, monkeypatch):
    potr_cl.save(plush_excerpt, tmp_path / "scene.ply")
    choices, files = {"preset": "fast", "iterations": 2, "memory": 0.25}, []
    for part in (1e9, 1e-9):
        monkeypatch.setattr(mapped, "_PART", part)
        files.append(potr_cl.encode(tmp_path / "scene.ply", plush_excerpt_cameras[:4], **choices).data)
    assert files[0] == files[1]


@linux
def test_a_folder_without_room_is_an_error_of_one_line():
    """And not the end of the process, as a page without room would be."""
    with pytest.raises(PotrError, match=re.escape("no room for 4611686018.4 GB of numbers")) as error:
        mapped.mapped((1 << 62,), np.uint8, "numbers")
    assert "TMPDIR" in str(error.value)
    assert "\n" not in str(error.value)


@linux
def test_a_full_disk_is_told_before_anything_is_written(tmp_path):
    """A file system of a limited size is not at hand: a limit on files stands for it."""
    code = (
        "import resource, signal, numpy as np\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))\n"
        "from potr_cl.host.mapped import mapped\n"
        "try:\n    mapped((1 << 21,), np.uint8, 'numbers')\n"
        "except Exception as error:\n    print(type(error).__name__, error)\n"
    )
    # -B: compiled modules that it leaves would be cut off as well, and stop whoever imports them next.
    done = subprocess.run(
        [sys.executable, "-B", "-c", code], capture_output=True, text=True, env={**os.environ, "TMPDIR": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PotrError no room for 0.0 GB of numbers")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def full(monkeypatch):
    """Makes a disk that has room for so many files."""
    if not hasattr(os, "posix_fallocate"):
        pytest.skip("the system takes no room beforehand")
    takes, calls = os.posix_fallocate, []

    def make(files):
        def room(descriptor, offset, nbytes):
            calls.append(nbytes)
            if len(calls) > files:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            takes(descriptor, offset, nbytes)

        monkeypatch.setattr(os, "posix_fallocate", room)
        return calls

    return make


@linux
@pytest.mark.parametrize(("left", "first"), [(1 << 62, True), (5_000_000, False)])
def test_what_finds_no_room_is_an_error_where_the_work_begins_or_there_is_no_memory(
    left, first, full, monkeypatch, caplog
):
    full(0)
    monkeypatch.setattr(mapped, "memory_left", lambda: left)
    with mapped.bounded(1_000_000), pytest.raises(PotrError, match=r"no room for 0\.0 GB of numbers"):
        mapped.array((1_000_000,), np.float32, "numbers", first)
    assert caplog.text == ""


@linux
def test_what_finds_no_room_later_is_kept_in_memory_where_there_is_plenty(full, monkeypatch, caplog):
    full(0)
    monkeypatch.setattr(mapped, "memory_left", lambda: 1 << 62)
    with mapped.bounded(1_000_000):
        array = mapped.array((1_000_000,), np.float32, "numbers", False)
        assert array.shape == (1_000_000,)
        assert not in_a_file(array)
        mapped.array((1_000_000,), np.float32, "others")
    assert len(caplog.records) == 1  # it is said once
    assert "no room for 0.0 GB of numbers" in caplog.text
    assert "it and what follows takes memory beyond --memory now" in caplog.text


def test_an_encode_whose_disk_is_full_after_the_scene_was_read_ends_well(
    full, plush_excerpt, plush_excerpt_cameras, tmp_path, monkeypatch, caplog
):
    potr_cl.save(plush_excerpt, tmp_path / "scene.ply")
    monkeypatch.setattr(mapped, "_PART", 1e-9)
    given = (tmp_path / "scene.ply", plush_excerpt_cameras[:2])
    choices = {"preset": "fast", "iterations": 1, "memory": 0.25}
    wanted = potr_cl.encode(*given, **choices).data
    calls = full(1)
    monkeypatch.setattr(mapped, "memory_left", lambda: 1 << 40)
    assert potr_cl.encode(*given, **choices).data == wanted
    assert len(calls) > 1
    assert "no room for" in caplog.text


@linux
def test_memory_that_is_left_of_this_machine():
    assert 1 << 20 < mapped.memory_left() < 1 << 50


@pytest.mark.parametrize(
    ("most", "taken", "left"), [("max", "5", 2 << 30), (f"{1 << 30}", "1000", (1 << 30) - 1000), ("10", "20", 0)]
)
def test_memory_that_is_left_of_a_container(most, taken, left, tmp_path, monkeypatch):
    for name, content in (("meminfo", "MemFree: 1 kB\nMemAvailable: 2097152 kB\n"), ("max", most), ("taken", taken)):
        (tmp_path / name).write_text(content)
    monkeypatch.setattr(mapped, "_SYSTEM", tmp_path / "meminfo")
    monkeypatch.setattr(mapped, "_GROUPS", ((tmp_path / "max", tmp_path / "taken"), (tmp_path / "no", tmp_path / "no")))
    assert mapped.memory_left() == left


def test_where_the_system_does_not_say(tmp_path, monkeypatch):
    monkeypatch.setattr(mapped, "_SYSTEM", tmp_path / "none")
    assert mapped.memory_left() == 0
