"""Formats of other tools: what they wrote looks as it should, what we write they would read, bad files are told."""

from __future__ import annotations

import builtins
import dataclasses
import gzip
import json
import math
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from potr_cl.cli import main
from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.formats import load_scene, scene_writer
from potr_cl.formats.scenes import ply, sog, spz
from potr_cl.opencl.device import Device
from potr_cl.quality.compare import compare, mean_view
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.reference.scenes import random_scene

pytest.importorskip("gsply", reason="the extra convert is not installed")

#: What splat-transform made of the excerpt, and the PSNR in dB that its renders reach: less is a misread convention.
FOREIGN = {
    "version_3.spz": 51,
    "version_4.spz": 51,
    "degree_1.spz": 61,
    "degree_0.sog": 66,
    "degree_3.sog": 55,
    "degree_3.compressed.ply": 61,
    "degree_0.compressed.ply": 73,
}
WRITTEN = {"scene.spz": 65, "scene.compressed.ply": 61, "scene.ply": math.inf}


@pytest.fixture(scope="module")
def device():
    return Device()


def psnr(device, a, b, cameras):
    first, second = Rasterizer(device, a), Rasterizer(device, b)
    figures = mean_view(compare(first, second, cameras).views).figures["b_against_a"]
    first.free()
    second.free()
    return figures.psnr


@pytest.mark.parametrize("name", FOREIGN)
def test_files_of_another_tool_look_as_the_scene_does(device, data, lego_excerpt, lego_excerpt_cameras, name):
    scene = load_scene(data / "foreign" / name)
    plain = dataclasses.replace(lego_excerpt, sh=lego_excerpt.sh[:, : scene.sh.shape[1]])
    assert psnr(device, plain, scene, lego_excerpt_cameras) >= FOREIGN[name]


@pytest.mark.parametrize("name", WRITTEN)
def test_what_is_written_looks_as_the_scene_does(device, tmp_path, lego_excerpt, lego_excerpt_cameras, name):
    scene_writer(tmp_path / name)(lego_excerpt)
    scene = load_scene(tmp_path / name)
    assert len(scene) == len(lego_excerpt)
    assert psnr(device, lego_excerpt, scene, lego_excerpt_cameras) >= WRITTEN[name]
    assert [p.name for p in tmp_path.iterdir()] == [name], "something is left behind"


def in_order_of(scene, back):
    """The same splats in the order of ``scene``: writers sort them."""
    distances = np.abs(back.means[None] - scene.means[:, None]).max(axis=-1)
    index = distances.argmin(axis=1)
    assert len(np.unique(index)) == len(scene) == len(back)
    return back.subset(index)


@pytest.mark.parametrize("degree", range(4))
def test_spz_keeps_every_property_to_its_step(tmp_path, degree):
    scene = random_scene(300, degree, seed=degree)
    spz.save(tmp_path / "a.spz", scene)
    back = in_order_of(scene, spz.load(tmp_path / "a.spz"))
    assert np.abs(back.means - scene.means).max() <= 0.5 / 4096 + 1e-6
    assert np.abs(back.log_scales - np.clip(scene.log_scales, -10, 5.9375)).max() <= 0.5 / 16 + 1e-5
    assert np.abs(back.opacities - scene.opacities).max() <= 0.5 / 255 + 1e-5
    unit = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
    assert np.abs(np.einsum("ij,ij->i", unit, back.quaternions)).min() > 1 - 1e-5
    dc = np.clip(scene.sh[:, 0], -0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(back.sh[:, 0] - dc).max() <= 0.5 / 255 / 0.15 + 1e-5
    if degree:
        ac = np.clip(scene.sh[:, 1:], -1, 127 / 128)
        assert np.abs(back.sh[:, 1:] - ac).max() <= 0.5 / 128 + 1e-5


def test_bounds_of_a_compressed_ply_hold_neighbours(tmp_path):
    rng = np.random.default_rng(0)
    means = rng.uniform(size=(256 * 64, 3)).astype(np.float32)
    scene = dataclasses.replace(random_scene(len(means), 0), means=means)
    path = tmp_path / "a.compressed.ply"
    scene_writer(path)(scene)
    # Positions have 11, 10 and 11 bits: bounds of the whole scene would leave 0.35 / 1023 on average.
    distances, index = cKDTree(means).query(load_scene(path).means)
    assert len(np.unique(index)) == len(means)
    assert distances.mean() < 0.2 / 1023


def test_a_large_scene_is_stored_more_coarsely(tmp_path, caplog):
    scene = random_scene(50)
    scene.means[3] = (10000, -9000, 1)
    spz.save(tmp_path / "a.spz", scene)
    assert "large for SPZ" in caplog.text
    back = in_order_of(scene, spz.load(tmp_path / "a.spz"))
    assert np.abs(back.means - scene.means).max() <= 0.5 / 512
    scene.means[3] = 1e8
    with pytest.raises(DataError, match="cannot hold"):
        spz.save(tmp_path / "b.spz", scene)
    assert not (tmp_path / "b.spz").exists()


@pytest.mark.parametrize(("flag", "said"), [(1, "antialiasing"), (2, "extensions")])
def test_flags_that_matter_are_said(tmp_path, data, caplog, flag, said):
    content = bytearray(gzip.decompress((data / "foreign" / "version_3.spz").read_bytes()))
    content[14] |= flag
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(bytes(content)))
    assert len(load_scene(path)) == 1500
    assert said in caplog.text


# ---------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("name", FOREIGN)
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
def test_damage_is_an_error_of_ours_or_does_not_matter(tmp_path, data, name, draw):
    content = bytearray((data / "foreign" / name).read_bytes())
    what = draw.draw(st.sampled_from(["truncate", "bytes", "header", "append"]))
    if what == "truncate":
        del content[draw.draw(st.integers(0, len(content) - 1)) :]
    elif what == "append":
        content += draw.draw(st.binary(max_size=100))
    else:
        last = min(len(content), 600 if what == "header" else len(content)) - 1
        for place in draw.draw(st.lists(st.integers(0, last), min_size=1, max_size=8)):
            content[place] = draw.draw(st.integers(0, 255))
    path = tmp_path / f"damaged{''.join(Path(name).suffixes)}"
    path.write_bytes(content)
    message = ""
    try:
        assert 0 < len(load_scene(path)) < 10000
    except PotrError as error:
        message = str(error)
    assert "\n" not in message
    assert not message or str(path) in message


def spz_header(splats, version=3, degree=3):
    return struct.pack("<4sIIBBBB", b"NGSP", version, splats, degree, 12, 0, 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not an SPZ file"),
        (b"ply\n" * 20, "not an SPZ file"),
        (gzip.compress(b"nothing"), "not an SPZ file"),
        (gzip.compress(spz_header(4_000_000_000)), "cannot hold"),
        (gzip.compress(spz_header(10)), "truncated"),
        (gzip.compress(spz_header(0)), "no splat"),
        (gzip.compress(spz_header(10, degree=4)), "SH degree 4"),
        (gzip.compress(spz_header(1000) + bytes(3_000_000)), "more than the splats"),
        (gzip.compress(spz_header(10, version=9) + bytes(650)), "version 9"),
        (spz_header(4_000_000_000, version=4) + bytes(100), "cannot hold"),
    ],
)
def test_bad_spz_files(tmp_path, content, message):
    path = tmp_path / "bad.spz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        load_scene(path)


def rewritten_sog(source, target, change):
    """A copy of a SOG file with another description."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "meta.json":
                meta = json.loads(content)
                change(meta)
                content = json.dumps(meta).encode()
            new.writestr(entry.filename, content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=1), "version 1"),
        (lambda m: m.pop("version"), "version 1"),
        (lambda m: m.update(count=-5), "a count of"),
        (lambda m: m.update(count=10**9), "pixels for 1000000000 splats"),
        (lambda m: m.pop("quats"), "quats"),
        (lambda m: m["scales"]["codebook"].pop(), "codebook"),
        (lambda m: m["shN"]["codebook"].__setitem__(0, "x"), "codebook"),
        (lambda m: m["shN"].update(bands=7), "7 bands"),
        (lambda m: m["shN"].update(bands=2), "palette"),
        (lambda m: m["shN"].update(count=60000), "palette"),
        (lambda m: m["means"].update(files=["../../etc/passwd", "x"]), "etc/passwd"),
        (lambda m: m["means"].update(mins=[1, 2]), "damaged"),
    ],
)
def test_bad_sog_files(tmp_path, data, change, message):
    rewritten_sog(data / "foreign" / "degree_3.sog", tmp_path / "bad.sog", change)
    with pytest.raises(DataError, match=message):
        sog.load(tmp_path / "bad.sog")


def test_a_sog_file_that_unpacks_to_far_more(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 24))
    with pytest.raises(DataError, match="far more than its size"):
        load_scene(tmp_path / "bomb.sog")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"element vertex 1500", b"element vertex 1501", "1500 rows"),
        (b"element chunk 6", b"element chunk 5", "5 chunks"),
        (b"property float min_r\n", b"", "older layout"),
        (b"property uchar f_rest_0\n", b"", "44 SH coefficients"),
        (b"binary_little", b"binary_big\x20\x20\x20", "no compressed PLY that can be read"),
        (b"element vertex 1500", b"element vertex 0000", "no splat"),
        (b"end_header", b"end_haeder", "damaged"),
    ],
)
def test_bad_compressed_ply_files(tmp_path, data, old, new, message):
    content = (data / "foreign" / "degree_3.compressed.ply").read_bytes()
    assert old in content
    path = tmp_path / "bad.compressed.ply"
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        load_scene(path)


def test_a_truncated_compressed_ply(tmp_path, data):
    path = tmp_path / "short.ply"  # the content tells the format, not the name
    path.write_bytes((data / "foreign" / "degree_3.compressed.ply").read_bytes()[:-1])
    with pytest.raises(DataError, match="truncated"):
        load_scene(path)


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_no_file(tmp_path, name):
    with pytest.raises(UsageError, match="cannot open"):
        load_scene(tmp_path / name)
    (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match="not a regular file"):
        load_scene(tmp_path / name)


def test_a_missing_library_is_named(tmp_path, data, lego_excerpt, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] == "gsply":
            raise ImportError("No module named 'gsply'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    for name in ("version_3.spz", "degree_3.sog", "degree_3.compressed.ply"):
        with pytest.raises(UsageError, match=r"potr-cl\[convert\]"):
            load_scene(data / "foreign" / name)
    with pytest.raises(UsageError, match=r"potr-cl\[convert\]"):
        scene_writer(tmp_path / "x.spz")(lego_excerpt)
    assert not list(tmp_path.iterdir())


# -------------------------------------------------------------------------------------------- command line


def test_convert_there_and_back(tmp_path, data, lego_excerpt, capsys):
    potr, small, back = tmp_path / "a.potr", tmp_path / "a.spz", tmp_path / "b.ply"
    assert main(["convert", str(data / "lego_excerpt.ply"), str(small)]) == 0
    assert "1500 splats" in capsys.readouterr().out
    encode = ["encode", str(small), "-o", str(potr), "--no-prune", "--refit", "off", "--no-compact", "--no-quality"]
    assert main(encode) == 0
    assert main(["convert", str(potr), str(back)]) == 0
    assert len(ply.load(back)) == 1500


@pytest.mark.parametrize(
    ("output", "said"),
    [("a.potr", "command encode"), ("a.sog", "written as"), ("a", "written as"), ("no/a.spz", "does not exist")],
)
def test_convert_tells_what_it_cannot_do(tmp_path, data, capsys, output, said):
    assert main(["convert", str(data / "lego_excerpt.ply"), str(tmp_path / output)]) == 2
    assert said in capsys.readouterr().err


def test_convert_does_not_replace_its_input(tmp_path, data, capsys):
    shutil.copy(data / "lego_excerpt.ply", tmp_path / "a.ply")
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.ply")]) == 2
    assert "replaced by itself" in capsys.readouterr().err
