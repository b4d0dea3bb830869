"""Writing a file whole or not at all, and where temporary files go."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path

import pytest

from potr_cl.errors import PotrError, UsageError, WriteError
from potr_cl.host import atomic_write
from potr_cl.host.atomic_write import check_place, replacing
from potr_cl.host.leftovers import place_for_temporary_files, temporary_folder


def _write_half_then_raise(target: Path, failure: BaseException) -> None:
    with replacing(target) as file:
        file.write(b"half")
        raise failure


def test_writes_a_new_file_with_the_umask_and_replaces_it_with_its_permissions(tmp_path):
    target = tmp_path / ("x" * 255)  # as long as the file system allows
    old = os.umask(0o027)
    try:
        with replacing(target) as file:
            file.write(b"head")
            file.write(b"body")
            file.seek(0)
            file.write(b"HE")
    finally:
        os.umask(old)
    assert target.read_bytes() == b"HEadbody"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    target.chmod(0o604)
    with replacing(str(target)) as file:
        file.write(b"new")
        assert target.read_bytes() == b"HEadbody"
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o604
    assert os.listdir(tmp_path) == [target.name]


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), ValueError("x"), SystemExit(3)])
def test_a_failing_block_leaves_everything_as_it_was(tmp_path, failure):
    target = tmp_path / "out.bin"
    target.write_bytes(b"old")
    with pytest.raises(type(failure)):
        _write_half_then_raise(target, failure)
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_disk_full_is_one_clear_line(tmp_path):
    target = tmp_path / "out.bin"
    with pytest.raises(PotrError, match=r"cannot write '.*out\.bin': No space left on device") as caught:
        _write_half_then_raise(target, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert caught.value.exit_code == 1
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_disk_full_while_closing(tmp_path):
    """The buffered bytes meet the full disk only when the file is closed."""

    def write():
        with replacing(tmp_path / "out.bin") as file:
            full = os.open("/dev/full", os.O_WRONLY)
            os.dup2(full, file.fileno())
            os.close(full)
            file.write(b"buffered")

    with pytest.raises(PotrError, match="No space left"):
        write()
    assert os.listdir(tmp_path) == []


def test_a_symbolic_link_is_followed(tmp_path):
    (tmp_path / "real.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to("real.bin")
    with replacing(tmp_path / "link.bin") as file:
        file.write(b"new")
    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "real.bin").read_bytes() == b"new"


def test_refuses_what_is_no_file_before_the_work_and_leaves_no_trace(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").write_bytes(b"")
    before = tmp_path.stat().st_mtime_ns
    for path, message in [
        (tmp_path, "is a directory"),
        (tmp_path / "fifo", "not a regular file"),
        (Path(os.devnull), "not a regular file"),
        (tmp_path / "missing" / "out.bin", "folder '.*missing' does not exist$"),
        (tmp_path / "~" / "out.bin", "does not exist; '~' is not expanded here"),
        (tmp_path / "file" / "out.bin", "'.*file' is not a folder"),
        (tmp_path / ("x" * 300), "File name too long"),
    ]:
        with pytest.raises(UsageError, match=message):
            check_place(path)
        with pytest.raises(UsageError, match=message), replacing(path) as file:
            file.write(b"x")
    check_place(tmp_path / "file")
    check_place(tmp_path / "new")
    assert sorted(os.listdir(tmp_path)) == ["fifo", "file"]
    assert tmp_path.stat().st_mtime_ns == before


def test_two_that_write_one_file_at_once(tmp_path):
    """Both are whole; the last one wins; nothing else is left."""
    target = tmp_path / "out.bin"
    with replacing(target) as first:
        first.write(b"first" * 1000)
        with replacing(target) as second:
            second.write(b"second")
        assert target.read_bytes() == b"second"
    assert target.read_bytes() == b"first" * 1000
    assert os.listdir(tmp_path) == ["out.bin"]


def test_a_file_that_somebody_looks_at_is_tried_again(tmp_path, monkeypatch):
    """On Windows a virus scanner or an indexer has a new file open for a moment."""
    replace, refusals = Path.replace, [PermissionError(13, "Access is denied")] * 2

    def refused_at_first(path, target):
        if refusals:
            raise refusals.pop()
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", refused_at_first)
    monkeypatch.setattr(atomic_write, "_PAUSES", (0.0, 0.0))
    with replacing(tmp_path / "out.bin") as file:
        file.write(b"whole")
    assert (tmp_path / "out.bin").read_bytes() == b"whole"
    refusals += [PermissionError(13, "Access is denied")] * 3
    with pytest.raises(WriteError, match=r"out\.bin': Access is denied"), replacing(tmp_path / "out.bin") as file:
        file.write(b"another")
    assert (tmp_path / "out.bin").read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["out.bin"]


@pytest.mark.skipif(os.name != "posix", reason="Windows finds its folder otherwise")
def test_no_file_is_tried_in_the_folder_for_temporary_files(tmp_path, monkeypatch):
    """A signal between the making of such a file and its removal would leave it behind."""

    def tried():
        raise AssertionError("a file was made for a trial")

    monkeypatch.setattr(tempfile, "tempdir", None)  # as in a new process
    monkeypatch.setattr(tempfile, "gettempdir", tried)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert place_for_temporary_files() == str(tmp_path)
    with temporary_folder() as name:
        assert [str(each) for each in tmp_path.iterdir()] == [name]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_none_is_passed_over(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    monkeypatch.setenv("TEMP", str(tmp_path))
    assert place_for_temporary_files() == tempfile.gettempdir() == str(tmp_path)


def test_no_folder_for_temporary_files_is_one_line(monkeypatch):
    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.mkdir", full)
    with pytest.raises(UsageError, match="No space left on device: make room there"), temporary_folder():
        pass
