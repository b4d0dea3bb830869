"""Results that cannot be written where they are wanted are kept elsewhere."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from potr_cl.errors import PotrError, UsageError, WriteError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.rescue import replacing_or_keeping, written_or_kept


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The folder for temporary files and the home folder."""
    for name, variable in (("temporary", "TMPDIR"), ("home", "HOME")):
        (tmp_path / name).mkdir()
        monkeypatch.setenv(variable, str(tmp_path / name))
    return tmp_path / "temporary", tmp_path / "home"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system with little room."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no file system can be mounted here")
    yield folder
    # Lazily: whoever looks at all that is mounted may be in it for a moment.
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def told_place(message: str) -> Path:
    found = re.search(r"the result is kept as '(.*?)': move it", message)
    assert found, message
    return Path(found[1])


def write_into_nowhere(target: Path, content: bytes) -> None:
    """Its folder is removed while the content is made."""
    with replacing_or_keeping(target) as file:
        shutil.rmtree(target.parent)
        file.write(content)


def test_a_folder_that_is_gone(tmp_path: Path, places: tuple[Path, Path]) -> None:
    (tmp_path / "gone").mkdir()
    target = tmp_path / "gone" / "scene.potr"
    with pytest.raises(WriteError, match=r"scene\.potr': the folder '.*gone' is gone; the result is kept") as caught:
        write_into_nowhere(target, b"precious")
    assert caught.value.exit_code == 1
    kept = told_place(str(caught.value))
    assert kept.read_bytes() == b"precious"
    assert kept.name == "scene.potr"
    assert kept.parent.parent == places[0]
    assert stat.S_IMODE(kept.parent.stat().st_mode) == 0o700
    assert [each.name for each in places[0].iterdir()] == [kept.parent.name]
    assert list(places[1].iterdir()) == []


def test_a_full_disk(small_disk: Path, places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder for temporary files is as full: the home folder takes what was made."""
    monkeypatch.setenv("TMPDIR", str(small_disk))
    content = bytes(range(256)) * 1000
    with pytest.raises(WriteError, match="No space left on device; the result is kept") as caught:  # noqa: SIM117
        with replacing_or_keeping(small_disk / "scene.potr") as file:
            file.write(content)
    kept = told_place(str(caught.value))
    assert kept.read_bytes() == content
    assert kept.parent.parent == places[1]
    assert list(small_disk.iterdir()) == []


def test_what_several_calls_write(tmp_path: Path, places: tuple[Path, Path]) -> None:
    """A writer that makes its own files is called again."""

    def write(path: Path) -> None:
        for name in (path.name, "beside.webp"):
            with replacing(path.with_name(name)) as file:
                file.write(name.encode())

    with pytest.raises(WriteError, match=r"'.*missing' does not exist; the result is kept") as caught:
        written_or_kept(tmp_path / "missing" / "meta.json", write)
    kept = told_place(str(caught.value))
    assert {each.name: each.read_text() for each in kept.parent.iterdir()} == {
        "meta.json": "meta.json",
        "beside.webp": "beside.webp",
    }


def test_a_folder_that_has_come_where_the_file_belongs(tmp_path: Path, places: tuple[Path, Path]) -> None:
    def write(path: Path) -> None:
        with replacing(path) as file:
            file.write(b"precious")

    (tmp_path / "scene.ply").mkdir()
    with pytest.raises(WriteError, match="it is a directory; give the name of a file; the result is kept") as caught:
        written_or_kept(tmp_path / "scene.ply", write)
    assert told_place(str(caught.value)).read_bytes() == b"precious"


def test_no_room_anywhere(tmp_path: Path, places: tuple[Path, Path]) -> None:
    """Then the error says so, and nothing is left."""

    def write(path: Path) -> None:
        with replacing(path) as file:
            file.write(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(WriteError, match="No space left on device; the result is lost: there is no room") as caught:
        written_or_kept(tmp_path / "scene.potr", write)
    assert all(str(place) in str(caught.value) for place in places)
    assert [list(place.iterdir()) for place in places] == [[], []]
    assert not (tmp_path / "scene.potr").exists()


def test_nothing_is_kept_of_what_fails_itself(tmp_path: Path, places: tuple[Path, Path]) -> None:
    (tmp_path / "other").mkdir()

    def fail(error: Exception) -> None:
        with replacing_or_keeping(tmp_path / "scene.potr") as file:
            if isinstance(error, WriteError):  # of another file, after the content was handed over
                file.write(b"good")
            raise error

    for error in (PotrError("no reader takes it"), WriteError("page", str(tmp_path / "page.html")), ValueError("x")):
        with pytest.raises(type(error)) as caught:
            fail(error)
        assert "kept" not in str(caught.value)
    with pytest.raises(UsageError, match=r"nowhere' does not exist$"):  # noqa: SIM117
        with replacing_or_keeping(tmp_path / "nowhere" / "scene.potr"):
            raise AssertionError("told before anything is made")
    assert [list(place.iterdir()) for place in places] == [[], []]


def test_an_error_of_another_file_is_not_told_of_this_one(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "scene.potr"):
        (tmp_path / "photograph.png").read_bytes()
    assert list(tmp_path.iterdir()) == []
