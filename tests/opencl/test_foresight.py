"""Programs that were needed before are loaded before they are asked for."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.program_cache import Foresight

PROGRAM = ("raster/columns.cl", ())


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_: str(tmp_path / "cache"))
    return tmp_path / "cache"


def no_builds(monkeypatch) -> None:
    def refused(*_):
        raise cl.RuntimeError("nothing can be built")

    monkeypatch.setattr(cl, "Program", refused)


@pytest.fixture
def needed() -> Device:
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
    note.write_text(json.dumps([["raster/gone.cl", []], ["opencl/probe.cl", [["LANES", "no number"]]], *[PROGRAM]]))
    again = Device()
    again.prepare_for("a test").result()
    assert again.kernel("raster/columns.cl", "columns").name == "columns"


@pytest.mark.parametrize("content", ["", "{}", "[1]", '[["../../x.cl", []]]', '[["a/b.cl"]]', '[["a/b.cl", 3]]', "\0"])
def test_a_damaged_note_is_as_good_as_none(tmp_path, content):
    Foresight(tmp_path, "a test").note(PROGRAM)
    (note,) = tmp_path.iterdir()
    note.write_text(content)
    assert Foresight(tmp_path, "a test").programs == []


def test_a_folder_that_cannot_be_written_stops_nobody(tmp_path):
    foresight = Foresight(tmp_path / "gone" / "further", "a test")
    foresight.note(PROGRAM)
    assert foresight.programs == [PROGRAM]


def test_notes_end_somewhere(tmp_path):
    foresight = Foresight(tmp_path, "a test")
    for number in range(100):
        foresight.note((f"a/b{number}.cl", (("X", "1"),)))
    kept = Foresight(tmp_path, "a test").programs
    assert kept == foresight.programs
    assert len(kept) == 64
