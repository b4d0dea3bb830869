"""Scenes that are gzipped, and Git-LFS pointers."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from potr_cl import DataError, UsageError
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats import load_cameras, load_scene, save_scene
from potr_cl.formats.images import image_size
from tests.cases.memory import takes_at_most
from tests.reference.scenes import random_scene


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def gzipped(path: Path, content: bytes) -> Path:
    path.write_bytes(gzip.compress(content))
    return path


@pytest.mark.parametrize("name", ["a.ply.gz", "a.PLY.GZ", "a.spz.gz", "b.c.ply.gz", "a.potr.gz"])
def test_what_is_unpacked_is_read(name: str, tmp_path: Path, temporary: Path) -> None:
    plain = tmp_path / name[:-3].lower()
    if plain.suffix == ".potr":
        coded = code_scene(random_scene(300, 1), HyperParameters.from_quality(0.5, "best"))
        plain.write_bytes(b"".join(coded.pieces))
    else:
        save_scene(plain, random_scene(500, 2))
    assert load_scene(gzipped(tmp_path / name, plain.read_bytes())) == load_scene(plain)
    assert not list(temporary.iterdir())


@pytest.mark.parametrize("name", ["a.gz", "a.obj.gz", "ply.gz", "meta.json.gz"])
def test_formats_that_are_not_known(name: str, tmp_path: Path) -> None:
    with pytest.raises((UsageError, DataError)) as caught:
        load_scene(gzipped(tmp_path / name, b"abc"))
    assert str(tmp_path / name) in str(caught.value)


def test_messages_and_warnings_name_the_file(tmp_path: Path, temporary: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene, path = random_scene(10), tmp_path / "a.ply.gz"
    scene.means[3] = np.nan
    save_scene(tmp_path / "a.ply", scene)
    content = (tmp_path / "a.ply").read_bytes()
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
def zeros() -> bytes:
    return gzip.compress(bytes(1 << 25), 9)


@pytest.mark.parametrize(("suffix", "most"), [(".ply", 18 << 20), (".potr", 1 << 18), (".spz", 1 << 18)])
def test_little_that_unpacks_to_much(suffix: str, most: int, zeros: bytes, tmp_path: Path, temporary: Path) -> None:
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


def test_no_room_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_scene(tmp_path / "a.ply", random_scene(100))
    path = gzipped(tmp_path / "a.ply.gz", (tmp_path / "a.ply").read_bytes())
    monkeypatch.setenv("TMPDIR", str(tmp_path / "gone"))
    for name in ("TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    assert len(load_scene(path)) == 100  # the system has another place


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "a.potr", "a.splat", "a.ksplat", "a.glb", "a.ply.gz"])
def test_git_lfs_pointers(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(DataError, match="is a Git-LFS pointer, not the file itself: run 'git lfs pull'"):
        load_scene(tmp_path / name)


def test_git_lfs_pointers_for_others(tmp_path: Path, data: Path) -> None:
    (tmp_path / "meta.json").write_bytes((data / "other_tools" / "splat-transform_sog" / "meta.json").read_bytes())
    for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels"):
        (tmp_path / f"{name}.webp").write_bytes(POINTER)
    for name, read in (("cameras.json", load_cameras), ("a.png", image_size), (".", load_scene)):
        if name != ".":
            (tmp_path / name).write_bytes(POINTER)
        with pytest.raises(DataError, match="git lfs pull"):
            read(tmp_path / name)
