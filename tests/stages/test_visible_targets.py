"""Target pictures of a large scene, each with what its view may draw: the same bits as with all splats."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.errors import DeviceMemoryError
from potr_cl.model import splat_groups
from potr_cl.opencl.memory import Memory
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import uploaded
from potr_cl.views import targets, visibility
from potr_cl.views.targets import RenderedTargets, targets_of
from potr_cl.views.visibility import Visibility
from tests.cases.noting import noted
from tests.cases.streets import street


@pytest.fixture(autouse=True)
def _small_groups(monkeypatch):
    monkeypatch.setattr(splat_groups, "LARGEST", 32)


def test_the_same_pictures(gpu):
    """Of views of two sizes, one of which looks at nothing."""
    scene, cameras = street()
    away = dataclasses.replace(cameras[0], rotation=np.diag([1.0, -1.0, -1.0]) @ cameras[0].rotation)
    away = dataclasses.replace(away, translation=-away.rotation @ (cameras[0].centre + 1000), width=50)
    cameras = [*cameras, away, cameras[1]]
    visibility = Visibility.of(scene, cameras, INRIA.near)
    assert visibility.totals[-2] == 0
    assert visibility.totals.sum() < 0.5 * len(scene) * len(cameras)
    pixels = [3 * camera.width * camera.height for camera in cameras]
    background = (0.1, 0.2, 0.3)
    with (
        uploaded(gpu, scene) as whole,
        Rasterizer(gpu, whole, background=background) as rasterizer,
        targets_of(gpu, whole, cameras, background, visibility) as visible,
        Memory(gpu) as memory,
    ):
        buffers = [memory.allocate(4 * sum(pixels), "pictures") for _ in range(2)]
        orders = [list(range(len(cameras))), [3, len(cameras) - 2, 1]]
        for numbers in orders:
            size = sum(pixels[number] for number in numbers)
            RenderedTargets(rasterizer, cameras).into(numbers, buffers[0])
            visible.into(numbers, buffers[1])
            wanted, got = (gpu.download(buffer, (size,), np.float32) for buffer in buffers)
            assert np.array_equal(wanted, got)
            assert wanted.std() > 0.05
        gpu.queue.finish()


def test_fewer_together_where_the_device_has_no_room(gpu, monkeypatch):
    scene, cameras = street()
    visibility = Visibility.of(scene, cameras, INRIA.near)
    pixels = sum(3 * camera.width * camera.height for camera in cameras)
    together = []
    prepare = Rasterizer.prepare_set

    def failing(self, some, *args):
        together.append(len(some))
        if len(some) > 2:
            raise DeviceMemoryError("no room")
        return prepare(self, some, *args)

    found = []
    with uploaded(gpu, scene) as whole, Memory(gpu) as memory:
        buffer = memory.allocate(4 * pixels, "pictures")
        for full in (False, True):
            if full:
                monkeypatch.setattr(Rasterizer, "prepare_set", failing)
            with targets_of(gpu, whole, cameras, (0.0, 0.0, 0.0), visibility) as visible:
                visible.into(range(len(cameras)), buffer)
            found.append(gpu.download(buffer, (pixels,), np.float32))
    assert max(together) > 2 == together[-1]
    assert np.array_equal(*found)


@pytest.mark.slow
def test_a_refit_takes_them_and_the_bytes_stay(gpu, monkeypatch):
    scene, cameras = street(5, 300)
    options = EncodeOptions.for_preset("best", cameras_anyway=True)
    options = options.changed(prune={"iterations": 2}, refit={"steps": 2}, between={"views": 0.0})
    wanted = encode(scene, cameras, options, device=gpu)
    monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
    made = noted(monkeypatch, targets, "SeenRasterizer")
    assert encode(scene, cameras, options, device=gpu).data == wanted.data
    assert len(made) == 2  # there is room, so pictures are rendered ahead besides
    made.clear()
    encode(scene, cameras, options.changed(memory=3_000_000), device=gpu)
    assert len(made) == 1
