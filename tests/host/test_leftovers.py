"""Where temporary files go."""

from __future__ import annotations

import os
import tempfile

import pytest

from potr_cl.errors import UsageError
from potr_cl.host.leftovers import place_for_temporary_files, temporary_folder


@pytest.fixture(autouse=True)
def _as_in_a_new_process(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", None)


@pytest.mark.skipif(os.name != "posix", reason="Windows finds its folder otherwise")
def test_no_file_is_tried_in_the_folder_for_temporary_files(tmp_path, monkeypatch):
    """A signal between the making of such a file and its removal would leave it behind."""

    def tried() -> str:
        raise AssertionError("a file was made for a trial")

    monkeypatch.setattr(tempfile, "gettempdir", tried)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert place_for_temporary_files() == str(tmp_path)
    with temporary_folder() as name:
        assert [str(each) for each in tmp_path.iterdir()] == [name]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_none_is_passed_over(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path / "none"))
    monkeypatch.setenv("TEMP", str(tmp_path))
    assert place_for_temporary_files() == tempfile.gettempdir() == str(tmp_path)


def test_no_folder_for_temporary_files_is_one_line(monkeypatch):
    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.mkdir", full)
    with pytest.raises(UsageError, match="No space left on device: make room there"), temporary_folder():
        pass
