"""Devices are tried in a process of their own: a crash is a verdict, which is kept."""

from __future__ import annotations

import json
import logging
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from potr_cl import cli
from potr_cl.errors import DeviceError
from potr_cl.opencl import discovery, quirks, verdict
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device, list_devices
from potr_cl.pipeline import trial
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import PRESETS

CRASH = "import os, signal; os.kill(os.getpid(), signal.SIG{})"


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The source of what is run instead of the trial; verdicts are kept for this test alone."""
    monkeypatch.delenv(verdict.TRUST_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(verdict, "_file", lambda info: tmp_path / "verdicts" / str(info.index))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(verdict, "_MODULE", "tried_instead")
    monkeypatch.setattr(discovery, "_passed_over", set())
    return tmp_path / "tried_instead.py"


def test_a_crash_is_a_verdict_that_is_kept_until_the_next_check(child, capsys):
    info = choose_device()
    child.write_text(CRASH.format("SEGV"))
    assert verdict.kept(info) == (False, None)
    assert cli.main(["devices", "--check", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    checked = [entry["check"] for entry in report if entry["fault"] is None]
    assert checked
    assert set(checked) == {"its driver crashes while an encode runs"}
    child.unlink()  # nothing is tried again
    with pytest.raises(DeviceError, match=r"failed its self-check, which `devices --check` repeats \(its driver crash"):
        choose_device()
    Device(info)  # whoever insists may have it
    child.write_text("")
    assert cli.main(["devices", "--check"]) == 0
    assert choose_device() == info


def test_a_device_that_crashed_is_passed_over(child, monkeypatch, caplog):
    best = choose_device()
    other = list_devices()[-1] if list_devices()[0] == best else list_devices()[0]
    if other == best:
        pytest.skip("there is one device only")
    monkeypatch.setattr(discovery, "_by_preference", lambda: [best, other])
    crashing = (best.platform, best.version)
    monkeypatch.setattr(quirks.Quirk, "concerns", lambda self, *names: self is quirks.CRASHES and names == crashing)
    child.write_text(CRASH.format("SEGV"))
    with caplog.at_level(logging.INFO, "potr_cl"):
        assert choose_device() == other
        assert choose_device() == other
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2  # that it is tried, and that it is passed over: once
    assert said[1].endswith(f"going on with {other}")


@pytest.mark.parametrize(
    ("source", "decided", "said"),
    [
        ("import sys; sys.exit('atomics are wrong')", True, "atomics are wrong"),
        ("import sys; sys.exit(7)", True, "its self-check ended with exit code 7"),
        (CRASH.format("KILL"), False, None),  # by somebody, or for memory: no word about the device
        ("", True, None),
    ],
)
def test_how_a_trial_ends(child, source, decided, said):
    child.write_text(source)
    info = choose_device()
    assert verdict.tried(info) == said
    assert verdict.kept(info) == (decided, said)


def test_ctrl_c_on_windows_is_no_crash(child, monkeypatch):
    ended = subprocess.CompletedProcess([], 0xC000013A, b"", b"")
    monkeypatch.setattr(verdict.subprocess, "run", lambda *_, **__: ended)
    assert verdict.tried(choose_device()) is None
    assert verdict.kept(choose_device()) == (False, None)
    monkeypatch.setattr(ended, "returncode", 0xC0000005)
    assert verdict.tried(choose_device()) == "its driver crashes while an encode runs"


def test_what_a_trial_measures_is_told(child):
    child.write_text('import sys; print(\'{"seconds": 2, "asked": "\' + sys.argv[2] + \'"}\')')
    info = choose_device()
    assert verdict.measured(info) == (None, {"seconds": 2, "asked": "--measure"})
    child.write_text("import sys; sys.exit('atomics are wrong')")
    assert verdict.measured(info) == ("atomics are wrong", {})
    assert verdict.kept(info) == (True, "atomics are wrong")


@pytest.mark.slow
def test_kernels_are_timed_and_the_compiler_is_heard(monkeypatch):
    monkeypatch.setattr(trial, "_MANY_SPLATS", 400)
    monkeypatch.setattr(trial, "_LARGE_SIDE", 48)
    # A macro that is the same each time: what was compiled for this test before need not be again.
    monkeypatch.setattr(trial, "time", SimpleNamespace(perf_counter=time.perf_counter, time_ns=lambda: 0))
    found = trial.measured(choose_device())
    assert found["times"].keys() >= {"removal", "refit_sweep", "derivatives", "compact"}
    assert all(each["launches"] > 0 and each["seconds"] > 0 for each in found["times"].values())
    assert found["seconds"] > 0
    assert all("warning" in line.lower() or "error" in line.lower() for line in found["compiler"])


@pytest.mark.slow
def test_the_trial_builds_every_kernel_of_encodes_and_this_machines_device_passes(plush_excerpt, plush_excerpt_cameras):
    tried, used = Device(), Device()
    trial.try_encodes(tried)
    for preset in PRESETS:
        options = EncodeOptions.for_preset(preset, prune={"iterations": 2}, fit={"on": True, "steps": 4})
        encode(plush_excerpt, plush_excerpt_cameras, options, device=used)
    assert set(used._programs) <= set(tried._programs)


@pytest.mark.slow
def test_the_trial_passes_in_a_process_of_its_own(child, monkeypatch):
    monkeypatch.setattr(verdict, "_MODULE", trial.__name__)
    monkeypatch.delenv("XDG_CACHE_HOME")  # where the programs are that others have compiled
    assert verdict.tried(choose_device()) is None
    assert verdict.kept(choose_device()) == (True, None)
