"""Files that other tools wrote are read as splat-transform reads them: every attribute, to rounding."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

from potr_cl import Scene, cli
from potr_cl.formats import load_scene

#: What is read, and how splat-transform 3.7.0 reads it, as a PLY.
FILES = {
    name: f"{name}.ply"
    for name in (
        "GaussianSplats3D_level_0.ksplat",
        "GaussianSplats3D_level_1.ksplat",
        "GaussianSplats3D_level_2.ksplat",
        "gaussforge.ksplat",
        "gaussforge.sog",
        "gaussforge.splat",
        "gaussforge_version_2.spz",
        "gaussforge_version_4.spz",
        "gsply_version_3.spz",
        "ply2splat.splat",
        "splat-transform.glb",
        "splat-transform.splat",
        "splat-transform_sog",
        "spz-js.spz",
    )
}
FILES["splat-transform_sog/meta.json"] = "splat-transform_sog.ply"


def assert_alike(scene: Scene, expected: Scene) -> None:
    """Every attribute the same to rounding; opacities where a logit's digits mean something."""
    assert scene.sh.shape == expected.sh.shape
    extent = np.abs(expected.means).max()
    np.testing.assert_allclose(scene.means, expected.means, rtol=0, atol=1e-6 * extent)
    np.testing.assert_allclose(scene.log_scales, expected.log_scales, rtol=0, atol=2e-6)
    unit, unit_expected = (
        q / np.linalg.norm(q, axis=1, keepdims=True) for q in (scene.quaternions, expected.quaternions)
    )
    np.testing.assert_allclose(unit, unit_expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(scene.opacities, expected.opacities, rtol=0, atol=1e-6)
    np.testing.assert_allclose(scene.sh, expected.sh, rtol=0, atol=1e-6)


@pytest.fixture
def tools(data):
    return data / "other_tools"


def as_splat_transform_reads(tools: Path, name: str) -> Scene:
    return load_scene(tools / "as_splat-transform_reads_it" / name)


@pytest.mark.parametrize("name", FILES)
def test_values_are_splat_transforms(name, tools, tmp_path, caplog):
    scene = load_scene(tools / name)
    assert not caplog.records  # nothing was lost, so nothing is said
    assert_alike(scene, as_splat_transform_reads(tools, FILES[name]))
    if (tools / name).suffix not in ("", ".json"):
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress((tools / name).read_bytes()))
        assert load_scene(tmp_path / f"{name}.gz") == scene


@pytest.mark.parametrize("given", ["", "/lod-meta.json", "#0", "/lod-meta.json#0", "#1"])
def test_a_level_and_the_environment(given, tools):
    scene = load_scene(f"{tools}/splat-transform_lod{given}")
    # Which leaves the environment out.
    expected = as_splat_transform_reads(tools, "level_1.ply" if given == "#1" else "level_0.ply")
    around = load_scene(tools / "splat-transform_lod" / "env")
    assert len(around) == 150
    assert around.means[:, 0].max() < expected.means[:, 0].min() - 1
    assert_alike(scene[: len(expected)], expected)
    back = scene[len(expected) :]
    np.testing.assert_array_equal(back.means, around.means)
    np.testing.assert_array_equal(back.sh[:, 0], around.sh[:, 0])
    assert not back.sh[:, 1:].any()


@pytest.mark.parametrize("name", ["splat-transform_sog", "splat-transform_lod#1", "splat-transform.glb"])
def test_commands_take_them(name, tools, tmp_path):
    assert cli.main(["convert", str(tools / name), str(tmp_path / "out.ply")]) == 0
    np.testing.assert_array_equal(load_scene(tmp_path / "out.ply").means, load_scene(tools / name).means)


def test_files_for_every_reader_are_there(tools):
    """What was made is tested, and nothing else lies there."""
    made = {path.name for path in tools.iterdir()}
    used = {name.partition("/")[0] for name in FILES} | {"splat-transform_lod", "plush.ply"}
    assert made == used | {"as_splat-transform_reads_it"}


def test_a_folder_may_be_anywhere(tools, tmp_path, monkeypatch):
    shutil.copytree(tools / "splat-transform_sog", tmp_path / "a#1")
    monkeypatch.chdir(tmp_path / "a#1")
    assert len(load_scene(".")) == len(load_scene("meta.json")) == len(load_scene(tmp_path / "a#1")) == 150
