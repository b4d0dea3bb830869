"""SPZ: every property to its step, large scenes, flags, and bad files."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import pytest

from potr_cl.errors import DataError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import spz
from potr_cl.reference.scenes import random_scene
from tests.cases.scenes import in_order_of

pytest.importorskip("gsply", reason="the extra convert is not installed")


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
    # Not by the content: gzip puts the time into it, and test runners that share out tests compare these names.
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_bad_spz_files(tmp_path, content, message):
    path = tmp_path / "bad.spz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        load_scene(path)
