"""Scenes through pipes, as the package offers them to programs."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from potr_cl import DataError, load_scene
from potr_cl.errors import UsageError
from potr_cl.formats import registry, save_scene, streams
from potr_cl.formats.scenes import ply
from tests.reference.scenes import random_scene


class Dripping(io.BytesIO):
    """A stream that gives few bytes at a time, as pipes do."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(min(7, size) if size is not None and size >= 0 else 7)


def written(tmp_path: Path, suffix: str) -> bytes:
    save_scene(tmp_path / f"a{suffix}", random_scene(50, 1))
    return (tmp_path / f"a{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
@pytest.mark.parametrize("kind", [io.BytesIO, Dripping])
def test_the_content_tells_the_format(tmp_path: Path, suffix: str, kind: type[io.BytesIO]) -> None:
    with streams.received(kind(written(tmp_path, suffix))) as path:
        scene = load_scene(path)
    assert scene == load_scene(tmp_path / f"a{suffix}")
    assert not path.parent.exists()


def test_what_a_gzip_stream_unpacks_to_tells_the_format(tmp_path: Path) -> None:
    for suffix, packed in ((".ply", ".ply.gz"), (".spz", ".spz")):
        content = written(tmp_path, suffix)
        start = content if content.startswith(b"\x1f\x8b") else gzip.compress(content)
        assert registry.suffix_of_content(start[: registry.START_BYTES], "stream") == packed
    for damaged in (b"\x1f\x8b", b"\x1f\x8b" + bytes(100), gzip.compress(b"no scene")):
        with pytest.raises(DataError, match="no scene that is known"):
            registry.suffix_of_content(damaged, "stream")


def test_names_of_scenes_without_their_suffixes() -> None:
    for name in ("a.ply", "b/a.compressed.ply", "a.PLY.gz", "a/meta.json", "a/lod-meta.json#2", "b/a#1"):
        assert registry.stem_of_scene(Path(name)) == "a"
    assert registry.stem_of_scene(Path("v1.2.ply")) == "v1.2"


def test_a_stream_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = written(tmp_path, ".ply")
    with pytest.raises(UsageError, match="no suffix of a scene"), streams.received(io.BytesIO(b"x"), ".xyz"):
        pytest.fail("it was taken")
    monkeypatch.setattr(streams, "MOST_BYTES", len(content) - 1)
    with pytest.raises(DataError, match="more than"), streams.received(io.BytesIO(content)):
        pytest.fail("it was taken")


@pytest.mark.parametrize("packed", [bytes, gzip.compress])
def test_warnings_and_errors_speak_of_the_stream(
    tmp_path: Path, packed: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    scene = random_scene(10)
    scene.means[3] = np.nan
    save_scene(tmp_path / "a.ply", scene)
    content = (tmp_path / "a.ply").read_bytes()
    with streams.received(io.BytesIO(packed(content))) as path:
        assert len(load_scene(path)) == 9
    assert [r.getMessage() for r in caplog.records] == ["the standard input: dropped 1 splats with non-finite values"]
    with (
        pytest.raises(DataError, match=r"^the standard input is truncated"),
        streams.received(io.BytesIO(packed(content[:-9]))) as path,
    ):
        load_scene(path)


def test_all_or_nothing_is_sent() -> None:
    scene, stream = random_scene(50, 1), io.BytesIO()
    assert streams.send(stream, ".ply", lambda path: ply.save(path, scene)) == len(stream.getvalue())
    assert stream.getvalue().startswith(b"ply\n")

    def failing(path: Path) -> None:
        path.write_bytes(b"half of it")
        raise DataError("it cannot be held")

    stream = io.BytesIO()
    with pytest.raises(DataError):
        streams.send(stream, ".ply", failing)
    assert stream.getvalue() == b""


def test_no_two_formats_begin_alike() -> None:
    starts = [start for entry in registry.SCENE_FORMATS for start in entry.starts]
    assert all(len(start) <= registry.START_BYTES for start in starts)
    for one in starts:
        assert not any(other.startswith(one) for other in starts if other is not one)
