"""Files that somebody writes while they are read."""

from __future__ import annotations

import io
import math
import os
import shutil
import threading
from pathlib import Path

import pytest

import potr_cl
from potr_cl.api.inputs import coded_scene
from potr_cl.codec.decoder import open_file
from potr_cl.errors import DataError
from potr_cl.formats import load_cameras
from potr_cl.host.inputs import unchanged
from tests.cli.calls import cameras_json

SAID = r"was changed while it was read: wait until the program that writes it has finished"


@pytest.fixture
def written_while_read(monkeypatch):
    """Has a byte of a file written once it has been opened, before each time that it is read or before the first."""

    def prepare(path, times=math.inf):
        plainly, written = Path.open, []

        class Disturbed(io.BufferedReader):
            def read(self, size=-1, /):
                if len(written) < times:
                    written.append(size)
                    with plainly(path, "r+b") as writer:
                        writer.seek(-1, os.SEEK_END)
                        writer.write(b" ")
                return super().read(size)

        def opened(self, mode="r", *args, **keywords):
            if self != path or mode != "rb":
                return plainly(self, mode, *args, **keywords)
            os.utime(path, ns=(0, 0))  # what is written now is of another time, however coarse the system's clock is
            return Disturbed(plainly(path, "rb", buffering=0))

        monkeypatch.setattr(Path, "open", opened)

    return prepare


def test_cameras(tmp_path, written_while_read):
    path = cameras_json(tmp_path / "cameras.json")
    written_while_read(path)
    with pytest.raises(DataError, match=rf"cameras\.json' {SAID}$"):
        load_cameras(path)


@pytest.mark.parametrize(
    ("name", "times", "read"),
    [
        ("golden_bundles_degree3", 1, potr_cl.decode),  # only while its header is read
        ("golden_bundles_degree3", math.inf, potr_cl.decode),
        ("golden_blocks", 1, potr_cl.decode),
        ("golden_blocks", math.inf, potr_cl.decode),
        ("golden_bundles_degree3", math.inf, coded_scene),
    ],
)
def test_a_compressed_scene(tmp_path, data, written_while_read, name, times, read):
    path = tmp_path / "a.potr"
    shutil.copy(data / f"{name}.potr", path)
    written_while_read(path, times)
    with pytest.raises(DataError, match=rf"^'[^']*a\.potr' {SAID}$"):
        read(path)


@pytest.mark.parametrize("how", ["replaced", "written"])
def test_a_file_of_blocks_that_is_written_between_two_of_them(tmp_path, data, how):
    """Another encode may end meanwhile, whose file takes this one's place."""
    path = tmp_path / "a.potr"
    shutil.copy(data / "golden_blocks.potr", path)
    file = open_file(path)
    if how == "replaced":
        shutil.copy(path, tmp_path / "b.potr")
        (tmp_path / "b.potr").replace(path)
    else:
        os.utime(path, ns=(1, 1))
    with pytest.raises(DataError, match=rf"a\.potr' {SAID}$"):
        file.scene()
    assert len(potr_cl.decode(path))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes on this system")
def test_a_pipe_is_not_said_to_change(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    writer = threading.Thread(target=path.write_bytes, args=(bytes(1000),))
    writer.start()
    with path.open("rb") as file, unchanged(path, file):
        assert len(file.read()) == 1000
    writer.join()
