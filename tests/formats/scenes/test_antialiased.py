"""The marks of antialiased scenes in files: read from those of every tool, kept from each format to the next."""

from __future__ import annotations

import gzip
import json
import zipfile

import numpy as np
import pytest

from potr_cl.errors import DataError
from potr_cl.formats import load_scene, save_scene
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import LOW_PASS, MIP_SPLATTING_LOW_PASS, Scene
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.reference.scenes import random_scene
from tests.cases.scenes import antialiased

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def same(a: Scene, b: Scene) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)


def with_lines(path, scene, *lines, newline=b"\n", ascii_values=False):
    """A PLY with more lines behind the second one of its header."""
    ply.save(path, scene)
    head, end, values = path.read_bytes().partition(b"end_header\n")
    if ascii_values:
        rows = np.frombuffer(values, "<f4").reshape(len(scene), -1)
        values = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows).encode()
        head = head.replace(b"binary_little_endian", b"ascii")
    parts = head.splitlines()
    content = newline.join([*parts[:2], *lines, *parts[2:], end.strip(), b""])
    path.write_bytes(content + values)
    return path


# ------------------------------------------------------------------------------------------ PLY: comments


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        (["comment Exported from Brush", "comment SH degree: 3", "comment SplatRenderMode: mip"], True),
        (["comment SplatRenderMode: default"], False),
        (["comment SplatRenderMode: 2dgs"], False),
        (["comment splatrendermode:  MIP  "], True),
        (["comment SplatRenderMode mip"], True),
        (["comment antialiased 1"], True),
        (["comment antialiased 0"], False),
        (["comment postshot.anti_aliasing=1"], True),
        (["comment postshot.anti_aliasing=0"], False),
        (["comment antialiased 1", "comment SplatRenderMode: default"], False),
        (["comment SplatRenderMode: default", "comment antialiased 1"], True),
        (["obj_info SplatRenderMode: mip"], True),
        (["comment not antialiased 1"], False),
        (["comment SplatRenderMode: mipmap"], False),
        (["comment \xff\xfe SplatRenderMode: mip?"], False),
        (["comment"], False),
        ([], False),
    ],
)
def test_comments_of_other_tools(tmp_path, comments, expected):
    scene = random_scene(5, 1)
    lines = [comment.encode("latin-1") for comment in comments]
    for newline, text in ((b"\n", False), (b"\r\n", False), (b"\n", True)):
        back = load_scene(with_lines(tmp_path / "a.ply", scene, *lines, newline=newline, ascii_values=text))
        assert (back.antialiased, back.low_pass) == (expected, LOW_PASS)
        assert same(back, scene)


@pytest.mark.parametrize("keyword", [True, False])
def test_a_keyword_overrules_the_file(tmp_path, keyword):
    for line in (b"comment SplatRenderMode: mip", b"comment"):
        path = with_lines(tmp_path / "a.ply", random_scene(5, 1), line)
        assert load_scene(path, antialiased=keyword).antialiased is keyword
        assert load_scene(path, antialiased=None).antialiased is (line != b"comment")


def test_a_classic_scene_is_written_without_a_mark(tmp_path):
    ply.save(tmp_path / "a.ply", random_scene(3, 0))
    head = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[0]
    assert b"comment" not in head
    assert b"filter" not in head


# ------------------------------------------------------------------------------------------ PLY: filter_3D


def mip_splatting_ply(path, scene, filters, dtype="float"):
    """As Mip-Splatting's save_ply writes one: the original layout, and the filter behind it."""
    ply.save(path, scene)
    head, end, values = path.read_bytes().partition(b"end_header\n")
    width = 4 * (14 + 3 * scene.sh.shape[1])
    rows = np.frombuffer(values, np.uint8).reshape(len(scene), width)
    column = np.asarray(filters, {"float": "<f4", "double": "<f8"}[dtype]).reshape(-1, 1).view(np.uint8)
    body = np.hstack([rows, column]).tobytes()
    path.write_bytes(head + f"property {dtype} filter_3D\n".encode() + end + body)
    return path


@pytest.mark.parametrize("dtype", ["float", "double"])
def test_the_3d_filter_is_folded_in_as_their_fused_ply_does(tmp_path, caplog, dtype):
    """The formulas as the paper and their code have them, on activated values, in float64."""
    scene = random_scene(200, 1)
    filters = np.exp(np.random.default_rng(0).normal(-5, 2, 200)).astype(np.float32)
    back = load_scene(mip_splatting_ply(tmp_path / "a.ply", scene, filters, dtype))
    assert (back.antialiased, back.low_pass) == (True, MIP_SPLATTING_LOW_PASS)
    assert caplog.text == ""  # nothing is dropped
    squares = np.exp(2 * scene.log_scales.astype(np.float64))
    wider = squares + filters.astype(np.float64)[:, None] ** 2
    opacities = 1 / (1 + np.exp(-scene.opacity_logits.astype(np.float64)))
    fainter = opacities * np.sqrt(squares.prod(axis=1) / wider.prod(axis=1))
    assert (fainter < 0.1 * opacities).any()
    assert (fainter > 0.9 * opacities).any()
    np.testing.assert_allclose(back.log_scales, np.log(wider) / 2, rtol=2e-7, atol=1e-6)
    np.testing.assert_allclose(back.opacity_logits, np.log(fainter / (1 - fainter)), rtol=1e-6, atol=2e-6)
    for name in ("means", "quaternions", "sh"):
        assert np.array_equal(getattr(back, name), getattr(scene, name))


def test_a_filter_of_nothing_changes_no_bit(tmp_path):
    scene = random_scene(50, 1)
    assert same(load_scene(mip_splatting_ply(tmp_path / "a.ply", scene, np.zeros(50))), scene)


def test_filters_beyond_all_bounds(tmp_path, caplog):
    """Their splats are dropped, or nearly transparent; nothing else is touched, and no warning of NumPy appears."""
    scene = random_scene(8, 0)
    scene.log_scales[4:] = [[-200] * 3, [80] * 3, [-50, 0, 3], [-3] * 3]
    scene.opacity_logits[6:] = [-100, 100]
    filters = [np.nan, np.inf, -np.inf, -0.01, 1e-3, 1e30, 1e-30, 1e-20]
    back = load_scene(mip_splatting_ply(tmp_path / "a.ply", scene, filters))
    assert "dropped 3 splats" in caplog.text
    assert len(back) == 5
    assert all(np.isfinite(getattr(back, name)).all() for name in ARRAYS)
    assert back.opacities[1] < 1e-30  # 87 decades smaller than its filter


def test_a_mip_splatting_ply_there_and_back(tmp_path):
    """What is read is written with a filter of nothing, which Mip-Splatting's renderer, too, reads as it is."""
    filters = np.full(50, 0.01)
    scene = load_scene(mip_splatting_ply(tmp_path / "a.ply", random_scene(50, 2), filters))
    ply.save(tmp_path / "b.ply", scene)
    assert b"property float filter_3D\nend_header" in (tmp_path / "b.ply").read_bytes()
    back = load_scene(tmp_path / "b.ply")
    assert same(back, scene)
    assert (back.antialiased, back.low_pass) == (True, MIP_SPLATTING_LOW_PASS)
    no = load_scene(tmp_path / "b.ply", antialiased=False)
    assert (no.antialiased, no.low_pass) == (False, LOW_PASS)


# ------------------------------------------------------------------------------------------ other formats


@pytest.mark.parametrize("version", [3, 4])
def test_the_flag_of_spz(tmp_path, data, caplog, version):
    source = data / "foreign" / f"version_{version}.spz"
    content = source.read_bytes()
    packed = content[:2] == b"\x1f\x8b"
    content = bytearray(gzip.decompress(content) if packed else content)
    assert load_scene(source).antialiased is False
    content[14] |= 1
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(content)) if packed else bytes(content))
    assert load_scene(tmp_path / "a.spz").antialiased is True
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("model", "expected"), [("antialiased", True), ("2dgs", False), (["antialiased"], False), (None, False)]
)
def test_the_model_of_sog(tmp_path, data, model, expected):
    with zipfile.ZipFile(data / "foreign" / "degree_3.sog") as old, zipfile.ZipFile(tmp_path / "a.sog", "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "meta.json" and model is not None:
                content = json.dumps({**json.loads(content), "model": model}).encode()
            new.writestr(entry.filename, content)
    assert load_scene(tmp_path / "a.sog").antialiased is expected


@pytest.mark.parametrize("low_pass", [LOW_PASS, MIP_SPLATTING_LOW_PASS])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".compressed.ply"])
def test_what_is_written_keeps_the_mark(tmp_path, caplog, suffix, low_pass):
    if suffix == ".compressed.ply":
        pytest.importorskip("gsply", reason="the extra convert is not installed")
    path = tmp_path / f"a{suffix}"
    for scene in (antialiased(random_scene(300, 1), low_pass), random_scene(300, 1)):
        caplog.clear()
        save_scene(path, scene)
        back = load_scene(path)
        assert back.antialiased is scene.antialiased
        if suffix == ".ply":
            assert back.low_pass == scene.low_pass
        else:  # which cannot say it
            assert back.low_pass == LOW_PASS
            assert ("cannot say" in caplog.text) == (scene.low_pass != LOW_PASS)


@pytest.mark.parametrize("low_pass", [LOW_PASS, MIP_SPLATTING_LOW_PASS])
def test_through_a_file_of_our_own(tmp_path, low_pass):
    scene = antialiased(random_scene(300, 1), low_pass)
    options = EncodeOptions.for_preset("best", prune=False, compact=False, refit=False)
    (tmp_path / "a.potr").write_bytes(b"".join(encode(scene, None, options).pieces))
    back = load_scene(tmp_path / "a.potr")
    assert (back.antialiased, back.low_pass) == (True, low_pass)
    assert load_scene(tmp_path / "a.potr", antialiased=False).antialiased is False


def test_a_comment_does_not_hide_damage(tmp_path):
    path = with_lines(tmp_path / "a.ply", random_scene(5, 1), b"comment SplatRenderMode: mip")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DataError, match="truncated"):
        load_scene(path)
