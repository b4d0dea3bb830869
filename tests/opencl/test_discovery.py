"""Which devices there are, on this machine and on invented ones, which is taken, and drivers that are broken."""

from __future__ import annotations

import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

from potr_cl.errors import DeviceError
from potr_cl.opencl import discovery, loader
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, choose_device, compiler_fault, list_devices
from potr_cl.opencl.source import kernel_source
from potr_cl.report.devices import device_report, format_devices


def invented(
    index: int, name: str, kind: str, platform: str = "Some", version: str = "1", integrated: bool = False
) -> DeviceInfo:
    return DeviceInfo(
        index, name, platform, version, kind, integrated, 1 << 30, 1 << 28, 1 << 15, 8, 8, 256, "gpu", None, True, None  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.fixture
def faults(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What is wrong with the compilers of devices, by name: those of this test's choice, whatever the machine has."""
    faults: dict[str, str] = {}
    monkeypatch.setattr(discovery, "compiler_fault", lambda info: faults.get(info.name))
    monkeypatch.setattr("potr_cl.opencl.device.compiler_fault", lambda info: faults.get(info.name))
    monkeypatch.setattr("potr_cl.report.devices.compiler_fault", lambda info: faults.get(info.name))
    monkeypatch.setattr(discovery, "_passed_over", set())
    return faults


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, faults: dict[str, str]) -> list[DeviceInfo]:
    """A machine with one of everything, worst first."""
    pocl = "Portable Computing Language"
    devices = [
        invented(0, "Oclgrind Simulator", "cpu", "Oclgrind"),
        invented(1, "llvmpipe", "cpu", "rusticl"),
        invented(2, "pthread-old", "cpu", pocl, "OpenCL 3.0 PoCL 3.0-rc2  Linux"),
        invented(3, "pthread-new", "cpu", pocl, "OpenCL 3.0 PoCL 3.1+debian  Linux"),
        invented(4, "AMD EPYC", "cpu", "Intel(R) OpenCL"),
        invented(5, "Iris", "gpu", "Intel(R) OpenCL Graphics", integrated=True),
        invented(6, "RTX", "gpu", "NVIDIA CUDA"),
        invented(7, "RTX", "gpu", "NVIDIA CUDA"),
    ]
    for module in ("opencl.discovery", "report.devices"):
        monkeypatch.setattr(f"potr_cl.{module}.list_devices", lambda: list(devices))
    monkeypatch.delenv("POTR_CL_DEVICE", raising=False)
    return devices


def test_preference(machine: list[DeviceInfo]) -> None:
    """Discrete GPU, integrated GPU, then CPU runtimes by speed; the first of equals."""
    order = []
    while machine:
        order.append(choose_device().index)
        machine.remove(choose_device())
    assert order == [6, 7, 5, 4, 3, 2, 1, 0]


@pytest.mark.parametrize(
    ("spec", "index"),
    [("7", 7), ("cpu", 4), ("gpu", 6), ("CPU", 4), ("iris", 5), ("pthread-old", 2), ("portable", 3), ("nvidia", 6)],
)
def test_specification(machine: list[DeviceInfo], spec: str, index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_device(spec).index == index
    monkeypatch.setenv("POTR_CL_DEVICE", spec)
    assert choose_device().index == index
    assert choose_device("1").index == 1  # what is asked for goes before the environment


@pytest.mark.parametrize("spec", ["8", "-1", "voodoo"])
def test_specification_that_fits_nothing(machine: list[DeviceInfo], spec: str) -> None:
    with pytest.raises(DeviceError, match=r"part of a name of 0: Oclgrind Simulator, 1: llvmpipe"):
        choose_device(spec)


@pytest.mark.parametrize(
    ("architecture", "advice"), [("x86_64", "[intel-cpu]"), ("AMD64", "[intel-cpu]"), ("aarch64", "PoCL")]
)
def test_no_device_at_all(monkeypatch: pytest.MonkeyPatch, architecture: str, advice: str) -> None:
    monkeypatch.setattr(discovery, "list_devices", list)
    monkeypatch.setattr(discovery, "machine", lambda: architecture)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(DeviceError, match=rf"or a CPU runtime by .*{re.escape(advice)}"):
        choose_device()


REFUSED = "error: unknown target CPU 'generic'"


@pytest.mark.parametrize("spec", [None, "cpu", "pthread"])
def test_what_cannot_compile_is_passed_over(
    machine: list[DeviceInfo], faults: dict[str, str], caplog: pytest.LogCaptureFixture, spec: str | None
) -> None:
    """The next best that fits is taken; one line a process says so."""
    del machine[4:]
    faults["pthread-new"] = REFUSED
    with caplog.at_level(logging.WARNING, "potr_cl"):
        assert [choose_device(spec).name for _ in range(3)] == ["pthread-old"] * 3
        assert len(caplog.records) == 1
        new, old = (rf"'pthread-{name}' \(Portable Computing Language\)" for name in ("new", "old"))
        words = rf"device {new} cannot compile even an empty program \({REFUSED}\).*; going on with {old}"
        assert re.fullmatch(words, caplog.records[0].getMessage())
        faults["pthread-old"] = REFUSED
        if spec != "pthread":
            assert choose_device(spec).name == "llvmpipe"
            named = re.findall("'[a-z-]+'", caplog.records[1].getMessage().replace("'generic'", ""))
            assert named == ["'pthread-new'", "'pthread-old'", "'llvmpipe'"]
            faults["llvmpipe"] = faults["Oclgrind Simulator"] = REFUSED
        with pytest.raises(DeviceError, match=r"'pthread-new'.*'pthread-old'.*cannot compile"):
            choose_device(spec)


def test_what_cannot_compile_matters_where_it_is_asked_for(
    machine: list[DeviceInfo], faults: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing is said of it where a better one is taken, or another is asked for."""
    faults["pthread-new"] = REFUSED
    with caplog.at_level(logging.WARNING, "potr_cl"):
        assert [choose_device(spec).index for spec in (None, "cpu", "pthread-old")] == [6, 4, 2]
        for ask in (lambda: choose_device("3"), lambda: choose_device("pthread-new"), lambda: Device(machine[3])):
            with pytest.raises(DeviceError, match=r"^device 'pthread-new' .*cannot compile even an empty") as error:
                ask()
            assert REFUSED in str(error.value)
            assert "newer PoCL" in str(error.value)
            assert "\n" not in str(error.value)
    assert not caplog.records


def test_only_cpus_of_pocl_are_asked(machine: list[DeviceInfo], monkeypatch: pytest.MonkeyPatch) -> None:
    """And none while devices are listed."""
    asked: list[object] = []
    monkeypatch.setattr(discovery.compiler, "fault", lambda handle: asked.append(handle) or REFUSED)
    monkeypatch.setattr(discovery, "_devices", None)
    assert list_devices()
    assert not asked
    pocl_gpu = invented(8, "Some GPU", "gpu", "Portable Computing Language")
    assert [info.name for info in [*machine, pocl_gpu] if compiler_fault(info)] == ["pthread-old", "pthread-new"]


def test_the_report_shows_what_cannot_compile(machine: list[DeviceInfo], faults: dict[str, str]) -> None:
    del machine[4:]
    faults["pthread-new"] = REFUSED
    report = device_report(check=False)
    assert [entry["fault"] for entry in report] == [None, None, None, REFUSED]
    assert [entry["chosen"] for entry in report] == [False, False, True, False]
    assert format_devices(report).splitlines()[-1].strip() == f"cannot compile anything: {REFUSED}"
    faults.update({info.name: REFUSED for info in machine})
    assert not any(entry["chosen"] for entry in device_report(check=False))  # nothing to take is no reason to fail


@pytest.mark.skipif(sys.platform == "win32", reason="a module's own libraries cannot be looked through there")
def test_other_threads_go_on_while_a_device_is_opened() -> None:
    """pyopencl's calls keep the interpreter's lock: the loader's own functions are found, and take what it takes."""
    assert None not in [loader.loader_function(name) for name in ("clGetPlatformIDs", "clCreateContext")]
    info = choose_device()
    assert loader.new_context(info.handle).devices == [info.handle]


def test_without_the_loaders_functions_pyopencl_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    known = list_devices()
    monkeypatch.setattr(loader, "loader_function", lambda name: None)
    monkeypatch.setattr(discovery, "_devices", None)
    assert list_devices() == known
    assert Device().vector_width >= 1
    # A loader without platforms leaves the count as it was and returns an error; nothing is asked of it any more.
    monkeypatch.setattr(loader, "loader_function", lambda name: lambda *arguments: -1001)
    loader.load_drivers()


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (
            "clBuildProgram failed: BUILD_PROGRAM_FAILURE - clBuildProgram failed: BUILD_PROGRAM_FAILURE\n\n"
            "Build on <pyopencl.Device 'A' on 'B' at 0x1>:\n\n\n"
            "a.cl:1:2: warning: tedious\n  a.cl:3:4: error: use of undeclared identifier 'x'\n1 error generated.\n\n"
            "(options: -DX -I /errors/error)\n(source saved as /tmp/a.cl)",
            "a.cl:3:4: error: use of undeclared identifier 'x'",
        ),
        ("clBuildProgram failed: X\n\nBuild on <A>:\n\nToo hard.\nSorry.\n\n(options: )", "Too hard."),
        (
            "clBuildProgram failed: X - clBuildProgram failed: X\n\nBuild on <A>:\n\n\n\n(options: -DX)",
            "clBuildProgram failed: X",
        ),
        ("clWaitForEvents failed: OUT_OF_RESOURCES", "clWaitForEvents failed: OUT_OF_RESOURCES"),
        ("", "RuntimeError"),
    ],
)
def test_the_line_that_tells_most(message: str, said: str) -> None:
    assert discovery.compiler.complaint(cl.RuntimeError(message)) == said


def test_this_machine() -> None:
    devices = list_devices()
    assert devices
    assert [d.index for d in devices] == list(range(len(devices)))


@pytest.mark.parametrize("info", list_devices(), ids=lambda info: info.index)
def test_each_device_of_this_machine(info: DeviceInfo) -> None:
    """One that is said to compile does, one that is said not to refuses what the others take."""
    assert 0 < info.largest_buffer <= info.memory
    assert info.vector_width in (1, 4, 8, 16)
    if (fault := compiler_fault(info)) is not None:
        with pytest.raises(cl.RuntimeError):
            cl.Program(cl.Context([info.handle]), kernel_source("opencl/probe.cl")).build(["-DLANES=1"])
        pytest.skip(f"{info}, {info.version} cannot compile: {fault}")
    Device(info).self_check()


def list_names(vendors: Path, **environment: str) -> list[str]:
    """The devices that a fresh process finds with this folder of ICDs."""
    run = subprocess.run(
        [sys.executable, "-c", "from potr_cl.opencl.discovery import *\nfor d in list_devices(): print(d.platform)"],
        env=os.environ | {"OCL_ICD_VENDORS": str(vendors)} | environment,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.splitlines()


def test_broken_drivers_are_survived(tmp_path: Path) -> None:
    """ICDs whose library is missing, is no library, or is no OpenCL driver; and one that is empty."""
    (tmp_path / "missing.icd").write_text("/nowhere/libOpenCL-nothing.so\n")
    (tmp_path / "empty.icd").write_text("")
    (tmp_path / "text.icd").write_text(f"{tmp_path / 'text.so'}\n")
    (tmp_path / "text.so").write_text("no library")
    (tmp_path / "other.icd").write_text("libm.so.6\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    assert list_names(tmp_path) == list_names(empty)


def register(monkeypatch: pytest.MonkeyPatch, variable: str, value: object, library: Path) -> str:
    """What a variable says after pip has brought a library."""
    installed = SimpleNamespace(name=library.name, locate=lambda: library)
    monkeypatch.setattr(loader.importlib.metadata, "files", lambda package: [installed])
    monkeypatch.setenv(variable, str(value))
    loader.register_runtimes()
    return os.environ[variable]


def test_registering_a_runtime_keeps_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library, vendors, hostile = tmp_path / "libintelocl.so", tmp_path / "vendors", tmp_path / "hostile"
    library.touch()
    vendors.mkdir()
    (vendors / "other.icd").write_text("libother.so\n")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_: str(tmp_path / "cache"))

    def folder() -> Path:
        return Path(register(monkeypatch, "OCL_ICD_VENDORS", vendors, library))

    wanted = {"other.icd": "libother.so\n", "potr_cl_intel_cpu.icd": f"{library}\n"}
    made = folder()
    assert made.parent == tmp_path / "cache"
    assert {p.name: p.read_text() for p in made.iterdir()} == wanted
    loader.register_runtimes()  # what is there already is left alone
    assert os.environ["OCL_ICD_VENDORS"] == str(made)

    # Somebody else has put a folder with their library there: it is neither used nor written to.
    hostile.mkdir()
    (hostile / "theirs.icd").write_text("libtheirs.so\n")
    shutil.rmtree(made)
    made.symlink_to(hostile)
    private = folder()
    assert {p.name for p in private.iterdir()} == wanted.keys()
    assert private.stat().st_mode & 0o077 == 0
    assert [p.name for p in hostile.iterdir()] == ["theirs.icd"]

    made.unlink()
    with monkeypatch.context() as full:
        full.setattr(loader, "cache_folder", lambda name: Path("/dev/full/no folder"))
        assert (folder() / "other.icd").exists()
    library.unlink()
    assert folder() == vendors


@pytest.mark.parametrize("known", ["", "other.dll"])
def test_registering_a_runtime_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known: str) -> None:
    library = tmp_path / "intelocl64.dll"
    monkeypatch.delattr(os, "getuid")  # which Windows has not
    assert register(monkeypatch, "OCL_ICD_FILENAMES", known, library) == known  # it is not there
    library.touch()
    loader.register_runtimes()
    loader.register_runtimes()  # now it is known
    assert os.environ["OCL_ICD_FILENAMES"].split(os.pathsep) == [*filter(None, [known]), str(library)]
