"""How scenes come: gzipped, through pipes, as Git-LFS pointers, in several files; and how large they are on disk."""

from __future__ import annotations

import gzip
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from potr_cl import DataError, UsageError
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats import load_cameras, load_scene, registry, save_scene, streams
from potr_cl.formats.images import image_size
from potr_cl.formats.registry import bytes_of_scene
from potr_cl.formats.scenes import ply
from tests.cases.gltf import attributes, described, glb, gltf
from tests.cases.memory import takes_at_most
from tests.reference.scenes import random_scene


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def gzipped(path: Path, content: bytes) -> Path:
    path.write_bytes(gzip.compress(content))
    return path


def written(folder: Path, suffix: str) -> bytes:
    path = folder / f"a{suffix}"
    if suffix == ".potr":
        coded = code_scene(random_scene(300, 1), HyperParameters.from_quality(0.5, "best"))
        path.write_bytes(b"".join(coded.pieces))
    else:
        save_scene(path, random_scene(50, 1))
    return path.read_bytes()


def with_a_bad_splat(folder: Path) -> bytes:
    scene = random_scene(10)
    scene.means[3] = np.nan
    save_scene(folder / "bad.ply", scene)
    return (folder / "bad.ply").read_bytes()


@pytest.mark.parametrize("name", ["a.ply.gz", "a.PLY.GZ", "a.spz.gz", "b.c.ply.gz", "a.potr.gz"])
def test_what_is_unpacked_is_read(name, tmp_path, temporary):
    suffix = Path(name[:-3].lower()).suffix
    path = gzipped(tmp_path / name, written(tmp_path, suffix))
    assert load_scene(path) == load_scene(tmp_path / f"a{suffix}")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("name", ["a.gz", "a.obj.gz", "ply.gz", "meta.json.gz"])
def test_formats_that_are_not_known(name, tmp_path):
    with pytest.raises((UsageError, DataError)) as caught:
        load_scene(gzipped(tmp_path / name, b"abc"))
    assert str(tmp_path / name) in str(caught.value)


def test_messages_and_warnings_name_the_file(tmp_path, temporary, caplog):
    path, content = tmp_path / "a.ply.gz", with_a_bad_splat(tmp_path)
    assert len(load_scene(gzipped(path, content))) == 9
    assert [r.getMessage() for r in caplog.records] == [f"'{path}': dropped 1 splats with non-finite values"]
    with pytest.raises(DataError, match="truncated") as caught:
        load_scene(gzipped(path, content[:-1]))
    assert str(caught.value).startswith(f"'{path}'")
    assert str(temporary) not in str(caught.value)
    packed = gzip.compress(content)
    for bad in (b"", packed[:5], packed[:-3], packed[:200], b"ply\n" * 20, packed[:-8] + bytes(8)):
        path.write_bytes(bad)
        with pytest.raises(DataError, match=r"'.*a\.ply\.gz'"):
            load_scene(path)
    assert not list(temporary.iterdir())


@pytest.fixture(scope="module")
def zeros():
    return gzip.compress(bytes(1 << 25), 9)


@pytest.mark.parametrize(("suffix", "most"), [(".ply", 18 << 20), (".potr", 1 << 18), (".spz", 1 << 18)])
def test_little_that_unpacks_to_much(suffix, most, zeros, tmp_path, temporary):
    path = tmp_path / f"a{suffix}.gz"
    path.write_bytes(zeros)
    assert path.stat().st_size < 1 << 16
    said = pytest.raises(DataError, match=r"unpacks to more than (\d+) bytes.*--trust")
    with takes_at_most(8 << 20), said as caught:
        load_scene(path)
    assert int(str(caught.value).split("more than ")[1].split()[0]) < most
    assert not list(temporary.iterdir())
    with pytest.raises(DataError, match=r"not a PLY|not a \.potr|SPZ"):
        load_scene(path, trust=True)


def test_no_room_for_it(tmp_path, monkeypatch):
    path = gzipped(tmp_path / "a.ply.gz", written(tmp_path, ".ply"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "gone"))
    for name in ("TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    assert len(load_scene(path)) == 50  # the system has another place


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "a.potr", "a.splat", "a.ksplat", "a.glb", "a.ply.gz"])
def test_git_lfs_pointers(name, tmp_path):
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(DataError, match="is a Git-LFS pointer, not the file itself: run 'git lfs pull'"):
        load_scene(tmp_path / name)


def test_git_lfs_pointers_for_others(tmp_path, data):
    (tmp_path / "meta.json").write_bytes((data / "other_tools" / "splat-transform_sog" / "meta.json").read_bytes())
    for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels"):
        (tmp_path / f"{name}.webp").write_bytes(POINTER)
    for name, read in (("cameras.json", load_cameras), ("a.png", image_size), (".", load_scene)):
        if name != ".":
            (tmp_path / name).write_bytes(POINTER)
        with pytest.raises(DataError, match="git lfs pull"):
            read(tmp_path / name)


# Streams -------------------------------------------------------------------------------------------------------------


class Dripping(io.BytesIO):
    """A stream that gives few bytes at a time, as pipes do."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(min(7, size) if size is not None and size >= 0 else 7)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
@pytest.mark.parametrize("kind", [io.BytesIO, Dripping])
def test_the_content_tells_the_format(tmp_path, suffix, kind):
    with streams.received(kind(written(tmp_path, suffix))) as path:
        scene = load_scene(path)
    assert scene == load_scene(tmp_path / f"a{suffix}")
    assert not path.parent.exists()


def test_what_a_gzip_stream_unpacks_to_tells_the_format(tmp_path):
    for suffix, packed in ((".ply", ".ply.gz"), (".spz", ".spz")):
        content = written(tmp_path, suffix)
        start = content if content.startswith(b"\x1f\x8b") else gzip.compress(content)
        assert registry.suffix_of_content(start[: registry.START_BYTES], "stream") == packed
    for damaged in (b"\x1f\x8b", b"\x1f\x8b" + bytes(100), gzip.compress(b"no scene")):
        with pytest.raises(DataError, match="no scene that is known"):
            registry.suffix_of_content(damaged, "stream")


def test_names_of_scenes_without_their_suffixes():
    for name in ("a.ply", "b/a.compressed.ply", "a.PLY.gz", "a/meta.json", "a/lod-meta.json#2", "b/a#1"):
        assert registry.stem_of_scene(Path(name)) == "a"
    assert registry.stem_of_scene(Path("v1.2.ply")) == "v1.2"


def test_a_stream_has_an_end(tmp_path, monkeypatch):
    content = written(tmp_path, ".ply")
    with pytest.raises(UsageError, match="no suffix of a scene"), streams.received(io.BytesIO(b"x"), ".xyz"):
        pytest.fail("it was taken")
    monkeypatch.setattr(streams, "MOST_BYTES", len(content) - 1)
    with pytest.raises(DataError, match="more than"), streams.received(io.BytesIO(content)):
        pytest.fail("it was taken")


@pytest.mark.parametrize("packed", [bytes, gzip.compress])
def test_warnings_and_errors_speak_of_the_stream(tmp_path, packed, caplog):
    content = with_a_bad_splat(tmp_path)
    with streams.received(io.BytesIO(packed(content))) as path:
        assert len(load_scene(path)) == 9
    assert [r.getMessage() for r in caplog.records] == ["the standard input: dropped 1 splats with non-finite values"]
    with (
        pytest.raises(DataError, match=r"^the standard input is truncated"),
        streams.received(io.BytesIO(packed(content[:-9]))) as path,
    ):
        load_scene(path)


def test_all_or_nothing_is_sent():
    scene, stream = random_scene(50, 1), io.BytesIO()
    assert streams.send(stream, ".ply", lambda path: ply.save(path, scene)) == len(stream.getvalue())
    assert stream.getvalue().startswith(b"ply\n")

    def failing(path):
        path.write_bytes(b"half of it")
        raise DataError("it cannot be held")

    stream = io.BytesIO()
    with pytest.raises(DataError):
        streams.send(stream, ".ply", failing)
    assert stream.getvalue() == b""


def test_no_two_formats_begin_alike():
    starts = [start for entry in registry.SCENE_FORMATS for start in entry.starts]
    assert all(len(start) <= registry.START_BYTES for start in starts)
    for one in starts:
        assert not any(other.startswith(one) for other in starts if other is not one)


# Sizes ---------------------------------------------------------------------------------------------------------------


def test_a_buffer_beside_a_gltf_file_counts_once(tmp_path):
    description, content = described(attributes(random_scene(20, 1)))
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    (tmp_path / "a.gltf").write_bytes(gltf(description, content, "a%20b.bin"))
    (tmp_path / "a b.bin").write_bytes(content)
    (tmp_path / "other.bin").write_bytes(content)
    assert bytes_of_scene(tmp_path / "a.gltf") == (tmp_path / "a.gltf").stat().st_size + len(content)
    assert bytes_of_scene(tmp_path / "a.glb") == (tmp_path / "a.glb").stat().st_size


@pytest.fixture
def levels(tmp_path, data):
    shutil.copytree(data / "other_tools" / "splat-transform_lod", tmp_path / "lod")
    return tmp_path / "lod"


def test_only_what_is_there_and_belongs_to_it_counts(levels, tmp_path):
    whole = sum(file.stat().st_size for file in levels.rglob("*") if file.is_file())
    (levels / "notes.json").write_text("{}")
    (levels / "picture.webp").write_bytes(bytes(1000))
    for given in (levels, f"{levels}#1", levels / "lod-meta.json", f"{levels}/lod-meta.json#0"):
        assert bytes_of_scene(given) == whole
    names = json.loads((levels / "lod-meta.json").read_text())["filenames"]
    folder = (levels / names[0]).parent
    gone = sum(file.stat().st_size for file in folder.iterdir())
    shutil.rmtree(folder)
    assert len(load_scene(f"{levels}#1")) > 0
    assert bytes_of_scene(f"{levels}#1") == whole - gone
    for nothing in (tmp_path, tmp_path / "gone.ply", tmp_path / "gone" / "meta.json", "a\0b.ply"):
        assert bytes_of_scene(nothing) is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{",
        b"[" * 100_000,
        b'{"tree": {}, "lodLevels": 1, "filenames": ["../../meta.json"]}',
        b'{"buffers": 1}',
        b'{"asset": {"version": "2.0"}, "buffers": [1, {"uri": "../x"}]}',
        b'{"a": {"files": [1, {}, "/etc/passwd"]}}',
    ],
)
@pytest.mark.parametrize("name", ["lod-meta.json", "meta.json", "a.gltf"])
def test_nothing_is_said_of_damaged_descriptions(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    size = bytes_of_scene(tmp_path / name)
    assert size is None or size == len(content)
