"""SPZ: every property to its step, large scenes, flags, and bad files."""

from __future__ import annotations

import gzip
import struct
import time
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from potr_cl.errors import DataError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import spz
from potr_cl.formats.scenes.scene_files import arranged
from potr_cl.host.inputs import FREE_SPLATS
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings
from tests.cases.scenes import in_order_of, turned_by
from tests.reference.scenes import random_scene


@pytest.mark.parametrize(("version", "degree"), [(3, 0), (3, 1), (4, 2), (3, 3), (4, 3)])
def test_spz_keeps_every_property_to_its_step(tmp_path, version, degree):
    scene = random_scene(300, degree, seed=degree)
    spz.save(tmp_path / "a.spz", scene, version)
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


def test_version_2_keeps_every_shape_to_its_step(tmp_path):
    """Its rotations may be those of another numbering of a splat's axes: the shape is the same, so that is compared."""
    scene = random_scene(700, 1)
    spz.save(tmp_path / "a.spz", scene)  # version 2 is the usual one
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[4] == 2
    back = in_order_of(scene, spz.load(tmp_path / "a.spz"))
    thick = replace(scene, log_scales=np.clip(scene.log_scales, -10, 5.9375))  # what a byte can say
    angles, differences = turned_by(thick, back)
    # Half a step of 1/127.5 in each of three parts, of a quaternion whose real part is at least 0.85.
    assert angles.max() <= 2 * np.sqrt(3) * 0.5 / 127.5 / 0.85
    assert np.abs(differences).max() <= 0.5 / 16 + 1e-5


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


def spz_header(splats, version=3, degree=3, flags=0):
    return struct.pack("<4sIIBBBB", b"NGSP", version, splats, degree, 12, flags, 0)


def packed(path, *content):
    path.write_bytes(gzip.compress(b"".join(content), 1))
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not an SPZ file"),
        (b"ply\n" * 20, "not an SPZ file"),
        (gzip.compress(b"nothing"), "not an SPZ file"),
        (gzip.compress(spz_header(4_000_000_000)), "--trust"),
        (gzip.compress(spz_header(10)), "truncated"),
        (gzip.compress(spz_header(0)), "no splat"),
        (gzip.compress(spz_header(10, degree=5)), "SH degree 5"),
        (gzip.compress(spz_header(1, degree=0) + bytes(1 << 24), 1), "more than the splats"),
        (gzip.compress(spz_header(10, version=9) + bytes(650)), "version 9"),
        (spz_header(4_000_000_000, version=4) + bytes(100), "--trust"),
    ],
    # Not by the content: gzip puts the time into it, and test runners that share out tests compare these names.
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_bad_spz_files(tmp_path, content, message):
    path = tmp_path / "bad.spz"
    path.write_bytes(content)
    with takes_at_most(4 << 20), pytest.raises(DataError, match=message):
        load_scene(path, trust="trust" not in message)


def test_a_scene_has_the_same_bytes_whenever_it_is_written(tmp_path, monkeypatch):
    """And nothing is written but beside the file: what is killed meanwhile leaves no folder elsewhere."""
    monkeypatch.setattr("tempfile.mkdtemp", lambda *args, **kwargs: pytest.fail("a temporary folder was made"))
    for splats in (300, 40_000):  # deflated as one, and in parts
        scene = random_scene(splats, 2)
        for day in (1, 2):
            monkeypatch.setattr(time, "time", lambda day=day: 86400.0 * day)
            spz.save(tmp_path / f"{day}.spz", scene)
        first, second = ((tmp_path / f"{day}.spz").read_bytes() for day in (1, 2))
        assert first == second
        assert len(gzip.decompress(first)) == 16 + splats * (16 + 3 + 24)


def test_properties_are_deflated_as_they_pack_best_on_any_number_of_processors(tmp_path, plush_excerpt, monkeypatch):
    path, written = tmp_path / "a.spz", set()
    spz.save(path, plush_excerpt)
    assert path.stat().st_size < len(gzip.compress(gzip.decompress(path.read_bytes()), 6))
    for count in (1, 3, 16):
        monkeypatch.setattr("os.cpu_count", lambda count=count: count)
        spz.save(path, plush_excerpt, 4)
        written.add(path.read_bytes())
    assert len(written) == 1


def test_content_and_values_are_those_of_another_program(tmp_path, data):
    gsply = pytest.importorskip("gsply")
    other = pytest.importorskip("gsply.spz")
    scene = random_scene(1000, 3)
    spz.save(tmp_path / "ours.spz", scene, version=3)
    *given, sh = arranged(scene).arrays
    names = dict(zip(("means", "scales", "quats", "opacities"), given, strict=True))
    sh0, rest = np.ascontiguousarray(sh[:, 0]), np.ascontiguousarray(sh[:, 1:])
    arrays = gsply.GSData.from_arrays(**names, sh0=sh0, shN=rest, format="ply")
    other.write_spz(tmp_path / "theirs.spz", arrays, version=3, fractional_bits=12)
    ours, theirs = (gzip.decompress((tmp_path / name).read_bytes()) for name in ("ours.spz", "theirs.spz"))
    assert len(ours) == len(theirs)
    assert sum(a != b for a, b in zip(ours, theirs, strict=True)) <= 2  # ties that rounding breaks either way
    written = [tmp_path / f"{version}.spz" for version in (2, 3, 4)]
    for version, path in enumerate(written, 2):
        spz.save(path, scene, version)
    for path in (*written, *(data / "foreign" / name for name in ("version_3.spz", "version_4.spz", "degree_1.spz"))):
        expected, got = other.read_spz(path), spz.load(path)
        assert np.array_equal(got.means, expected.means)
        assert np.array_equal(got.log_scales, expected.scales)
        assert np.abs(got.quaternions - expected.quats).max() < 1e-6
        assert np.abs(got.opacity_logits - expected.opacities).max() < 1e-4
        assert np.abs(got.sh[:, 0] - expected.sh0).max() < 1e-6
        assert np.array_equal(got.sh[:, 1:], expected.shN)


@pytest.mark.parametrize("version", [1, 2])
def test_rotations_and_extensions_of_old_versions(tmp_path, caplog, version):
    body = bytes(6 if version == 1 else 9) + bytes([255, 0, 0, 0]) + bytes(3) + bytes([255, 128, 127])
    scene = load_scene(packed(tmp_path / "a.spz", spz_header(1, version, 0, flags=2), body))
    assert scene.quaternions[0] == pytest.approx([0, 1, 1 / 255, -1 / 255], abs=1e-6)
    assert "extensions" in caplog.text


def version_4(splats, frames, degree=0, table=None):
    """A file of version 4 from its frames and what its table says of each."""
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, splats, degree, 12, 0, len(frames), 32)
    said = table or [(len(frame), 0) for frame in frames]
    return header + b"".join(struct.pack("<QQ", *entry) for entry in said) + b"".join(frames)


#: The bytes of a splat in each frame of version 4.
SIZES = (9, 1, 3, 3, 4)


@pytest.mark.parametrize("version", [3, 4])
def test_small_files_of_countless_splats(tmp_path, version):
    splats, path = FREE_SPLATS + 100_000, tmp_path / "a.spz"
    if version == 3:
        packed(path, spz_header(splats, degree=0), bytes(20 * splats))
    else:
        frames = [zstandard.compress(bytes(size * splats)) for size in SIZES]
        table = [(len(frame), size * splats) for frame, size in zip(frames, SIZES, strict=True)]
        path.write_bytes(version_4(splats, frames, table=table))
    with takes_at_most(1 << 20), pytest.raises(DataError, match=r"165536 splats in \d+ bytes .*--trust"):
        load_scene(path)
    assert len(load_scene(path, trust=True)) == splats


def test_a_frame_larger_than_its_table_says(tmp_path):
    """The frame's own claim is one more that a library would believe."""
    good = [zstandard.compress(bytes(size)) for size in SIZES]
    for at in range(5):
        frames = [*good[:at], zstandard.compress(bytes(1 << 24)), *good[at + 1 :]]
        table = [(len(frame), size) for frame, size in zip(frames, SIZES, strict=True)]
        (tmp_path / "a.spz").write_bytes(version_4(1, frames, table=table))
        with takes_at_most(1 << 22), pytest.raises(DataError, match="a stream of it is not as large"):
            load_scene(tmp_path / "a.spz", trust=True)


def test_values_beyond_bytes_give_no_warning(tmp_path):
    scene = random_scene(20, 1)
    scene.log_scales[0] = (3e38, -3e38, 1e30)
    scene.sh[1] = 3e38
    scene.quaternions[2] = (3e38, -3e38, 3e38, 3e38)
    with no_warnings():
        spz.save(tmp_path / "a.spz", scene)
        assert len(spz.load(tmp_path / "a.spz")) == 20


@pytest.mark.parametrize("version", [2, 3, 4])
def test_coefficients_of_degree_4_are_left_out(tmp_path, caplog, version):
    count, rng = 40, np.random.default_rng(version)
    sizes = (9, 1, 3, 3, 3 if version < 3 else 4)
    parts = [rng.integers(0, 256, (count, size), np.uint8) for size in sizes]
    rest = rng.integers(0, 256, (count, 24, 3), np.uint8)
    scenes = []
    for degree, kept in ((3, 15), (4, 24)):
        content = [part.tobytes() for part in (*parts, rest[:, :kept])]
        path = tmp_path / f"{degree}.spz"
        if version < 4:
            packed(path, spz_header(count, version, degree), *content)
        else:
            table = [(len(zstandard.compress(part)), len(part)) for part in content]
            path.write_bytes(version_4(count, [zstandard.compress(part) for part in content], degree, table))
        scenes.append(load_scene(path))
    assert scenes[0] == scenes[1]
    assert [r.getMessage() for r in caplog.records] == [
        f"'{path}': SH degree 4 is left out: only degrees 0 to 3 are kept"
    ]


@pytest.mark.parametrize("version", [1, 2, 3])
def test_content_that_is_not_gzipped(tmp_path, version):
    content = spz_header(100, version, 1) + np.random.default_rng(0).bytes(100 * ((16, 19, 20)[version - 1] + 9))
    raw = tmp_path / "raw.spz"
    raw.write_bytes(content)
    assert load_scene(packed(tmp_path / "packed.spz", content)) == load_scene(raw)
    for bad, said in (
        (content[:-1], "truncated"),
        (content[:20], "truncated"),
        (content + b"0", "more than the splats"),
        (spz_header(4_000_000_000, version, 1) + bytes(1000), "--trust"),
    ):
        raw.write_bytes(bad)
        with pytest.raises(DataError, match=said):
            load_scene(raw)


def test_positions_of_version_1_are_half_floats(tmp_path):
    """As Niantic's library reads them, and gaussforge and spz-js with it."""
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(70, 3)).astype("<f2")
    body = positions.tobytes() + rng.bytes(70 * 10)
    scene = load_scene(packed(tmp_path / "a.spz", struct.pack("<4sIIBBBB", b"NGSP", 1, 70, 0, 0, 0, 0), body))
    assert np.array_equal(scene.means, positions.astype(np.float32))
    rows = np.frombuffer(body[420:], np.uint8)
    assert np.array_equal(scene.log_scales, rows[280:490].reshape(70, 3) / np.float32(16) - 10)
