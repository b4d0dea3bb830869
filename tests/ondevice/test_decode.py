"""A file decoded into a device's memory: the bits of its scene decoded and uploaded, and nothing left behind."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl.api.inputs import drawable_to_judge
from potr_cl.codec import block_values
from potr_cl.codec.body import Body
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import PotrFile, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.native.values import BundleShare
from potr_cl.codec.quantize import HyperParameters, Preset
from potr_cl.errors import DataError, DeviceError, DeviceMemoryError, UsageError
from potr_cl.model.sightings import looked_at
from potr_cl.native.library import native
from potr_cl.ondevice import decode
from potr_cl.ondevice.decode import StagedBundles, decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SceneBuffers, uploaded
from tests.devices import KERNELS, shared_device
from tests.reference.file_parts import File
from tests.reference.scenes import random_scene

DATA = Path(__file__).parents[1] / "data"
GOLDEN = sorted(DATA.glob("golden_*.potr"))
ZSTD = EntropyCoder("zstd", 3)
PARAMETERS = ("means", "scales", "quaternions", "log2_opacities", "sh")


@pytest.fixture(scope="module", params=KERNELS)
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    device = shared_device(request.param)
    yield device
    assert device.allocated == 0, "a decoded scene did not give all its memory back"


def bits(buffers: SceneBuffers) -> dict[str, bytes]:
    device = buffers.device
    columns = {name: getattr(buffers, name).size // (4 * buffers.stride) for name in PARAMETERS}
    return {
        name: device.download(getattr(buffers, name), (number, buffers.stride), np.uint32).tobytes()
        for name, number in columns.items()
    }


def assert_as_uploaded(file: PotrFile, device: Device, sh_degree: int | None = None) -> None:
    with uploaded(device, file.scene(sh_degree=sh_degree)) as wanted, decode_to_device(file, device, sh_degree) as got:
        assert (got.splats, got.stride, got.sh_count) == (wanted.splats, wanted.stride, wanted.sh_count)
        assert (got.antialiased, got.low_pass) == (wanted.antialiased, wanted.low_pass)
        a, b = bits(wanted), bits(got)
    assert [name for name in PARAMETERS if a[name] != b[name]] == []


@functools.cache
def coded(
    splats: int,
    degree: int = 3,
    preset: Preset = "best",
    entropy: EntropyCoder | None = None,
    q: float = 0.5,
    factor: float | None = None,
) -> bytes:
    """A file, of coder BUNDLES unless another is given; with all scale factors the same, if one is given."""
    parameters = HyperParameters.from_quality(q, preset)
    if factor is not None:
        names = ("sf_dc", "sf_sh", "sf_opacity", "sf_rotation", "sf_scale")
        parameters = replace(parameters, **dict.fromkeys(names, factor))
    return b"".join(code_scene(random_scene(splats, degree, seed=splats), parameters, entropy=entropy).pieces)


@functools.cache
def of_excerpt(q: float = 0.3) -> bytes:
    excerpt = potr_cl.load_scene(DATA / "plush_excerpt.ply")
    return b"".join(code_scene(excerpt, HyperParameters.from_quality(q, "best")).pieces)


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_files_have_the_bits_of_the_host(path, device):
    assert_as_uploaded(open_file(path), device)


@pytest.mark.parametrize(
    ("preset", "entropy", "q", "native"),
    [("best", None, 0.5, "0"), ("best", None, 0.5, ""), ("best", ZSTD, 0.9, "0"), ("fast", ZSTD, 0.2, ""),
     ("paper", ZSTD, 0.5, "")],
)  # fmt: skip
def test_coded_scenes_have_the_bits_of_the_host(preset, entropy, q, native, device, monkeypatch):
    """More splats than a work-group has, and not a multiple of it."""
    monkeypatch.setenv("POTR_CL_NATIVE", native)
    assert_as_uploaded(open_file(coded(701, 3, preset, entropy, q)), device)


@pytest.mark.parametrize("factor", [1e3, 1e5, 1e9])
def test_levels_of_any_size_have_the_bits_of_the_host(factor, device):
    """Of one, two and more bytes, and beyond all tables."""
    assert_as_uploaded(open_file(coded(700, 2, entropy=ZSTD, factor=factor)), device)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_lower_degree_has_the_bits_of_the_host(degree, device):
    assert_as_uploaded(open_file(coded(500)), device, degree)


def test_an_unknown_degree_is_refused(device):
    with pytest.raises(UsageError, match="SH degree 4"):
        decode_to_device(open_file(coded(20)), device, 4)


def test_pictures_are_those_of_the_scene(device, plush_excerpt_cameras):
    camera, data = plush_excerpt_cameras[0], of_excerpt()
    for antialiased in (None, True):
        wanted = potr_cl.render(potr_cl.decode(data).rendered(antialiased), camera, device)
        with (
            potr_cl.decode_to_device(data, device, antialiased=antialiased) as scene,
            Rasterizer(device, scene) as rasterizer,
        ):
            image, transmittance = rasterizer.render(camera)
        assert np.array_equal(image, wanted.image)
        assert np.array_equal(transmittance, wanted.transmittance)
        assert np.array_equal(potr_cl.render(data, camera, device, antialiased=antialiased).image, wanted.image)


def test_a_closed_rasterizer_leaves_the_scene_to_its_owner(device, plush_excerpt_cameras):
    with potr_cl.decode_to_device(coded(300), device) as scene:
        before = bits(scene)
        for _ in range(2):
            with Rasterizer(device, scene) as rasterizer:
                rasterizer.render(plush_excerpt_cameras[0])
        assert bits(scene) == before


def test_a_scene_on_another_device_is_refused(device):
    other = Device(device.info, family=device.family)
    with potr_cl.decode_to_device(coded(20), other) as scene, pytest.raises(DeviceError, match="the scene lies on"):
        Rasterizer(device, scene)


@pytest.mark.one_family
def test_what_the_host_refuses_is_refused_and_leaves_nothing(device):
    """Bytes changed in turn: a checksum tells of each, at whatever depth."""
    data = coded(40, 1)
    before = device.allocated
    for place in range(0, len(data), 13):
        damaged = bytearray(data)
        damaged[place] ^= 0x55
        with pytest.raises(DataError):
            potr_cl.decode_to_device(bytes(damaged), device)
    assert device.allocated == before


def test_a_scene_that_does_not_fit_leaves_nothing(device, monkeypatch):
    data, before = coded(3000), device.allocated
    monkeypatch.setattr(device, "info", replace(device.info, memory=before + 300_000))
    with pytest.raises(DeviceMemoryError):
        potr_cl.decode_to_device(data, device)
    assert device.allocated == before


@pytest.mark.one_family
def test_a_path_is_named_in_errors(tmp_path, device):
    path = tmp_path / "scene.potr"
    data = bytearray(coded(40))
    data[-3] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match=r"scene\.potr': section"):
        potr_cl.decode_to_device(path, device)


@pytest.mark.one_family
def test_comparing_files_says_what_comparing_scenes_says(tmp_path, device, plush_excerpt, plush_excerpt_cameras):
    path = tmp_path / "b.potr"
    path.write_bytes(of_excerpt())
    views = plush_excerpt_cameras[:2]
    of_file, of_scene = (
        potr_cl.compare(plush_excerpt, other, views, device=device) for other in (path, potr_cl.decode(path))
    )
    assert of_file.psnr == of_scene.psnr
    assert of_file.report()["views"] == of_scene.report()["views"]


@pytest.fixture
def compiled():
    if native() is None:
        pytest.skip("the compiled library is not there: python -m tools.make.native, or pip install -e .")


@pytest.mark.one_family
@pytest.mark.parametrize(
    ("beside", "threads", "pinned", "bundles"), [(0, 1, True, 3), (0, 3, False, 9), (1, 2, True, 3), (1, 3, True, 9)]
)
def test_memory_that_bundles_take_turns_in(beside, threads, pinned, bundles, device, monkeypatch, compiled):
    """Less of it than there are bundles: those that come late wait until others are on the device."""
    monkeypatch.setattr(block_values, "_ROOMS_BESIDE", beside)
    if pinned:
        monkeypatch.setattr(decode, "_WORTH_PINNING", 1)
    file = open_file(coded(bundles * 8192 + 77, 2))
    with uploaded(device, file.scene()) as wanted, decode_to_device(file, device, threads=threads) as got:
        assert bits(wanted) == bits(got)


def test_a_device_that_fails_among_bundles_ends_all_threads(device, monkeypatch, compiled):
    taken: list[int] = []

    def fail(self, first, packed, items):
        taken.append(first)
        if len(taken) == 2:
            raise DeviceError("gone")

    monkeypatch.setattr(block_values, "_ROOMS_BESIDE", 0)
    monkeypatch.setattr(StagedBundles, "take", fail)
    before, others = device.allocated, set(threading.enumerate())
    with pytest.raises(DeviceError, match="gone"):
        decode_to_device(open_file(coded(6 * 8192, 1)), device, threads=2)
    assert taken == [0, 8192]
    assert device.allocated == before
    assert not set(threading.enumerate()) - others


def test_threads_that_get_no_memory_are_told_of(device, monkeypatch, compiled):
    def no_memory(self):
        raise MemoryError

    monkeypatch.setattr(BundleShare, "do", no_memory)
    with pytest.raises(DataError, match="more memory than the host has"):
        decode_to_device(open_file(coded(3 * 8192, 0)), device, threads=2)


@pytest.mark.slow
@pytest.mark.parametrize("native", [pytest.param("0", marks=pytest.mark.one_family), ""])
def test_bundles_beyond_all_tables_have_the_bits_of_the_host(native, device, monkeypatch):
    monkeypatch.setenv("POTR_CL_NATIVE", native)
    assert_as_uploaded(open_file(coded(300 if native == "0" else 8192 + 700, 2, factor=1e5)), device)


def test_a_damaged_bundle_among_good_ones_leaves_nothing(device, compiled):
    """Words of the last bundle are changed, and their checksums made right."""
    file = File.of(coded(4 * 8192 + 5, 1))
    section = next(section for section in file.blocks[0].sections if section.name == b"SHC1")
    section.stored = section.stored[:-20] + bytes(20)
    data = file.bytes()
    before = device.allocated
    with pytest.raises(DataError) as of_host:
        open_file(data).scene()
    with pytest.raises(DataError) as of_device:
        decode_to_device(open_file(data), device, threads=3)
    assert str(of_device.value) == str(of_host.value)
    assert device.allocated == before


def test_cameras_are_judged_by_what_is_on_the_device_already(device, monkeypatch):
    """The file is decoded once, and what is read back is the scene."""
    data, decoded = coded(70_000, 1), []
    decode_into = Body.decode_into
    monkeypatch.setattr(Body, "decode_into", lambda *args, **kwargs: decoded.append(decode_into(*args, **kwargs)))
    with drawable_to_judge(data, device, antialiased=True) as (buffers, judged):
        assert len(decoded) == 1
        assert len(buffers) == 70_000
    whole = open_file(data).scene().rendered(True)
    wanted = whole.subset(looked_at(len(whole)))
    assert 0 < len(judged) == len(wanted) < 70_000
    assert (judged.antialiased, judged.low_pass) == (wanted.antialiased, wanted.low_pass)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh"):
        assert np.allclose(getattr(judged, name), getattr(wanted, name), rtol=1e-5, atol=1e-5), name
