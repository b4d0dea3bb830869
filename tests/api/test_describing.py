"""What info and compare tell of scenes in one file, in a gzipped one, in a folder of files, in memory."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import pytest

import potr_cl
from potr_cl import DataError, UsageError
from potr_cl.api.comparing import named
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats import save_scene
from potr_cl.quality.compare import size_report
from tests.reference.scenes import random_scene


def test_a_scene_in_many_files_is_as_large_as_all_of_them(data: Path) -> None:
    folder = data / "other_tools" / "splat-transform_lod"
    whole = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    for given in (folder, f"{folder}#1", folder / "lod-meta.json", f"{folder}/lod-meta.json#1"):
        found = potr_cl.info(given)
        assert (found["bytes"], found["format"]) == (whole, "streamed SOG")
    assert named(f"{folder}#1", random_scene(3)).nbytes == whole


def test_gzipped_scenes(tmp_path: Path) -> None:
    save_scene(tmp_path / "a.ply", random_scene(40, 1))
    pieces = code_scene(random_scene(30, 1), HyperParameters.from_quality(0.5, "best")).pieces
    (tmp_path / "b.potr").write_bytes(b"".join(pieces))
    for name in ("a.ply", "b.potr"):
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress((tmp_path / name).read_bytes()))
    found = potr_cl.info(tmp_path / "a.ply.gz")
    assert (found["splats"], found["format"]) == (40, potr_cl.info(tmp_path / "a.ply")["format"])
    assert (found["file"], found["bytes"]) == (str(tmp_path / "a.ply.gz"), (tmp_path / "a.ply.gz").stat().st_size)
    plain, packed = potr_cl.info(tmp_path / "b.potr"), potr_cl.info(tmp_path / "b.potr.gz")
    assert packed.facts | {"file": plain["file"]} == plain.facts


def test_errors_name_what_was_given(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"the folder '.*empty' has no scene"):
        potr_cl.info(tmp_path / "empty")
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(b"ply\nformat"))
    with pytest.raises(DataError, match=r"'.*/a\.ply\.gz'"):
        potr_cl.info(tmp_path / "a.ply.gz")
    (tmp_path / "b.potr").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n")
    with pytest.raises(DataError, match="git lfs pull"):
        potr_cl.info(tmp_path / "b.potr")


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_comparison_tells_which_scenes_are_antialiased(antialiased: bool) -> None:
    scene = replace(random_scene(5), antialiased=antialiased)
    report = size_report(named(scene, scene), named("gone.ply", scene))
    assert [report[which]["antialiased"] for which in "ab"] == [antialiased] * 2
