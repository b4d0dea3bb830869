"""Compressed PLY: its bounds, and bad files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from potr_cl.codec import octree
from potr_cl.errors import DataError
from potr_cl.formats import load_scene, scene_writer
from potr_cl.formats.scenes.compressed_ply_values import CHUNK, in_chunks
from potr_cl.opencl.device import Device
from tests.cases.judging import psnr
from tests.reference.scenes import random_scene


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


def test_what_is_written_looks_as_the_scene_does(tmp_path, plush_excerpt, plush_excerpt_cameras):
    scene_writer(tmp_path / "a.compressed.ply")(plush_excerpt)
    scene = load_scene(tmp_path / "a.compressed.ply")
    assert psnr(Device(), plush_excerpt, scene, plush_excerpt_cameras) >= 59


def test_chunks_are_more_compact_than_runs_of_a_curve():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal(at, 0.3, (5000, 3)) for at in rng.uniform(-5, 5, (9, 3))]).astype(np.float32)
    means[::7, 1] = 0.25  # many alike

    def area(order):
        chunks = [means[order[start : start + CHUNK]] for start in range(0, len(means), CHUNK)]
        return sum(len(each) * (np.ptp(each, axis=0) ** 2).sum() for each in chunks)

    order = in_chunks(means, threads=1)
    assert np.array_equal(np.sort(order), np.arange(len(means)))
    assert np.array_equal(order, in_chunks(means, threads=3))
    assert area(order) < 0.7 * area(octree.leaf_order(means, 1e-6))


def foreign(data, degree=3) -> bytes:
    return (data / "foreign" / f"degree_{degree}.compressed.ply").read_bytes()


#: Headers of which one reader makes 256 splats and another one a million; the latter read beyond the file's values.
TWO_READINGS = {
    "two spaces": (b"element vertex 1500\n", b"element vertex 1500\nelement  vertex 1000000\n"),
    "two spaces first": (b"element vertex 1500\n", b"element  vertex 1000000\nelement vertex 1500\n"),
    "a tabulator": (b"element vertex 1500\n", b"element\tvertex 1500\n"),
    "a tabulator in front": (b"element vertex 1500\n", b"\telement vertex 1000000\nelement vertex 1500\n"),
    "blanks behind": (b"element vertex 1500\n", b"element vertex 1500 \n"),
    "a word behind": (b"element vertex 1500\n", b"element vertex 1500 1000000\n"),
    "the element again": (b"element sh 1500\n", b"element vertex 1000000\nelement sh 1500\n"),
    "another line end": (b"element vertex 1500\n", b"element vertex 1000000\relement vertex 1500\n"),
    "carriage returns": (b"element vertex 1500\n", b"element vertex 1500\r\n"),
    "a form feed": (b"element vertex 1500\n", b"element vertex 1000000\x0celement vertex 1500\n"),
    "digits of other scripts": (b"element vertex 1500\n", "element vertex 150٠\n".encode()),
    "a sign": (b"element vertex 1500\n", b"element vertex +1500\n"),
    "another type": (b"property uint packed_position\n", b"property uchar packed_position\n"),
    "another name": (b"property float min_x\n", b"property float min_w\n"),
    "coefficients out of order": (b"property uchar f_rest_0\nproperty uchar f_rest_1\n",
                                  b"property uchar f_rest_1\nproperty uchar f_rest_0\n"),
    "an element more": (b"element vertex 1500\n", b"element other 4\nproperty uchar a\nelement vertex 1500\n"),
    "a list": (b"property float min_x\n", b"property list uchar float min_x\n"),
}  # fmt: skip


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
        *(pytest.param(*pair, None, id=name) for name, pair in TWO_READINGS.items()),
    ],
)
def test_only_canonical_headers_are_read(tmp_path, data, old, new, message):
    content = foreign(data)
    assert old in content
    path = tmp_path / ("bad.ply" if message else "a.compressed.ply")  # the content tells the format, not the name
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(DataError, match=message) as caught:
        load_scene(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()
    path.write_bytes(content[:-1])
    with pytest.raises(DataError, match="truncated"):
        load_scene(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_values_are_those_of_another_program(data, degree):
    """It computes in other orders, and so rounds other last digits."""
    other = pytest.importorskip("gsply").decompress_from_bytes(bytearray(foreign(data, degree)))
    ours = load_scene(data / "foreign" / f"degree_{degree}.compressed.ply")
    for name, theirs in (("means", other.means), ("log_scales", other.scales), ("quaternions", other.quats)):
        np.testing.assert_allclose(getattr(ours, name), theirs, rtol=3e-7, atol=1e-6)
    np.testing.assert_allclose(ours.opacity_logits, other.opacities, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.sh[:, 0], other.sh0, atol=2e-6)
    np.testing.assert_allclose(ours.sh[:, 1:].ravel(), np.ravel(other.shN), atol=1e-6)


def test_comments_do_not_matter(tmp_path, data):
    """Not even one that looks like the end of the header."""
    for degree in (0, 3):
        content = foreign(data, degree)
        comments = b"comment end_header\ncomment \xff\nobj_info element vertex 9\ncomment\nelement chunk 6\n"
        path = tmp_path / "a.ply"
        path.write_bytes(content.replace(b"element chunk 6\n", comments, 1) + b"more")
        assert load_scene(path) == load_scene(data / "foreign" / f"degree_{degree}.compressed.ply")


def test_a_plain_ply_with_a_comment_about_compression_is_a_plain_one(tmp_path, data):
    content = (data / "plush_excerpt.ply").read_bytes()
    path = tmp_path / "a.ply"
    path.write_bytes(content.replace(b"ply\n", b"ply\ncomment no packed_position\n", 1))
    assert len(load_scene(path)) == 1500
