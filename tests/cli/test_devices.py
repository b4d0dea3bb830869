"""The command devices, and how a device is chosen."""

from __future__ import annotations

import getpass
import json
import platform
from pathlib import Path

import pytest

from potr_cl import cli
from potr_cl.opencl import verdict
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DEVICE_VARIABLE, compiler_fault, list_devices
from tests.cli.calls import fails, run


def test_devices(capsys):
    report = json.loads(run(capsys, "devices", "--json"))
    assert [entry["index"] for entry in report] == list(range(len(list_devices())))
    assert [entry["name"] for entry in report if entry["chosen"]] == [Device().info.name]
    lines = [line for line in run(capsys, "devices").splitlines() if "cannot compile anything: " not in line]
    assert len(lines) == 1 + len(report)
    assert [line.startswith("*") for line in lines[1:]] == [entry["chosen"] for entry in report]


def test_devices_check(capsys, monkeypatch):
    """What fails is marked and passed over."""
    infos = list_devices()
    monkeypatch.setattr(verdict, "tried", lambda info: "1 + 1 is 3" if info == infos[0] else None)
    code = cli.main(["devices", "--check", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert report[0]["check"] == "1 + 1 is 3"
    assert not report[0]["chosen"]
    assert code == (0 if any(entry["chosen"] for entry in report) else 1)


@pytest.mark.parametrize(
    ("checks", "code", "said"),
    [
        (["passed", "wrong"], 0, ""),
        (["wrong", "passed"], 1, "choose another with --device: 1"),
        (["wrong", "wrong"], 1, "none works"),
    ],
)
def test_devices_check_fails_if_the_one_to_be_taken_does(capsys, monkeypatch, checks, code, said):
    entry = json.loads(run(capsys, "devices", "--json"))[0] | {"fault": None}
    entries = [entry | {"index": i, "chosen": i == 0, "check": check} for i, check in enumerate(checks)]
    monkeypatch.setattr("potr_cl.cli.devices.device_report", lambda check: entries)
    assert cli.main(["devices", "--check"]) == code
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.out.count("self-check: wrong") == checks.count("wrong")
    marks = [line[:2].strip() for line in captured.out.splitlines() if line[2:3].isdigit()]
    assert marks == [("*" if i == 0 else "") + ("" if check == "passed" else "!") for i, check in enumerate(checks)]


def test_a_report_to_be_posted(capsys, monkeypatch, tmp_path):
    """Holds what was found on each device, and no names or paths of the user."""
    names = getpass.getuser(), platform.node(), Path.home().name
    said = [
        f"{Path.home()}/a.cl:3: warning by {names[0]} on {names[1]}",
        r"C:\Users\me\a.cl(3): unused",
        "either/or",
    ]
    times = {"removal": {"launches": 3, "seconds": 0.5}}
    monkeypatch.setattr(verdict, "measured", lambda info: (None, {"compiler": said, "seconds": 1.5, "times": times}))
    run(capsys, "devices", "--report", tmp_path / "devices.json")
    text = (tmp_path / "devices.json").read_text("utf-8")
    report = json.loads(text)
    assert [entry["name"] for entry in report["devices"]] == [info.name for info in list_devices()]
    entry = next(entry for entry in report["devices"] if entry["check"] == "passed")
    assert entry["times"] == times
    assert entry["driver"]
    assert isinstance(entry["extensions"], list)
    assert entry["compiler"] == ["…:3: warning by … on …", "…(3): unused", "either/or"]
    assert str(Path.home()) not in text
    assert "Users" not in text


def test_a_report_of_a_device_that_fails(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(verdict, "measured", lambda info: ("atomics are wrong in /tmp/x/kernel.cl", {}))
    fails(capsys, ["devices", "--report", str(tmp_path / "devices.json")], 1, "none works")
    entry = json.loads((tmp_path / "devices.json").read_text("utf-8"))["devices"][0]
    assert entry["check"] == "atomics are wrong in …"
    assert "times" not in entry


def test_no_device(capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.opencl.discovery.list_devices", list)
    fails(capsys, ["devices"], 1, "no OpenCL device found")


def test_device_by_environment(tmp_path, scene_path, cameras_path, capsys, monkeypatch):
    render = ["render", scene_path, "--cameras", cameras_path, "--views", "0", "-o", tmp_path / "out"]
    monkeypatch.setenv(DEVICE_VARIABLE, "no such thing")
    fails(capsys, render, 1, "'no such thing'")
    able = next(info for info in list_devices() if compiler_fault(info) is None)
    assert able.name in run(capsys, *render, "--device", able.index)
