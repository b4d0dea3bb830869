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


@pytest.mark.parametrize("name", ["a.ply.gz", "a.PLY.GZ", "a.spz.gz", "b.c.ply.gz"])
def test_what_is_unpacked_is_read(name: str, tmp_path: Path, temporary: Path) -> None:
    plain = tmp_path / name[:-3].lower()
    save_scene(plain, random_scene(500, 2))
    (tmp_path / name).write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(load_scene(tmp_path / name).sh, load_scene(plain).sh)
    assert not list(temporary.iterdir())


def test_a_potr_file(tmp_path: Path) -> None:
    content = b"".join(code_scene(random_scene(300, 1), HyperParameters.from_quality(0.5, "best")).pieces)
    (tmp_path / "a.potr").write_bytes(content)
    (tmp_path / "a.potr.gz").write_bytes(gzip.compress(content))
    np.testing.assert_array_equal(load_scene(tmp_path / "a.potr.gz").means, load_scene(tmp_path / "a.potr").means)


@pytest.mark.parametrize("name", ["a.gz", "a.obj.gz", "ply.gz", "meta.json.gz"])
def test_formats_that_are_not_known(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(gzip.compress(b"abc"))
    with pytest.raises((UsageError, DataError)) as caught:
        load_scene(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)


def test_messages_and_warnings_name_the_file(tmp_path: Path, temporary: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = random_scene(10)
    scene.means[3] = np.nan
    save_scene(tmp_path / "a.ply", scene)
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(content))
    assert len(load_scene(tmp_path / "a.ply.gz")) == 9
    assert [r.getMessage() for r in caplog.records] == [
        f"'{tmp_path / 'a.ply.gz'}': dropped 1 splats with non-finite values"
    ]
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(content[:-1]))
    with pytest.raises(DataError, match="truncated") as caught:
        load_scene(tmp_path / "a.ply.gz")
    assert str(caught.value).startswith(f"'{tmp_path / 'a.ply.gz'}'")
    assert str(temporary) not in str(caught.value)
    assert not list(temporary.iterdir())


def test_damage(tmp_path: Path, temporary: Path) -> None:
    save_scene(tmp_path / "a.ply", random_scene(100))
    content = gzip.compress((tmp_path / "a.ply").read_bytes())
    for bad in (b"", content[:5], content[:-3], content[:200], b"ply\n" * 20, content[:-8] + bytes(8)):
        (tmp_path / "a.ply.gz").write_bytes(bad)
        with pytest.raises(DataError, match=r"'.*a\.ply\.gz'"):
            load_scene(tmp_path / "a.ply.gz")
    assert not list(temporary.iterdir())


@pytest.mark.parametrize(("suffix", "most"), [(".ply", 18 << 20), (".potr", 1 << 18), (".spz", 1 << 18)])
def test_little_that_unpacks_to_much(suffix: str, most: int, tmp_path: Path, temporary: Path) -> None:
    path = tmp_path / f"a{suffix}.gz"
    path.write_bytes(gzip.compress(bytes(1 << 26), 9))
    assert path.stat().st_size < 1 << 17
    said = pytest.raises(DataError, match=r"unpacks to more than (\d+) bytes.*--trust")
    with takes_at_most(8 << 20), said as caught:
        load_scene(path)
    assert int(str(caught.value).split("more than ")[1].split()[0]) < most
    assert not list(temporary.iterdir())
    with pytest.raises(DataError, match=r"not a PLY|not a \.potr|SPZ"):
        load_scene(path, trust=True)


def test_no_room_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_scene(tmp_path / "a.ply", random_scene(100))
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress((tmp_path / "a.ply").read_bytes()))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "gone"))
    for name in ("TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    assert len(load_scene(tmp_path / "a.ply.gz")) == 100  # the system has another place


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "a.potr", "a.splat", "a.ksplat", "a.glb", "a.ply.gz"])
def test_git_lfs_pointers(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(DataError, match="is a Git-LFS pointer, not the file itself: run 'git lfs pull'"):
        load_scene(tmp_path / name)


def test_git_lfs_pointers_for_others(tmp_path: Path, data: Path) -> None:
    (tmp_path / "cameras.json").write_bytes(POINTER)
    with pytest.raises(DataError, match="git lfs pull"):
        load_cameras(tmp_path / "cameras.json")
    (tmp_path / "a.png").write_bytes(POINTER)
    with pytest.raises(DataError, match="git lfs pull"):
        image_size(tmp_path / "a.png")
    (tmp_path / "meta.json").write_bytes((data / "other_tools" / "splat-transform_sog" / "meta.json").read_bytes())
    for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_centroids", "shN_labels"):
        (tmp_path / f"{name}.webp").write_bytes(POINTER)
    with pytest.raises(DataError, match="git lfs pull"):
        load_scene(tmp_path)
