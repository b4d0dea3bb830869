"""Scenes that several tests use."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from potr_cl import Camera, Scene
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model import agreement
from potr_cl.opencl.device import Device
from potr_cl.opencl.loader import register_runtimes
from potr_cl.opencl.verdict import TRUST_VARIABLE
from potr_cl.placement.space import Space
from tests.cases.once import once
from tests.reference.gpu_programs import undeclared

# Tests take devices as they are; tests/opencl/test_verdict.py tries them.
os.environ.setdefault(TRUST_VARIABLE, "1")

DATA = Path(__file__).parent / "data"
#: Where Chromium is, if it has another name than systems give it.
CHROMIUM_VARIABLE = "POTR_CL_CHROMIUM"
#: It is waited so long for what should come at once, however busy the machine is: Playwright has 30 s of its own.
MOST_MILLISECONDS = 300_000
SCENES = Path(__file__).parents[2] / "shared" / "scenes"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out, visibly, what a second OpenCL runtime or the other kernel family would only repeat."""

    def repeats(item: pytest.Item) -> bool:
        parameters = getattr(item, "callspec", None)
        values = [] if parameters is None else [str(value) for value in parameters.params.values()]
        second = any(value.endswith("-pocl") for value in values) and item.get_closest_marker("one_runtime") is not None
        return second or ("gpu" in values and item.get_closest_marker("one_family") is not None)

    repeated = [item for item in items if repeats(item)]
    if repeated:
        config.hook.pytest_deselected(items=repeated)
        items[:] = [item for item in items if item not in set(repeated)]


@pytest.fixture(scope="session", autouse=True)
def runtimes_are_registered() -> None:
    """As the first test that opens a device would do it, for all programs that tests start.

    A program that does it itself leaves a folder where temporary files lie, for those after it; tests that look what is
    left there would find that, if none has opened a device before them.
    """
    register_runtimes()


@pytest.fixture(scope="session", autouse=True)
def programs_are_declared() -> Iterator[None]:
    """What GPUs are given is what the kernel files say that they are: tools.stress.offline compiles just that."""
    built = Device._built

    def checked(self: Device, wanted: tuple[str, tuple[tuple[str, str], ...]]) -> Any:
        if self.family == "gpu" and not self._variants and (fault := undeclared(wanted[0], dict(wanted[1]))):
            raise AssertionError(fault)
        return built(self, wanted)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Device, "_built", checked)
        yield


@pytest.fixture(scope="session", autouse=True)
def computed_once() -> Iterator[None]:
    """What each encode asks of its scene, the same for the same scene and cameras, and a good part of what it takes.

    Whether the cameras belong to the scene, and if there are none, where matter is. The tests of the judgement call the
    function itself.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agreement, "judge_cameras", once(agreement.judge_cameras, 1000))
        patch.setattr(Space, "of", staticmethod(once(Space.of, 8)))
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of the small excerpts."""
    return DATA


@pytest.fixture(scope="session")
def plush_excerpt() -> Scene:
    """1500 splats of a real scene, SH degree 3."""
    return load_scene(DATA / "plush_excerpt.ply")


@pytest.fixture(scope="session")
def plush_excerpt_cameras() -> list[Camera]:
    """9 training and 3 test views that see the excerpt."""
    return load_cameras(DATA / "plush_excerpt_cameras.json")


@pytest.fixture(scope="session")
def lego() -> Path:
    """The folder of the whole scene lego: point_cloud.ply, cameras.json, transforms_*.json, images."""
    return _whole_scene("lego")


@pytest.fixture(scope="session")
def plush() -> Path:
    """The folder of the whole scene plush: point_cloud.ply, cameras.json, sparse/0, images."""
    return _whole_scene("plush")


def _whole_scene(name: str) -> Path:
    folder = SCENES / name
    if not (folder / "point_cloud.ply").exists():
        pytest.skip(f"the scene {name} is not in {SCENES}")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium of the system, driven by Playwright; WebGL is computed on the CPU.

    One for each module: for as long as Playwright runs, its event loop occupies the thread, and tests of other modules
    could not run one of their own.
    """
    library = pytest.importorskip("playwright.sync_api", reason="the extra browser is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = os.environ.get(CHROMIUM_VARIABLE) or next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no Chromium is installed, and {CHROMIUM_VARIABLE} names none")
    arguments = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        arguments.append("--no-sandbox")
    with library.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=path, args=arguments, timeout=MOST_MILLISECONDS)
        new_context = chromium.new_context

        def patient(**choices: Any) -> Any:
            context = new_context(**choices)
            context.set_default_timeout(MOST_MILLISECONDS)
            return context

        chromium.new_context = patient
        yield chromium
        chromium.close()
