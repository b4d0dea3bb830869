"""Some splats of a scene on a device: named by their numbers, or copied from the host."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.opencl.memory import Memory
from potr_cl.raster.picked_splats import IndexSubset, IndexSubsets, Picker
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers, uploaded
from tests.cases.streets import street


def test_picked_splats_are_drawn_as_a_scene_of_their_own(gpu):
    scene, cameras = street(2)
    splats = np.arange(1, len(scene), 3)
    with uploaded(gpu, scene) as whole, Memory(gpu) as memory:
        numbers = memory.upload(splats.astype(np.uint32), "some splats")
        with (
            Rasterizer(gpu, IndexSubset(whole, numbers, len(splats))) as one,
            Rasterizer(gpu, scene.subset(splats)) as other,
        ):
            for camera in cameras:
                assert np.array_equal(one.render(camera)[0], other.render(camera)[0])


@pytest.mark.parametrize("splats", [1, 4096, 10_000])
def test_the_numbers_of_some_groups(gpu, splats):
    rng = np.random.default_rng(splats)
    groups = rng.integers(0, 40, splats).astype(np.uint32)
    wanted = rng.random(40) < 0.4
    wanted[groups[0]] = True
    with Picker(gpu, groups) as picker, Memory(gpu) as memory:
        numbers, count = picker.pick(memory, wanted)
        expected = np.flatnonzero(wanted[groups])
        assert count == len(expected)
        assert np.array_equal(gpu.download(numbers, (count,), np.uint32), expected)


def test_the_numbers_of_several_choices_of_groups(gpu):
    rng = np.random.default_rng(7)
    groups = rng.integers(0, 40, 10_000).astype(np.uint32)
    wanted = rng.random((5, 40)) < np.array([0.0, 0.1, 0.5, 0.9, 1.0])[:, None]
    with Picker(gpu, groups) as picker, Memory(gpu) as memory:
        picks = IndexSubsets(memory, picker, wanted)
        for choice in (3, 0, 4, 1, 2):
            expected = np.flatnonzero(wanted[choice][groups])
            assert picks.counts[choice] == len(expected)
            numbers = picks.numbers(memory, choice)
            assert np.array_equal(gpu.download(numbers, (len(expected),), np.uint32), expected)


@pytest.mark.parametrize("sh_count", [1, 4])
def test_some_splats_of_the_host_go_to_the_device_as_all_do(gpu, sh_count):
    """Piece by piece, of more than one piece; also where no parameter has more columns than rotations have."""
    scene, _ = street(2, 50_000)
    scene = dataclasses.replace(scene, sh=scene.sh[:, :sh_count])
    assert scene.sh.shape[1] == sh_count
    splats = np.flatnonzero(np.arange(len(scene)) % 7 > 0)
    with uploaded(gpu, scene.subset(splats)) as wanted, SceneBuffers(gpu, len(splats), scene.sh.shape[1]) as got:
        got.write_some(scene, splats)
        for name, buffer in wanted.parameters.items():
            size = (buffer.size // 4,)
            found = gpu.download(got.parameters[name], size, np.float32)
            assert np.array_equal(found, gpu.download(buffer, size, np.float32)), name
