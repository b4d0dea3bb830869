"""Launches in pieces, as where a watchdog ends long kernels, and devices that are smaller than they say."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable
from math import prod
from types import SimpleNamespace

import numpy as np
import pytest

from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl import limits
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, Family, choose_device
from potr_cl.opencl.limits import LIMITS_VARIABLE, limited
from potr_cl.opencl.pieces import Pieces, _Walk, uncut
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions

#: What a small GPU beside a CPU is like, whose launches are to be cut: of an excerpt none takes a quarter of a second.
SMALL = {"memory": 4_000_000_000, "largest_buffer": 1_000_000_000, "integrated": True, "profiling": False}


@pytest.mark.parametrize("grid", [(7,), (5, 3), (4, 1, 3), (1, 6)])
@pytest.mark.parametrize("whole", [frozenset(), frozenset({0}), frozenset({1})])
def test_pieces_cover_a_grid_once(grid: tuple[int, ...], whole: frozenset[int]) -> None:
    for count in (1, 2, 4, 9, 100):
        covered, walk = np.zeros(grid, int), _Walk(grid, whole)
        while not walk.done:
            place, size = walk.next(count)
            at = tuple(slice(p, p + s) for p, s in zip(place, size, strict=True))
            assert covered[at].shape == size
            assert all(size[d] == grid[d] for d in whole if d < len(grid))
            uncuttable = prod(grid[d] for d in whole if d < len(grid))
            assert prod(size) <= max(count, uncuttable)
            covered[at] += 1
        assert (covered == 1).all()


def test_kernels_that_ask_for_the_size_of_the_range_are_whole() -> None:
    assert uncut(("refit/view_colours.cl", "view_colours", ())) == {1}
    assert uncut(("refit/coefficients.cl", "dot_parts", ())) == {0}
    assert uncut(("refit/coefficients.cl", "combine", ())) == set()
    assert uncut(("raster/composite_gpu.cl", "composite", ())) == set()


class Clock:
    """A queue on a clock of its own, on which each work-group takes so many seconds."""

    def __init__(self, seconds: Callable[[int], float], monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.pieces, self.seconds = 0.0, [], seconds
        monkeypatch.setattr("potr_cl.opencl.pieces.perf_counter", lambda: self.now)

    def finish(self) -> None:
        pass

    def enqueue(self, items: tuple[int, ...], offset: tuple[int, ...]) -> None:
        self.pieces.append(items[0])
        self.now += sum(map(self.seconds, range(offset[0], offset[0] + items[0])))

    def launch(self, pieces: Pieces, items: int) -> None:
        self.pieces.clear()
        pieces.launch(self.enqueue, self, ("raster/reached.cl", "mark_reached", ()), (items,), (1,))  # type: ignore[arg-type]
        assert sum(self.pieces) == items


def test_pieces_are_as_long_as_they_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, pieces = Clock(lambda group: 1, monkeypatch), Pieces(seconds=100, compute_units=1)
    clock.launch(pieces, 300)
    assert clock.pieces == [2, 8, *[18] * 16, 2]
    assert pieces.longest == {"mark_reached": 18}
    assert pieces.cut == {"mark_reached": 1}


def test_pieces_are_short_where_some_work_groups_have_much_more_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the second half a hundred times as much, 5 s in all."""
    clock = Clock(lambda group: (100 if group >= 1000 else 1) * 5 / 101_000, monkeypatch)
    pieces = Pieces(seconds=0.25, compute_units=8)
    for longest in (0.62, 0.25, 0.25):  # of the first launch nothing is known before
        pieces.longest.clear()
        clock.launch(pieces, 2000)
        assert pieces.longest["mark_reached"] <= longest


@pytest.mark.slow
@pytest.mark.parametrize("family", ["gpu", "cpu"])
@pytest.mark.parametrize("options", [{"preset": "paper"}, {"preset": "best", "fit": {"on": True, "steps": 8}}])
def test_an_encode_in_pieces_has_the_same_bytes(
    plush_excerpt: Scene, plush_excerpt_cameras: list[Camera], family: Family, options: dict[str, object]
) -> None:
    chosen = EncodeOptions.for_preset(**options, q=0.5, prune={"iterations": 3}, cameras_anyway=True)  # type: ignore[arg-type]

    def made(info: DeviceInfo) -> tuple[bytes, Device]:
        device = Device(info, family=family)
        return encode(plush_excerpt, plush_excerpt_cameras[:5], chosen, device=device).data, device

    whole, _ = made(choose_device())
    cut, device = made(dataclasses.replace(choose_device(), longest_kernel=1e-9, **SMALL))
    assert cut == whole
    assert device.pieces is not None
    cut_kernels = {name for name, count in device.pieces.cut.items() if count}
    assert cut_kernels >= {"project", "removal" if options["preset"] == "best" else "compact"}


def test_a_device_without_clocks_is_not_asked_for_times() -> None:
    with pytest.raises(DeviceError, match="measures no times"):
        Device(dataclasses.replace(choose_device(), profiling=False), profiling=True)


def test_limits_of_the_environment_hold_for_every_device() -> None:
    environment = os.environ | {LIMITS_VARIABLE: "memory=4, buffer=1,kernel=0.25,profiling=no,shared=yes"}
    code = "import json; from potr_cl.opencl.discovery import list_devices as l; print(json.dumps(["
    code += "(d.memory, d.largest_buffer, d.longest_kernel, d.profiling, d.shares_host_memory) for d in l()]))"
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    for memory, largest, longest, profiling, shared in json.loads(run.stdout):
        assert memory <= 4e9
        assert largest <= 1e9
        assert (longest, profiling, shared) == (0.25, False, True)


@pytest.mark.parametrize("text", ["memory", "memory=much", "kernel=0", "cores=4", "shared=perhaps", "buffer=-1"])
def test_limits_that_make_no_sense_are_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, f"memory=4,{text}")
    with pytest.raises(DeviceError, match=f"has '{text}': give memory=GB"):
        limited(choose_device())


def test_a_watchdog_is_expected_unless_the_driver_denies_it() -> None:
    def longest(kind: str, extensions: str, watched: int = 0) -> float | None:
        handle = SimpleNamespace(extensions=f"cl_khr_fp64 {extensions}", get_info=lambda _: watched)
        return limits.longest_kernel(kind, handle)  # type: ignore[arg-type]

    asked = "cl_nv_device_attribute_query"
    assert longest("gpu", asked, 0) is longest("cpu", "") is None
    assert longest("gpu", asked, 1) == longest("gpu", "") == limits.WATCHED
